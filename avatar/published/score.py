"""Step `published_score`: scores of one method of a comparison: a published panel, or pictures that were rendered here.

Input: video (the comparison), index (frames.json), matte, trim, landmarks, track, split, lpips; for pictures png, opacity and
report, and train (train.json) where there is a training. Output: per_frame (csv), metrics (json).
All methods are scored on the same pixels of the same frames, which follow from the driving panel alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd

from avatar import evaluate, lpips, regions
from avatar.published import protocol as published
from avatar.published.config import PublishedScoreConfig
from avatar.published.protocol import Grid
from workflow import step

NETWORKS = ("alexnet",)
CERTAIN = 250
"""Trimmed alpha from which a pixel of the face is scored as face."""
REASON = "the head was lost in the driving panel (no landmarks, or the fit could not track it)"


def protocol(size: tuple[int, int], config: PublishedScoreConfig, frames: str) -> dict[str, str]:
    """What the figures mean, where they differ from `evaluate`'s own."""
    return evaluate.protocol(size, NETWORKS) | {
        "background": "white; a published render is taken as it was published",
        "mask": "driving panel composited with its trimmed alpha (head and neck); pixels of clothes and shoulders (matte without "
        "trimmed alpha) are white in every method's picture",
        "crop": "rows down to the chin, columns within 0.6 face widths of the face, found in the driving panel; outlines count",
        "face": f"hull of the face mesh's landmarks where the trimmed alpha is at least {CERTAIN} of 255",
        "outlines": "the driving panel is cut out by the matte that the avatars here were trained with; the published ones had "
        "their own: of head figures a part is agreement with this matte, of face figures none, of mouth and eyes where a box "
        "reaches over the outline",
        "resolution": f"{size[1]}x{size[0]}, the panel's own pixels; published renders carry the comparison video's compression",
        "frames": frames,
        "stride": f"one test frame in {config.stride}" if config.stride > 1 else "every test frame",
    }


def pictures(job: step.Job, wanted: dict[int, int]) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Video frame number, driving panel and the method's picture uint8 [h, w, 4] of the wanted frames (number -> place).

    The opacity of a published render is not known: 255.
    """
    config, video = job.config, job.input.video
    if config.kind == "published":
        for number, (driving, picture) in published.read_panels(video, config.panels, [config.driving, config.method], wanted):
            yield number, driving, np.concatenate([picture, np.full_like(picture[..., :1], 255)], -1)
        return
    opacity = np.load(job.input.opacity, mmap_mode="r")
    for number, (driving,) in published.read_panels(video, config.panels, [config.driving], wanted):
        path = job.input.png / f"{number:05d}.png"
        image = cv2.imread(str(path))
        if image is None or image.shape != driving.shape:
            found = "missing or damaged" if image is None else f"{image.shape[1]}x{image.shape[0]}"
            want = f"{driving.shape[1]}x{driving.shape[0]}"
            raise step.StepError(f"{path}: {found}, expected {want}; delete the folder and run snakemake again")
        yield number, driving, np.concatenate([image[..., ::-1], opacity[wanted[number]][..., None]], -1)


def _load(job: step.Job) -> SimpleNamespace:
    """What is known of the driving panel, and which test frames are scored."""
    index, split = step.read_json(job.input.index), step.read_json(job.input.split)
    chosen = split["test"][:: job.config.stride]
    if hasattr(job.input, "report") and step.read_json(job.input.report)["frames"] != chosen:
        raise step.StepError(
            f"{job.input.report}: is of other frames than the config asks for; delete it and run snakemake again"
        )
    with np.load(job.input.track, allow_pickle=False) as track, np.load(job.input.landmarks, allow_pickle=False) as landmarks:
        usable, found, points = track["usable"], landmarks["found"], landmarks["points"]
    grid = Grid(index)
    points = {frame: grid.points(points[frame, :, :2]) for frame in chosen if usable[frame] and found[frame]}
    points = {frame: at for frame, at in points.items() if regions.find(at, grid.size).face is not None}
    if not points:
        what = f"the head was found in none of the {len(chosen)} test frames of panel {job.config.driving}"
        raise step.StepError(f"{job.input.video}: {what}; is it the driving panel?")
    matte, trim = (np.load(path, mmap_mode="r") for path in (job.input.matte, job.input.trim))
    return SimpleNamespace(
        grid=grid,
        points=points,
        masks=lambda frame: (grid.place(np.asarray(matte[frame]), 0), grid.place(np.asarray(trim[frame]), 0)),
        number={frame: index["source_frame"][frame] for frame in chosen},
        excluded=[frame for frame in chosen if frame not in points],
        train_frames=len(split["train"]),
    )


def _on_white(job: step.Job, scene: SimpleNamespace) -> bool:
    """Whether the published method rendered on white, judged by the middle one of the scored frames."""
    if job.config.kind != "published":
        return True
    frame = list(scene.points)[len(scene.points) // 2]
    _, _, picture = next(pictures(job, {scene.number[frame]: 0}))
    return published.on_white_background(picture[..., :3], scene.masks(frame)[0], scene.grid.box)


def score_frame(
    driving: np.ndarray, picture: np.ndarray, scene: SimpleNamespace, frame: int, tools: SimpleNamespace
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Scores of one frame and notes on the regions left out.

    Args:
        driving: uint8 [h, w, 3] of the driving panel.
        picture: uint8 [h, w, 4] of the method, colour and opacity.
        scene: from `_load`.
        frame: its index among the frames of the driving panel.
        tools: `device`, `networks` (LPIPS by metric) and `on_white`, whether the method rendered on white.
    """
    (matte, trimmed), points = scene.masks(frame), scene.points[frame]
    box = published.head_box(regions.find(points, driving.shape[:2]).face, scene.grid.box)
    colour = published.comparable(picture[..., :3], matte, trimmed, tools.on_white)
    opacity = np.where(published.body(matte, trimmed), 0, picture[..., 3])
    corner = np.array([box[1].start, box[0].start])
    truth, render, alpha = (
        evaluate.images(np.ascontiguousarray(image[box])[None], tools.device)
        for image in (driving, np.dstack([colour, opacity]), trimmed[..., None])
    )
    found = regions.find(points - corner, truth.shape[2:])
    # At the cheek's edge the hull reaches over the matte's edge, where whoever was trained with this matte would be at home.
    certain = found.face & (trimmed[box] >= CERTAIN)
    found = replace(found, face=certain if certain.any() else None)
    return evaluate.score_regions(truth, render, alpha[:, 0], [found], tools.networks)[0], found.notes


def run(job: step.Job) -> None:
    """Score every chosen frame in which the driving panel's head is known."""
    scene = _load(job)
    try:
        networks = {lpips.METRIC[name]: lpips.load(job.input.lpips, job.device, name) for name in NETWORKS}
    except ValueError as error:
        raise step.StepError(f"{error}; delete it and run snakemake again to fetch it") from None
    tools = SimpleNamespace(device=job.device, networks=networks, on_white=_on_white(job, scene))
    places = {number: place for place, number in enumerate(scene.number.values())}
    frame_of, rows = {number: frame for frame, number in scene.number.items()}, []
    scored = {scene.number[frame]: places[scene.number[frame]] for frame in scene.points}
    for number, driving, picture in job.progress(pictures(job, scored), "scoring", len(scored)):
        row, notes = score_frame(driving, picture, scene, frame_of[number], tools)
        if job.config.kind == "published":
            del row["iou"]
        rows.append({"frame": number} | row | {"note": "; ".join(notes)})
    if len(rows) < len(scored):
        what = f"{len(rows)} of {len(scored)} test frames decode"
        raise step.StepError(f"{job.input.video}: {what}; the file has changed, run snakemake again")
    names = evaluate.columns(NETWORKS)
    table = pd.DataFrame(rows, columns=["frame", *names, "note"])
    table.to_csv(job.output.per_frame, index=False, float_format="%.6f")
    _report(job, scene, table, names, tools.on_white)


def _report(job: step.Job, scene: SimpleNamespace, table: pd.DataFrame, names: list[str], on_white: bool) -> None:
    """Write metrics.json."""
    means = evaluate.summary(table, names)
    report = step.read_json(job.input.report) if hasattr(job.input, "report") else {}
    train = step.read_json(job.input.train) if hasattr(job.input, "train") else {}
    total = len(table) + len(scene.excluded)
    said = f"{len(table)} of {total} chosen test frames; numbers are those of the comparison video"
    job.write_json(
        job.output.metrics,
        {
            "method": job.config.method,
            "kind": job.config.kind,
            "metrics": means,
            "train_frames": scene.train_frames,
            "test_frames": total,
            "scored_frames": len(table),
            "excluded": {"count": len(scene.excluded), "reason": REASON, "frames": scene.excluded},
            "on_white": on_white,
            "note": ""
            if on_white
            else "not published on white: composited with the driving panel's mask, its outline is not scored",
            "ms_per_frame": report.get("ms_per_frame"),
            "training_seconds": train.get("train_seconds"),
            "protocol": protocol(scene.grid.size, job.config, said),
        },
    )
    job.log.info("%d frames: %s", len(table), ", ".join(f"{name} {value['mean']:.4g}" for name, value in means.items()))


if __name__ == "__main__":
    step.main(run, PublishedScoreConfig)
