"""A private copy of the repository in which the workflow is run with steps that only write small files.

Snakemake, the rules, their parameters and the code digest are the real ones; only the interpreter that the rules call is
replaced, by one that writes what a step would write, in milliseconds. So what is tested is the plan, not the pictures.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
COPIED = ("Snakefile", "avatar", "config", "fitting", "profiles", "workflow")

STUB = '''#!{python} -SE
"""Stands in for `python -m STEP ...`: writes each output. The text of the video decides what becomes of its subject."""
import json, os, sys, time
args, key = {{}}, None
for word in sys.argv[3:]:
    if word.startswith("--"):
        key = word
        args[key] = []
    else:
        args[key].append(word)
step, subject = sys.argv[2], args["--subject"][0]
outputs = dict(item.split("=", 1) for item in args["--output"])
with open("ran.txt", "a") as log:
    log.write(step + " " + subject + "\\n")
fate = open("fate.json").read() if os.path.exists("fate.json") else "{{}}"
fate = json.loads(fate).get(subject, "")
if fate == "crash in " + step:
    sys.exit("Traceback: " + subject)
if fate == "sleep in " + step:
    time.sleep(60)
for name, path in outputs.items():
    os.makedirs(os.path.dirname(path) or ".", exist_ok=True)
    if name in ("page", "png"):
        os.makedirs(path, exist_ok=True)
        path = os.path.join(path, "index.html")
    content = dict(accepted=fate != "reject", reason="no face in 62 % of the frames") if name == "probe" else sys.argv
    with open(path, "w") as file:
        json.dump(content, file)
'''
# A shell that runs the tests in the background makes its children ignore Ctrl-C: they must hear it here.
HEAR = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)"
RUN = HEAR + "; sys.executable = {stub!r}; from snakemake.cli import main; main(sys.argv[1:])"


@dataclass
class Result:
    """What a call of snakemake came to."""

    code: int
    text: str

    @property
    def last_line(self) -> str:
        return self.text.strip().splitlines()[-1]


@dataclass
class Pipeline:
    """A working folder with its own code, config and videos."""

    folder: Path

    @classmethod
    def create(cls, folder: Path, subjects: tuple[str, ...] = ()) -> Pipeline:
        """Copy the code into an empty folder, with one made-up video a subject."""
        folder.mkdir(parents=True, exist_ok=True)
        for name in COPIED:
            if (REPOSITORY / name).is_dir():
                shutil.copytree(REPOSITORY / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
            else:
                shutil.copy(REPOSITORY / name, folder / name)
        pipeline = cls(folder)
        (folder / "videos").mkdir()
        for subject in subjects:
            pipeline.add_video(subject)
        stub = folder / "stub"
        stub.write_text(STUB.format(python=sys.executable))
        stub.chmod(0o755)
        return pipeline

    def add_video(self, subject: str, suffix: str = ".mp4") -> Path:
        path = self.folder / "videos" / f"{subject}{suffix}"
        path.write_text(f"a video of {subject}")
        return path

    def set_fate(self, **fates: str) -> None:
        """What becomes of a subject: `reject`, `crash in STEP`, `sleep in STEP`."""
        (self.folder / "fate.json").write_text(json.dumps(fates))

    def write_config(self, text: str) -> None:
        (self.folder / "config" / "config.yaml").write_text(text)

    def edit(self, name: str, old: str, new: str) -> None:
        """Replace text in a file; the text must be there."""
        path = self.folder / name
        source = path.read_text(encoding="utf-8")
        assert old in source, f"{old!r} not in {name}"
        path.write_text(source.replace(old, new), encoding="utf-8")

    def append(self, name: str, text: str) -> None:
        path = self.folder / name
        path.write_text(path.read_text(encoding="utf-8") + text, encoding="utf-8")

    def command(self, *arguments: str, stub: bool = True) -> list[str]:
        program = ["-c", RUN.format(stub=str(self.folder / "stub"))] if stub else ["-m", "snakemake"]
        return [sys.executable, *program, *arguments]

    def run(self, *arguments: str, stub: bool = True, timeout_s: float = 600) -> Result:
        """Call snakemake in the folder as a user would; steps are the stub unless told otherwise."""
        done = subprocess.run(
            self.command(*arguments, stub=stub), cwd=self.folder, env=self.environment(), timeout=timeout_s,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
        )  # fmt: skip
        return Result(done.returncode, done.stdout)

    def interrupt(self, until: str, timeout_s: float = 60) -> Result:
        """Run, press Ctrl-C once a step has begun (as recorded by the stub), and wait for the end."""
        import time

        process = subprocess.Popen(
            self.command(), cwd=self.folder, env=self.environment(), text=True, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        end = time.monotonic() + timeout_s
        while until not in self.ran() and time.monotonic() < end:
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        text, _ = process.communicate(timeout=timeout_s)
        return Result(process.returncode, text)

    def environment(self) -> dict[str, str]:
        """The user's environment without what pytest or a caller may have set for Python."""
        return {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "PYTEST"))}

    def ran(self) -> list[str]:
        """`STEP SUBJECT` of every stub call since the last `forget`."""
        path = self.folder / "ran.txt"
        return path.read_text().splitlines() if path.exists() else []

    def forget(self) -> None:
        (self.folder / "ran.txt").unlink(missing_ok=True)

    def plan(self, *arguments: str) -> set[str]:
        """Jobs that Snakemake would run now: `rule` or `rule subject` or `rule subject/variant`."""
        result = self.run("-n", *arguments)
        assert result.code == 0, result.text
        jobs = set()
        for block in re.split(r"\n(?=(?:local)?(?:rule|checkpoint) \w+:\n)", result.text)[1:]:
            rule = re.match(r"\w+ (\w+):", block)[1]
            wildcards = dict(re.findall(r"(\w+)=([^,\n]+)", (re.search(r"^    wildcards: (.*)$", block, re.M) or [""])[0]))
            where = "/".join(wildcards.get(key, "") for key in ("subject", "variant", "predictor", "asset") if key in wildcards)
            jobs.add(f"{rule} {where}".strip())
        return jobs - {"all"}
