"""Run one step of the pipeline as a command: typed config in, files in, files out.

Every step is a module with a function `run(job)` that ends in

    if __name__ == "__main__":
        step.main(run, SomeConfig)

and is called by its rule (or by hand: paste the command that `snakemake -p` prints) as

    python -m fitting.extract --subject ann --config '{"size": 512}' --code 1f3a --threads 2 \\
        --input video=videos/ann.mp4 probe=results/ann/probe/probe.json \\
        --output frames=results/ann/frames/frames.npy index=results/ann/frames/frames.json

The harness validates the config, sets the number of threads, starts the log, hands the step *temporary* output paths and
renames them into place only when the step returns: a killed step never leaves a half-written file under a final name.
Nothing here may change what a step computes: this file is not part of the code digest (`workflow.digest`).
"""

from __future__ import annotations

import argparse
import errno
import json
import logging
import os
import platform
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

PARTIAL = ".partial-"
VERSIONS_OF = ("torch", "numpy", "scipy", "mediapipe", "opencv-contrib-python-headless", "av", "anny", "snakemake")
HEARTBEAT_S = 30.0


class StepError(Exception):
    """A failure that the user can act on: one sentence naming the file, what was found and what to do. Exit status 1."""


@dataclass
class Job:
    """What a step is given."""

    config: Any
    """The step's own validated pydantic model."""
    input: SimpleNamespace
    """Input paths by name; a name given several times is a list."""
    output: SimpleNamespace
    """Output paths by name: temporary names, renamed into place when the step returns."""
    final: SimpleNamespace
    """Where the outputs will be: for siblings that outlive a kill, such as training checkpoints."""
    subject: str
    threads: int
    device: str
    code: str
    """Digest of the step's code (`workflow.digest`), recorded in every JSON and in the training fingerprint."""
    log: logging.Logger
    started: float = field(default_factory=time.perf_counter)

    def seconds(self) -> float:
        """Wall-clock seconds since the step started."""
        return time.perf_counter() - self.started

    def provenance(self) -> dict[str, Any]:
        """What made a file: config, code digest, versions, seconds so far, device and threads."""
        return {
            "config": json.loads(self.config.model_dump_json()),
            "code": self.code,
            "versions": {name: version(name) for name in VERSIONS_OF if version(name)} | {"python": platform.python_version()},
            "seconds": round(self.seconds(), 3),
            "device": self.device,
            "threads": self.threads,
        }

    def write_json(self, path: Path, content: dict[str, Any]) -> None:
        """Write `content` plus a `provenance` block, indented, keys in the order given.

        Raises:
            ValueError: a number in `content` is NaN or infinite.
        """
        text = json.dumps(content | {"provenance": self.provenance()}, indent=1, ensure_ascii=False, allow_nan=False)
        path.write_text(text + "\n", encoding="utf-8")

    def progress(self, items: Iterable[Any], what: str, total: int | None = None) -> Iterator[Any]:
        """Iterate with a tqdm bar on a terminal and a heartbeat line every 30 s otherwise."""
        total = len(items) if total is None and hasattr(items, "__len__") else total
        if sys.stderr.isatty():
            from tqdm import tqdm

            yield from tqdm(items, desc=what, total=total, leave=False)
            return
        start = beat = time.perf_counter()
        for done, item in enumerate(items):
            now = time.perf_counter()
            if now - beat > HEARTBEAT_S:
                beat = now
                rate = done / (now - start)
                left = f", about {(total - done) / rate:.0f} s left" if total and rate else ""
                self.log.info("%s: %d of %s, %.1f a second%s", what, done, total or "?", rate, left)
            yield item


def version(package: str) -> str | None:
    """Installed version of a distribution, or None."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; StepError names a file that is missing or damaged."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise StepError(f"{path}: missing; run snakemake again to make it") from None
    except json.JSONDecodeError as error:
        raise StepError(f"{path}: not readable as JSON ({error}); delete it and run snakemake again") from None


def resolve_device(name: str) -> str:
    """`auto` -> `cuda` where torch sees one, else `cpu`; other names are returned as they are."""
    if name != "auto":
        return name
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def set_threads(count: int) -> None:
    """Set the thread count of torch, OpenCV, numba and the BLAS libraries that are already loaded."""
    from threadpoolctl import threadpool_limits

    threadpool_limits(limits=count)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(count)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(count)
    if "numba" in sys.modules:
        sys.modules["numba"].set_num_threads(min(count, sys.modules["numba"].config.NUMBA_NUM_THREADS))


def _pairs(items: list[str]) -> SimpleNamespace:
    """`["a=x", "b=y", "b=z"]` -> namespace(a=Path(x), b=[Path(y), Path(z)])."""
    found: dict[str, Any] = {}
    for item in items:
        name, separator, path = item.partition("=")
        if not separator:
            raise SystemExit(f"expected NAME=PATH, found {item!r}")
        if name in found:
            found[name] = [*(found[name] if isinstance(found[name], list) else [found[name]]), Path(path)]
        else:
            found[name] = Path(path)
    return SimpleNamespace(**found)


def _parse(argv: list[str] | None, name: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog=f"python -m {name}")
    parser.add_argument("--subject", default="", help="name used in messages")
    parser.add_argument("--config", default="{}", help="the step's config as JSON")
    parser.add_argument("--code", default="", help="digest of the step's code")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu", help="cpu, cuda, cuda:N or auto")
    parser.add_argument("--input", nargs="*", default=[], metavar="NAME=PATH")
    parser.add_argument("--output", nargs="*", default=[], metavar="NAME=PATH")
    return parser.parse_args(argv)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _interrupt(signum: int, frame: Any) -> None:
    raise KeyboardInterrupt


def main(run: Callable[[Job], None], config_type: type, argv: list[str] | None = None) -> None:
    """Parse the command line, run the step, rename its outputs into place; exits non-zero with one sentence on failure."""
    name = run.__module__ if run.__module__ != "__main__" else sys.modules["__main__"].__spec__.name
    arguments = _parse(argv, name)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(message)s", datefmt="%H:%M:%S", stream=sys.stderr)
    log = logging.getLogger(f"{name}[{arguments.subject}]" if arguments.subject else name)
    signal.signal(signal.SIGTERM, _interrupt)
    final = _pairs(arguments.output)
    temporary = SimpleNamespace(**{key: path.with_name(PARTIAL + path.name) for key, path in vars(final).items()})
    try:
        config = config_type.model_validate_json(arguments.config)
        set_threads(arguments.threads)
        for path in vars(temporary).values():
            path.parent.mkdir(parents=True, exist_ok=True)
            _remove(path)
        job = Job(
            config,
            _pairs(arguments.input),
            temporary,
            final,
            arguments.subject,
            arguments.threads,
            resolve_device(arguments.device),
            arguments.code,
            log,
        )
        run(job)
        for key, path in vars(temporary).items():
            if not path.exists():
                raise RuntimeError(f"the step ended without writing its output {key!r}")
            target = vars(final)[key]
            if target.is_dir():
                shutil.rmtree(target)
            os.replace(path, target)
        log.info("done in %.1f s", job.seconds())
    except StepError as error:
        raise SystemExit(_failed(log, temporary, str(error))) from None
    except KeyboardInterrupt:
        _failed(log, temporary, "interrupted; run snakemake again to continue")
        raise SystemExit(130) from None
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            _failed(log, temporary, str(error))
            raise
        raise SystemExit(_failed(log, temporary, "no space left on the disk; free some and run snakemake again")) from None
    except BaseException:
        _failed(log, temporary, "failed; the traceback follows")
        raise


def _failed(log: logging.Logger, temporary: SimpleNamespace, message: str) -> int:
    """Log the sentence, remove temporary outputs, return exit status 1."""
    log.error("%s", message)
    for path in vars(temporary).values():
        _remove(path)
    return 1
