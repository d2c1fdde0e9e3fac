"""Step: bake the head model into one file and place the detector's landmarks on it.

    python -m fitting.head --input landmarker=resources/assets/face_landmarker.task \\
        --output head=resources/heads/anny.npz report=resources/heads/anny.json

With `--config '{"model": "flame", "path": "FILE"}'` the inputs `model`, and where given `uv`, `masks` and `landmark_embedding`,
are the user's own files.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from fitting import correspondence, habits
from fitting.config import HeadConfig
from fitting.detection import FaceFinder
from fitting.head_model import HeadModel
from workflow import step

# By name, so that an edit of one source does not bake the other again (the rule adds the module to its code digest).
SOURCES = {"anny": "fitting.anny_head", "flame": "fitting.flame"}
SHAPE_COMPONENTS = {"anny": 80, "flame": 100}


def run(job: step.Job) -> None:
    """Bake identity and expression spaces, place the 478 landmarks, report the residual of the placement."""
    count = job.config.shape_components or SHAPE_COMPONENTS[job.config.model]
    source = importlib.import_module(SOURCES[job.config.model])
    try:
        head = _flame(job, source, count) if job.config.model == "flame" else source.bake(count, job.config.samples)
    except ValueError as error:
        raise step.StepError(str(error)) from error
    job.log.info(
        "baked %d vertices, %d identity and %d expression components",
        head.vertex_count,
        len(head.shape_basis),
        len(head.expression_basis),
    )
    with FaceFinder(job.input.landmarker.read_bytes(), video=False, max_faces=1) as finder:
        try:
            placed = correspondence.place(head, lambda image: next((face.points for face in finder.find(image)), None))
        except ValueError as error:
            raise step.StepError(f"{getattr(job.input, 'model', head.name)}: {error}") from error
    given = _given_landmarks(job, source, head, placed)
    head = dataclasses.replace(
        head,
        landmark_triangles=torch.from_numpy(placed.triangles),
        landmark_barycentric=torch.from_numpy(placed.barycentric.astype(np.float32)),
    )
    head = dataclasses.replace(head, digest=head.content_digest())
    with FaceFinder(job.input.landmarker.read_bytes(), video=False, max_faces=1) as finder:
        look = lambda image: next((face.points for face in finder.find(image)), None)  # noqa: E731
        learned = habits.learn(head, look, job.config.renders)
    job.log.info(
        "landmarks off by %.2f mm as fixed points, %.2f mm with the detector's habits", learned.before_mm, learned.after_mm
    )
    head = dataclasses.replace(
        head,
        landmark_slide=torch.from_numpy(learned.slide.astype(np.float32)),
        landmark_sigma=torch.from_numpy(learned.sigma_m.astype(np.float32)),
    )
    head.save(job.output.head)
    job.write_json(job.output.report, _report(head, placed, given, learned))


def _flame(job: step.Job, flame: ModuleType, shape_components: int) -> HeadModel:
    """The user's FLAME file, with what else of FLAME they have."""
    path: Path = job.input.model
    arrays = flame.read(path)
    uv, masks = getattr(job.input, "uv", None), getattr(job.input, "masks", None)
    texture = flame.read_texture(uv, arrays["f"]) if uv else None
    with open(path, "rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    try:
        return flame.bake(
            arrays,
            shape_components,
            job.config.expression_components,
            jaw=job.config.jaw if job.config.jaw is not None else "no_jaw" not in path.name.lower(),
            cavity=job.config.mouth_cavity,
            texture=texture,
            masks=flame.read_masks(masks) if masks else None,
            version=flame.version_of(path.name, arrays["open"]),
            source=f"sha256 {sha256}",
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _given_landmarks(job: step.Job, flame: ModuleType, head: HeadModel, placed: correspondence.Placement) -> int:
    """Put the landmarks of the user's own embedding in the place of ours, irises excepted; returns how many it has."""
    path = getattr(job.input, "landmark_embedding", None)
    if not path:
        return 0
    try:
        index, triangle, weights = flame.read_embedding(path, len(head.triangles))
    except ValueError as error:
        raise step.StepError(str(error)) from error
    skin = index < correspondence.RIGHT_IRIS
    index = index[skin]
    placed.triangles[index], placed.barycentric[index] = triangle[skin], weights[skin]
    placed.spread_m[index] = np.nan
    return len(index)


def _report(head: HeadModel, placed: correspondence.Placement, given: int, learned: habits.Habits) -> dict:
    """What the step's JSON says."""
    spread_mm = placed.spread_m[placed.triangles >= 0] * 1e3
    spread_mm = spread_mm[np.isfinite(spread_mm)]
    return {
        "digest": head.digest,
        "name": head.name,
        "version": head.version,
        "source": head.source,
        "vertices": head.vertex_count,
        "landmarks_placed": int((placed.triangles >= 0).sum()),
        "landmarks_given": given,
        "landmarks_without_place": int((placed.triangles < 0).sum()),
        "views": placed.views,
        "landmark_residual_mm": {  # between views; the mean over the views is known to about spread / sqrt(views)
            "median_spread": round(float(np.median(spread_mm)), 3),
            "p90_spread": round(float(np.percentile(spread_mm, 90)), 3),
            "median_of_mean": round(float(np.median(spread_mm) / np.sqrt(placed.views)), 3),
        },
        "detector_habits_mm": {  # rms of a landmark on renders of random heads kept out of the regression, median over landmarks
            "as_fixed_points": round(learned.before_mm, 3),
            "learned": round(learned.after_mm, 3),
            "renders": learned.renders,
        },
        "licence": head.licence,
    }


if __name__ == "__main__":
    step.main(run, HeadConfig)
