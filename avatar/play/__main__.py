"""Show an avatar live on a local page, moved by sliders, a parameter file, its own track, a video or a webcam.

    python -m avatar.play results/SUBJECT/VARIANT [--file MOTION.csv] [--video DRIVER.mp4]
        [--port N] [--no-browser] [--size PX] [--threads N]

The page is served on 127.0.0.1 alone, under an address with a secret in it. Pictures of a webcam go to this program and nowhere
else, and are not kept. Ctrl-C ends it.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import webbrowser
from pathlib import Path

from pydantic import ValidationError

from avatar.play.config import PlayConfig
from workflow import step


def parse(words: list[str] | None) -> tuple[Path, PlayConfig]:
    """The avatar's folder and the settings; exit status 2 with one sentence for what is not understood."""
    parser = argparse.ArgumentParser(prog="python -m avatar.play", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="results/SUBJECT/VARIANT")
    for name, field in PlayConfig.model_fields.items():
        flag = name.replace("_", "-")
        if field.annotation is bool:
            parser.add_argument(f"--no-{flag}", dest=name, action="store_false", help=f"Do not: {field.description}")
        else:
            parser.add_argument(f"--{flag}", dest=name, default=field.default, help=field.description)
    given = vars(parser.parse_args(words))
    folder = given.pop("folder")
    try:
        return folder, PlayConfig(**given)
    except ValidationError as error:
        first = error.errors()[0]
        parser.error(f"--{str(first['loc'][0]).replace('_', '-')}: {first['msg']}, found {first['input']}")


def main(words: list[str] | None = None) -> int:
    """Serve until Ctrl-C; exit status 1 and one sentence where that is not possible."""
    folder, config = parse(words)
    try:
        print(f"opening {folder} ...", file=sys.stderr, flush=True)
        from avatar.play import assembly  # after the words are understood: torch takes seconds

        server, end = assembly.server_of(folder, config)
    except (step.StepError, OSError) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 1
    except KeyboardInterrupt:  # while it opens
        return 130
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    thread = threading.Thread(target=server.serve_forever, name="server", daemon=True)
    thread.start()
    print(f"{server.address}\nCtrl-C ends it", flush=True)
    if config.browser:
        webbrowser.open(server.address)
    stopped.wait()
    server.shutdown()
    server.server_close()
    end()
    print("ended", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
