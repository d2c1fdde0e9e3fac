"""The parameter file: named columns of expression and pose, one row a frame, from any program (CSV, or NPZ of arrays [T]).

    time_s                          optional: seconds, growing; the motion is then resampled to the frame rate asked for
    jawOpen, mouthSmileLeft, ...    expression codes, by the head model's names; upper and lower case do not matter
    rotation_x, rotation_y, rotation_z                    head, axis-angle, rad; frontal is 0; axes as OpenCV: x right, y down
    neck_*, jaw_*, eye_left_*, eye_right_*                the other joints, axis-angle, rad
    translation_x, translation_y, translation_z           m, in camera axes

What is not named rests: codes and rotations at 0, the translation at the subject's own. A fit/track.npz is such a file as well.
ARKit's blendshapes have the default head's names, so a Live Link Face CSV is read as it is; its columns without a code here
(gaze, tongue, head angles, time code) are left out and named: their signs and zero are the recording app's.

    python -m avatar.uses.parameters TRACK HEAD OUT.csv [FPS]     writes a track as such a file
"""

from __future__ import annotations

import csv
import difflib
import re
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from avatar.uses.motion import PARTS, TURNS, Motion, nearest_rotation, of_track
from fitting.camera import exp_rotation, log_rotation
from fitting.head_model import HeadModel

TIME = "time_s"
LONGEST_STEP_S = 5.0
"""Median step between rows from which times are taken for milliseconds: 16 or 33 of them lie between frames."""
VECTORS = {"rotation": (), "neck": (), "jaw": (), "eye_left": (0,), "eye_right": (1,), "translation": ()}
"""Column stems, and where each lies in its part of the motion."""
ARKIT_ONLY = re.compile(r"(eyelook(in|out|up|down)(left|right)|tongueout|_neutral)$")
LIVE_LINK_ONLY = re.compile(r"(timecode|blendshapecount|head(yaw|pitch|roll)|(left|right)eye(yaw|pitch|roll))$")


class ParameterError(ValueError):
    """What is wrong with a parameter file: one sentence without the file's name."""


class Parameters(NamedTuple):
    """What a file drives."""

    motion: Motion
    given: tuple[str, ...]
    """Columns that the file has, as it writes them."""
    left_out: tuple[str, ...]
    """Columns of ARKit that have no code here."""


def column_names(expression_names: Sequence[str]) -> list[str]:
    """Every column that a file may have, but for the time."""
    return [*expression_names, *(f"{stem}_{axis}" for stem in VECTORS for axis in "xyz")]


def read(path: Path, head: HeadModel, rest: Motion, fps: float) -> Parameters:
    """The motion of a file.

    rest: one frame, for columns that the file lacks.
    fps: frames a second of the result, and of a file without times.
    Raises ParameterError: unreadable, no rows, a column that is unknown or twice there, a cell that is no finite number, times
    that do not grow, or a track of another head model.
    """
    try:
        columns = _csv(path) if path.suffix.lower() != ".npz" else _npz(path)
    except (OSError, EOFError, csv.Error, zipfile.BadZipFile, ValueError) as error:
        if isinstance(error, ParameterError | FileNotFoundError):
            raise
        raise ParameterError(f"not readable as {'NPZ' if path.suffix.lower() == '.npz' else 'CSV'} ({error})") from error
    if path.suffix.lower() == ".npz" and set(PARTS) <= set(columns):
        return _track(columns, head, fps)
    return _named(columns, head.expression_names, rest, fps)


def _csv(path: Path) -> dict[str, np.ndarray]:
    """Columns [T] by name; cells that are no number are refused here, NaN later."""
    with open(path, newline="", encoding="utf-8-sig") as file:
        rows = [(reader.line_num, row) for reader in [csv.reader(file)] for row in reader if any(cell.strip() for cell in row)]
    if not rows:
        raise ParameterError("the file is empty; its first line must name the columns")
    names = [name.strip() for name in rows[0][1]]
    _refuse_twins(names)
    skipped = {place for place, name in enumerate(names) if name.lower() == "timecode"}  # no number
    values = np.empty((len(rows) - 1, len(names)))
    for place, (line, cells) in enumerate(rows[1:]):
        if len(cells) != len(names):
            raise ParameterError(f"line {line} has {len(cells)} cells, the header {len(names)}")
        for column, cell in enumerate(cells):
            try:
                values[place, column] = 0.0 if column in skipped else float(cell)
            except ValueError:
                raise ParameterError(f"line {line}, column {names[column]}: {cell!r} is not a number") from None
    return dict(zip(names, values.T, strict=True))


def _npz(path: Path) -> dict[str, np.ndarray]:
    """Arrays by name."""
    found = np.load(path, allow_pickle=False)
    if isinstance(found, np.ndarray):
        raise ParameterError("one array without a name; write it with numpy.savez and name the columns")
    with found as file:
        columns = {name: file[name] for name in file.files}
    _refuse_twins(list(columns))
    return columns


def _refuse_twins(names: list[str]) -> None:
    """ParameterError where two columns have one name, whatever their case."""
    lowered = [name.lower() for name in names]
    for place, name in enumerate(lowered):
        if name in lowered[:place]:
            raise ParameterError(f"the column {names[place]} is there twice")


def _track(columns: dict[str, np.ndarray], head: HeadModel, fps: float) -> Parameters:
    """A fit/track.npz: all its frames; the shape stays the avatar's own."""
    if (digest := str(columns.get("head_digest", head.digest))) != head.digest:
        raise ParameterError(f"a track of head model {digest}, but the avatar's is {head.name} {head.digest}")
    try:
        motion = of_track(columns, range(len(columns["expression"])), fps)
    except ValueError as error:
        raise ParameterError(str(error)) from error
    if motion.expression.shape[1] != len(head.expression_names):
        raise ParameterError(f"a track of {motion.expression.shape[1]} codes, but {head.name} has {len(head.expression_names)}")
    return Parameters(motion, PARTS, ())


def _named(columns: dict[str, np.ndarray], names: Sequence[str], rest: Motion, fps: float) -> Parameters:
    """The motion of named columns [T]; see `read`."""
    known = {name.lower(): name for name in [TIME, *column_names(names)]}
    arkit, live = "jawopen" in known, "blendshapecount" in {name.lower() for name in columns}
    unused = [n for n in columns if (arkit and ARKIT_ONLY.match(n.lower())) or (live and LIVE_LINK_ONLY.match(n.lower()))]
    columns = {name: values for name, values in columns.items() if name not in unused}
    for name in columns:
        if name.lower() not in known:
            near = difflib.get_close_matches(name.lower(), list(known), n=1, cutoff=0.5)
            hint = f"did you mean {known[near[0]]}?" if near else f"known are {TIME}, {', '.join(column_names(names))}"
            raise ParameterError(f"the column {name} is not known; {hint}")
    lengths = {np.shape(values) for values in columns.values()}
    if not columns or any(len(shape) != 1 for shape in lengths) or len(lengths) > 1 or next(iter(lengths)) == (0,):
        found = ", ".join(map(str, sorted(lengths))) or "nothing"
        raise ParameterError(f"every column must have one number a frame and as many as the others; found {found}")
    values = {known[name.lower()]: np.asarray(array, np.float64) for name, array in columns.items()}
    for name, array in values.items():
        if not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0][0])
            raise ParameterError(f"row {row + 1} of column {name} is {array[row]}; every cell must be a finite number")
    motion = _motion(values, names, rest, fps)
    if TIME in values:
        motion = resampled(motion, values[TIME])
    return Parameters(motion, tuple(columns), tuple(unused))


def _motion(values: dict[str, np.ndarray], names: Sequence[str], rest: Motion, fps: float) -> Motion:
    """Named columns [T] over the rest pose."""
    count = len(next(iter(values.values())))
    parts = {name: np.repeat(getattr(rest, name).astype(np.float64), count, 0) for name in PARTS}
    for place, name in enumerate(names):
        if name in values:
            parts["expression"][:, place] = values[name]
    for stem, where in VECTORS.items():
        part = parts["eyes" if where else stem]
        for axis, letter in enumerate("xyz"):
            if f"{stem}_{letter}" in values:
                part[(slice(None), *where, axis)] = values[f"{stem}_{letter}"]
    return Motion(**parts, fps=fps)


def resampled(motion: Motion, time_s: np.ndarray) -> Motion:
    """A motion given at times [T] s, at its own frame rate from the first time to the last; linear between rows.

    Raises ParameterError naming the row whose time does not grow, or for times that can be no seconds.
    """
    still = np.flatnonzero(np.diff(time_s) <= 0)
    if len(still):
        raise ParameterError(f"row {still[0] + 2} of column {TIME} is {time_s[still[0] + 1]:g}, not after the row before it")
    if len(time_s) > 1 and (step_s := float(np.median(np.diff(time_s)))) > LONGEST_STEP_S:
        raise ParameterError(f"rows of column {TIME} are {step_s:g} s apart; if these are milliseconds, divide them by 1000")
    wanted = np.arange(int(np.floor((time_s[-1] - time_s[0]) * motion.fps + 1e-6)) + 1) / motion.fps + time_s[0]
    before = np.clip(np.searchsorted(time_s, wanted, side="right") - 1, 0, max(len(time_s) - 2, 0))
    after = np.minimum(before + 1, len(time_s) - 1)
    gap = time_s[after] - time_s[before]
    share = np.clip(np.divide(wanted - time_s[before], gap, out=np.zeros_like(gap), where=gap > 0), 0, 1)

    def between(values: np.ndarray) -> np.ndarray:
        weight = share.reshape(-1, *[1] * (values.ndim - 1))
        return (1 - weight) * values[before] + weight * values[after]

    plain = {name: between(getattr(motion, name)) for name in PARTS if name not in TURNS}
    turned = {name: log_rotation(nearest_rotation(between(exp_rotation(getattr(motion, name))))) for name in TURNS}
    return Motion(**plain, **turned, fps=motion.fps)


def write(path: Path, motion: Motion, names: Sequence[str], timed: bool) -> None:
    """A motion as CSV, every column named, numbers with the digits that float32 has; timed: with `time_s`."""
    eyes = motion.eyes.reshape(len(motion), 6)
    table = [motion.expression, motion.rotation, motion.neck, motion.jaw, eyes, motion.translation]
    if timed:
        table.insert(0, np.arange(len(motion))[:, None] / motion.fps)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([TIME] * timed + column_names(names))
        writer.writerows([[f"{value:.9g}" for value in row] for row in np.concatenate(table, 1)])


def main(argv: list[str] | None = None) -> int:
    """Write a track as a parameter file; 1 and one sentence where that is not possible."""
    words = sys.argv[1:] if argv is None else argv
    if len(words) not in (3, 4):
        print("usage: python -m avatar.uses.parameters TRACK HEAD OUT.csv [FPS]", file=sys.stderr)
        return 2
    track, head, out = map(Path, words[:3])
    try:
        model = HeadModel.load(head)
        with np.load(track, allow_pickle=False) as file:
            motion = _track({name: file[name] for name in file.files}, model, float(words[3]) if words[3:] else 30.0).motion
    except (OSError, ValueError, KeyError) as error:
        print(f"{track}: {error}", file=sys.stderr)
        return 1
    write(out, motion, model.expression_names, bool(words[3:]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
