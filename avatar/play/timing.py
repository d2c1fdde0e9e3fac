"""Milliseconds of each stage of `play` on this computer, and what the smoothing costs and brings:

    python -m avatar.play.timing results/SUBJECT/VARIANT VIDEO [--frames 300] [--threads 1]

Stages run one after the other here, in one process, so each has the computer to itself; in play the driver and the drawing
run beside each other.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
import urllib.request
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d

from avatar.play import assembly, subject
from avatar.play.carry import Carrier
from avatar.play.config import PlayConfig
from avatar.play.driver import LONGEST_PX, MAX_FACES, small
from avatar.play.rows import Body, Row, rest_row
from avatar.play.smoothing import SmoothRow
from avatar.play.solver import FaceSolver
from avatar.uses.identity import vertices_of
from fitting.detection import FaceFinder
from fitting.head_model import HeadModel
from fitting.video import read_frames
from workflow import step

TRUTH_FRAMES = 1.2  # standard deviation of the Gaussian whose result, which sees what comes, stands for the truth
STILL = 0.3  # part of the frames, those that move least, that count as still
CHANGES = 60  # sliders moved for the round trip
VERTEX_STRIDE = 10


def main(words: list[str] | None = None) -> int:
    """Print the figures as JSON; 1 and one sentence where something is missing."""
    parser = argparse.ArgumentParser(prog="python -m avatar.play.timing", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("video", type=Path)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args(words)
    try:
        subject.check_video(given.video)
        opened = subject.open_subject(given.folder, given.threads)
        if opened.landmarker is None:
            raise step.StepError(f"{subject.LANDMARKER}: this file is missing; run snakemake once")
        head, shape = opened.room.head, opened.room.track["shape"]
        row, rest = rest_row(head, shape, opened.training)
        carrier = Carrier(head, Body.of(head, shape), row, rest)
        rows, figures = driven(head, carrier, opened.landmarker, given.video, given.frames)
        found = {"driver": figures}
        if len(rows) > 20:
            found["smoothing"] = smoothing(head, shape, rows)
        found["page"] = page(given.folder, given.threads)
    except step.StepError as error:
        print(error, file=sys.stderr)
        return 1
    print(json.dumps(found, indent=1))
    return 0


def spread(values: list[float]) -> dict[str, float]:
    """Median, least and 90th percentile."""
    return {name: round(float(np.quantile(values, part)), 2) for name, part in (("median", 0.5), ("least", 0.0), ("p90", 0.9))}


def driven(
    head: HeadModel, carrier: Carrier, landmarker: bytes, video: Path, count: int
) -> tuple[list[tuple[float, Row]], dict[str, Any]]:
    """Times (s) and rows of a video's first frames, unsmoothed, from when the driver is known; ms of each stage."""
    rows: list[tuple[float, Row]] = []
    times: dict[str, list[np.ndarray]] = {"detect": [], "solve": [], "carry": []}
    solver, lost, learned = None, 0, 0.0
    with FaceFinder(landmarker, True, MAX_FACES) as finder:
        for k, frame in enumerate(islice(read_frames(video), count)):
            image = small(frame.rgb(), LONGEST_PX)
            solver = solver or FaceSolver(head, image.shape[:2])
            moments = [_now()]
            faces = finder.find(image, 1 + round(1e3 * frame.time_s) + k)
            moments.append(_now())
            known = solver.calibrated
            pose = solver.solve(faces[0].points, faces[0].blendshapes) if faces else solver.solve(None, None)
            moments.append(_now())
            if pose is None:
                lost += 1
                continue
            row = carrier.carried(pose)
            moments.append(_now())
            if solver.calibrated != known:
                carrier.begin(solver.shared.shape)
                learned = 1e3 * (moments[2] - moments[1])[1]
            elif known:
                for name, first, last in zip(times, moments, moments[1:], strict=False):
                    times[name].append(1e3 * (last - first))
                rows.append((frame.time_s, row))
    figures = {
        kind: {name: spread([value[place] for value in values]) for name, values in times.items() if values}
        for place, kind in enumerate(("ms", "processor_ms"))
    }
    return rows, figures | {"getting_to_know_processor_ms": round(learned), "frames": len(rows), "lost": lost}


def _now() -> np.ndarray:
    """Seconds [2] by the clock and of the processor: they part where the computer does something else too."""
    return np.array([time.perf_counter(), time.process_time()])


def smoothing(head: HeadModel, shape: np.ndarray, rows: list[tuple[float, Row]]) -> dict[str, Any]:
    """Jitter of the face (rms second difference, mm), raw and smoothed, and by how many ms the filter is late."""
    smooth = SmoothRow(len(head.expression_names))
    raw, calm = [row for _, row in rows], [smooth(row, moment) for moment, row in rows]
    chosen = np.flatnonzero(vertices_of(head))[::VERTEX_STRIDE]
    truth = gaussian_filter1d(_face(head, shape, raw, chosen), TRUTH_FRAMES, axis=0)
    speed = np.linalg.norm(np.gradient(truth, axis=0), axis=-1).mean(1)
    still = (speed <= np.quantile(speed, STILL))[1:-1]

    def jitter(part: list[Row], kept: np.ndarray) -> float:
        away = np.diff(_face(head, shape, part, chosen), 2, axis=0)
        return round(1e3 * float(np.sqrt((away**2).sum(-1).mean(1)[kept].mean())), 3)

    step_ms = 1e3 * float(np.median(np.diff([moment for moment, _ in rows])))
    late = {name: late_frames(*([read(row) for row in part] for part in (raw, calm))) for name, read in _watched(head).items()}
    return {
        "jitter_mm": {
            name: {"still": jitter(part, still), "all": jitter(part, np.ones_like(still))}
            for name, part in (("raw", raw), ("smoothed", calm))
        },
        "late_ms": {name: round(step_ms * value, 1) for name, value in late.items()},
    }


def _watched(head: HeadModel) -> dict[str, Callable[[Row], float]]:
    """What lateness is measured on: a turn, a shift, the jaw and a blink where the head model has them by name."""
    names = [name for name in ("jawOpen", "eyeBlinkLeft") if name in head.expression_names]
    codes = {name: partial(_code, head.expression_names.index(name)) for name in names}
    return {"yaw": lambda row: row.rotation[1], "across": lambda row: row.translation[0]} | codes


def _code(place: int, row: Row) -> float:
    return row.expression[place]


def _face(head: HeadModel, shape: np.ndarray, rows: list[Row], chosen: np.ndarray) -> np.ndarray:
    """Vertices [T, N, 3] m in camera axes."""
    values = {
        name: torch.from_numpy(np.stack([getattr(row, name) for row in rows])).to(head.template.dtype) for name in Row._fields
    }
    return head.forward(torch.from_numpy(np.asarray(shape)), **values)[:, chosen].double().numpy()


def late_frames(raw: list[float], smoothed: list[float], most: float = 5.0) -> float:
    """By how many frames the second signal lies behind the first (made smooth both ways), to a tenth."""
    truth, places = gaussian_filter1d(np.asarray(raw), TRUTH_FRAMES), np.arange(len(raw))
    inner = places[int(most) + 1 : -int(most) - 1]
    shifts = np.arange(-1, most, 0.1)
    errors = [((np.interp(inner - shift, places, truth) - np.asarray(smoothed)[inner]) ** 2).mean() for shift in shifts]
    return float(shifts[int(np.argmin(errors))])


def page(folder: Path, threads: int) -> dict[str, Any]:
    """From a slider's message to its picture, over HTTP on this computer, and what of it the server itself needs."""
    server, end = assembly.server_of(folder, PlayConfig(threads=threads))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    times: dict[str, list[float]] = {"frame": [], "jpeg": [], "round_trip": [], "kilobytes": []}
    try:
        number = 0
        for k in range(CHANGES):
            begun = time.perf_counter()
            body = json.dumps({"sliders": {"turn_right": 20.0 * np.sin(k / 5)}}).encode()
            with urllib.request.urlopen(server.address + "state", body, timeout=600) as answer:
                version = json.loads(answer.read())["version"]
            facts: dict[str, Any] = {"version": -1}
            while facts["version"] < version:
                with urllib.request.urlopen(f"{server.address}picture?after={number}", timeout=600) as answer:
                    facts, data = json.loads(answer.headers["X-Play"]), answer.read()
                number = facts["number"]
            passed = 1e3 * (time.perf_counter() - begun)
            if k >= CHANGES // 10:  # the first compile and allocate
                more = {"round_trip": passed, "kilobytes": len(data) / 1024}
                for name, value in {**{part: facts["ms"][part] for part in ("frame", "jpeg")}, **more}.items():
                    times[name].append(value)
            if sum(times["round_trip"]) > 30e3:
                break  # a field
    finally:
        server.shutdown()
        server.server_close()
        end()
    beyond = np.array(times["round_trip"]) - times["frame"] - times["jpeg"]
    return {
        "size": facts["size"],
        "ms": {name: spread(values) for name, values in times.items()} | {"beyond": spread(list(beyond))},
    }


if __name__ == "__main__":
    raise SystemExit(main())
