"""Step: the track in the formats of Neural Head Avatars and of VHAP and GaussianAvatars, each verified by reading it back.

    python -m fitting.export --input head=resources/heads/flame.npz track=results/ann/fit/track.npz frames=... index=... \\
        alpha=results/ann/trim/alpha.npy split=results/ann/split.json \\
        --output nha=results/ann/export/nha/tracked_flame_params.npz vhap=results/ann/export/vhap \\
        report=results/ann/export/export.json
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from fitting import export_nha, export_pose, export_vhap, verify_export
from fitting.camera import project
from fitting.config import ExportConfig
from fitting.export_pose import FlamePose
from fitting.files import load_head
from fitting.head_model import HeadModel
from workflow import step

LIMIT_MM, LIMIT_PX = 0.01, 0.05  # at 0.01 mm a vertex 0.3 m away moves 0.05 px under a focal length of 1500 px
EXPECTED = {"nha": "2020", "vhap": "2023"}  # FLAME versions that the programs load; another version's bases are others
WHITE = 255
LICENCE_NOTE = (
    "The codes describe a face only together with the FLAME file that they were fitted with; its licence holds for their use. "
    "Frames and codes are personal data of the filmed person."
)


def run(job: step.Job) -> None:
    """Export one subject."""
    head = load_head(job.input.head, torch.float64)
    reason = export_pose.refusal(head)
    if reason:
        raise step.StepError(f"{job.input.head} cannot be exported to FLAME formats: {reason}")
    track = _read_track(job, head)
    frames, alpha = np.load(job.input.frames, mmap_mode="r"), np.load(job.input.alpha, mmap_mode="r")
    split, source_frames = step.read_json(job.input.split), step.read_json(job.input.index)["source_frame"]
    counts = {job.input.frames: len(frames), job.input.alpha: len(alpha), job.input.index: len(source_frames)}
    counts[job.input.split] = max([len(track["usable"]), *(row + 1 for part in ("train", "test") for row in split[part])])
    for path, count in counts.items():
        if count != len(track["usable"]):
            raise step.StepError(f"{path}: {count} frames for {len(track['usable'])} rows of the track; delete it and run again")
    chosen = ("train", "test") if job.config.pictures == "all" else (job.config.pictures,)
    parts = {part: [row for row in split[part] if track["usable"][row]] if part in chosen else [] for part in ("train", "test")}
    pose, size = export_pose.of_track(head, track), frames.shape[1:3]
    focal, centre = float(track["focal_px"]), track["centre_px"].astype(np.float64)
    canvas = export_vhap.Canvas.around(size, centre)
    np.savez(job.output.nha, **export_nha.arrays(pose, focal, centre, size))
    tracked = export_vhap.arrays(pose, focal, canvas, source_frames)
    written = export_vhap.transforms(tracked, parts, focal, canvas.centre_px(centre))
    _write_folder(job, tracked, written, canvas, frames, alpha)
    plain = export_pose.without_eyelids(head, track)
    off_centre = canvas.centre_px(centre) - [canvas.width / 2, canvas.height / 2]
    flame = verify_export.Flame.of(head)
    try:
        checked = {
            "nha": {"file": _check_nha(job, head, flame, _limited(head, plain, pose))},
            "vhap": {
                "tracked": _check_vhap(job, head, flame, plain, canvas, float(np.linalg.norm(off_centre))),
                "folder": _check_folder(job, head, flame, plain, canvas),
            },
        }
    except ValueError as error:
        raise step.StepError(f"{job.final.report.parent}: a written file is not what its format asks for: {error}") from error
    job.write_json(job.output.report, _report(head, track, pose, parts, canvas, off_centre, checked))
    for name in EXPECTED:
        if EXPECTED[name] != head.version:
            job.log.warning(
                "%s reads codes of FLAME %s; these are of %s", name, EXPECTED[name], head.version or "an unnamed version"
            )


def _read_track(job: step.Job, head: HeadModel) -> dict[str, np.ndarray]:
    """Arrays of track.npz, fitted with this head model."""
    with np.load(job.input.track, allow_pickle=False) as file:
        track = {name: file[name] for name in file.files}
    if str(track["head_digest"]) != head.digest:
        raise step.StepError(
            f"{job.input.track}: fitted with head model {track['head_digest']}, but {job.input.head} is {head.digest}; fit again"
        )
    return track


def _limited(
    head: HeadModel, track: dict[str, np.ndarray], pose: FlamePose, parts: Iterable[str] = export_nha.LIMITS_DEG
) -> dict[str, np.ndarray]:
    """The track with some joints moved inside NHA's limits, in the project's own axes and order."""
    return track | export_pose.own(head, export_nha.limited(pose, tuple(parts)))


def _write_folder(
    job: step.Job,
    tracked: dict[str, np.ndarray],
    written: dict[str, dict[str, Any]],
    canvas: export_vhap.Canvas,
    frames: np.ndarray,
    alpha: np.ndarray,
) -> None:
    """VHAP's own file and its NeRF folder: pictures on white, masks, one parameter file a frame."""
    folder: Path = job.output.vhap
    for name in ("images", "fg_masks", "flame_param"):
        (folder / name).mkdir(parents=True)
    np.savez_compressed(folder / "tracked_flame_params_0.npz", **tracked)
    np.savez_compressed(folder / "canonical_flame_param.npz", **export_vhap.canonical_flame_param(tracked))
    for name, content in written.items():
        (folder / name).write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    for frame in job.progress(written["transforms.json"]["frames"], "pictures"):
        row = frame["timestep_index_original"]
        mask = alpha[row][..., None].astype(np.float32) / 255
        picture = np.round(frames[row] * mask + WHITE * (1 - mask)).astype(np.uint8)
        for name, image in (
            ("file_path", canvas.place(picture, WHITE)[..., ::-1]),
            ("fg_mask_path", canvas.place(alpha[row], 0)),
        ):
            if not cv2.imwrite(str(folder / frame[name]), image):
                raise OSError(f"{folder / frame[name]}: could not be written")
        np.savez_compressed(folder / frame["flame_param_path"], **export_vhap.flame_param(tracked, row))


def _check_nha(job: step.Job, head: HeadModel, flame: verify_export.Flame, track: dict[str, np.ndarray]) -> dict[str, Any]:
    """Re-pose every row of the written NHA file."""
    file, difference = _read(job.output.nha), verify_export.Difference()
    for rows in job.progress(verify_export.chunks(range(len(track["usable"]))), "verify nha"):
        vertices = export_pose.vertices(head, track, rows)
        pixels = project(vertices, float(track["focal_px"]), track["centre_px"])
        difference.add(verify_export.nha(file, flame, rows), vertices, pixels)
    return _verdict(job.final.nha, difference)


def _check_vhap(
    job: step.Job,
    head: HeadModel,
    flame: verify_export.Flame,
    track: dict[str, np.ndarray],
    canvas: export_vhap.Canvas,
    off_centre_px: float,
) -> dict[str, Any]:
    """Re-pose every row of the written VHAP file; its principal point is off by what whole pixels of padding leave."""
    name = "tracked_flame_params_0.npz"
    file, difference = _read(job.output.vhap / name), verify_export.Difference()
    for rows in job.progress(verify_export.chunks(range(len(track["usable"]))), "verify vhap"):
        vertices = export_pose.vertices(head, track, rows)
        pixels = project(vertices, float(track["focal_px"]), canvas.centre_px(track["centre_px"]))
        difference.add(verify_export.vhap(file, flame, rows), vertices, pixels)
    return _verdict(job.final.vhap / name, difference, off_centre_px)


def _check_folder(
    job: step.Job, head: HeadModel, flame: verify_export.Flame, track: dict[str, np.ndarray], canvas: export_vhap.Canvas
) -> dict[str, Any]:
    """Re-pose every frame of the written NeRF folder."""
    difference, folder = verify_export.Difference(), job.output.vhap
    for frame in job.progress(step.read_json(folder / "transforms.json")["frames"], "verify folder"):
        vertices = export_pose.vertices(head, track, np.array([frame["timestep_index_original"]]))
        pixels = project(vertices, float(track["focal_px"]), canvas.centre_px(track["centre_px"]))
        difference.add(verify_export.nerf_folder(_read(folder / frame["flame_param_path"]), flame, frame), vertices, pixels)
    return _verdict(job.final.vhap, difference)


def _read(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files if name != "tex_extra"}


def _verdict(path: Path, difference: verify_export.Difference, allowed_px: float = 0.0) -> dict[str, Any]:
    """The report's entry of a file that is right.

    Raises:
        StepError: it is not.
    """
    limit_px = LIMIT_PX + allowed_px
    if not (difference.vertex_mm <= LIMIT_MM and difference.pixel_px <= limit_px):
        raise step.StepError(
            f"{path}: posed again from the written file, the head lies {difference.vertex_mm:.3g} mm and "
            f"{difference.pixel_px:.3g} px from the track's (limits {LIMIT_MM} mm, {limit_px:.3g} px); "
            "this is a fault of the export, please report it"
        )
    return {
        "frames": difference.frames,
        "vertices_max_mm": round(difference.vertex_mm, 6),
        "pixels_max_px": round(difference.pixel_px, 6),
    }


def _loss(head: HeadModel, before: dict[str, np.ndarray], after: dict[str, np.ndarray], names: Iterable[str]) -> dict[str, Any]:
    """How far vertices lie from where they should be because a format cannot say it: frames concerned, largest and mean mm."""
    changed = [np.abs(after[name] - before[name]).reshape(len(before["usable"]), -1).max(1) for name in names]
    concerned = np.flatnonzero(np.max(changed, 0) > 1e-7)
    largest = total = 0.0
    for rows in verify_export.chunks(concerned):
        moved = np.linalg.norm(export_pose.vertices(head, after, rows) - export_pose.vertices(head, before, rows), axis=-1)
        largest, total = max(largest, 1000 * float(moved.max())), total + 1000 * float(moved.mean(1).sum())
    mean = total / len(concerned) if len(concerned) else 0.0
    return {"frames": len(concerned), "max_mm": round(largest, 4), "mean_mm": round(mean, 5)}


def _report(
    head: HeadModel,
    track: dict[str, np.ndarray],
    pose: FlamePose,
    parts: dict[str, list[int]],
    canvas: export_vhap.Canvas,
    off_centre: np.ndarray,
    checked: dict[str, dict[str, Any]],
) -> dict[str, Any]:
    """export.json: what was written, what it cannot hold, how well what is written was read back."""
    plain = export_pose.without_eyelids(head, track)
    eyelids = _loss(head, track, plain, ["expression"])
    limits = {part: _loss(head, plain, _limited(head, plain, pose, [part]), [part]) for part in export_nha.LIMITS_DEG}
    found = head.version or "unnamed"
    codes = lambda name: {"expects": f"FLAME {EXPECTED[name]}", "found": found, "same": EXPECTED[name] == found}  # noqa: E731
    usable = track["usable"]
    return {
        "head": {
            "name": head.name,
            "version": head.version,
            "source": head.source,
            "digest": head.digest,
            "licence": head.licence,
        },
        "licence_note": LICENCE_NOTE,
        "frames": len(usable),
        "unusable_frames": np.flatnonzero(~usable).tolist(),
        "nha": {
            "format": "NHA tracked_flame_params.npz",
            "codes": codes("nha"),
            "lost": {"eyelids": eyelids} | limits,
            "verified": checked["nha"],
        },
        "vhap": {
            "format": "VHAP tracked_flame_params and GaussianAvatars NeRF folder",
            "codes": codes("vhap"),
            "pictures": {part: len(rows) for part, rows in parts.items()},
            "picture_size": [canvas.height, canvas.width],
            "padding_top_left_px": [canvas.top, canvas.left],
            "principal_point_off_middle_px": [round(float(value), 4) for value in off_centre],
            "lost": {"eyelids": eyelids},
            "verified": checked["vhap"],
        },
    }


if __name__ == "__main__":
    step.main(run, ExportConfig)
