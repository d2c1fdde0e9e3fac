"""Step: bake the default head model into one file and place the detector's landmarks on it.

    python -m fitting.head --input landmarker=resources/assets/face_landmarker.task \\
        --output head=resources/heads/anny.npz report=resources/heads/anny.json
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from fitting import anny_head, correspondence
from fitting.config import HeadConfig
from fitting.detection import FaceFinder
from workflow import step


def run(job: step.Job) -> None:
    """Bake identity and expression spaces, place the 478 landmarks, report the residual of the placement."""
    head = anny_head.bake(job.config.shape_components, job.config.samples)
    job.log.info(
        "baked %d vertices, %d identity and %d expression components",
        head.vertex_count,
        len(head.shape_basis),
        len(head.expression_basis),
    )
    with FaceFinder(job.input.landmarker.read_bytes(), video=False, max_faces=1) as finder:
        placed = correspondence.place(head, lambda image: next((face.points for face in finder.find(image)), None))
    head = dataclasses.replace(
        head,
        landmark_triangles=torch.from_numpy(placed.triangles),
        landmark_barycentric=torch.from_numpy(placed.barycentric.astype(np.float32)),
    )
    head = dataclasses.replace(head, digest=anny_head.digest(head))
    head.save(job.output.head)
    spread_mm = placed.spread_m[placed.triangles >= 0] * 1e3
    spread_mm = spread_mm[np.isfinite(spread_mm)]
    job.write_json(
        job.output.report,
        {
            "digest": head.digest,
            "vertices": head.vertex_count,
            "landmarks_placed": int((placed.triangles >= 0).sum()),
            "landmarks_without_place": int((placed.triangles < 0).sum()),
            "views": placed.views,
            "landmark_residual_mm": {  # between views; the mean over the views is known to about spread / sqrt(views)
                "median_spread": round(float(np.median(spread_mm)), 3),
                "p90_spread": round(float(np.percentile(spread_mm, 90)), 3),
                "median_of_mean": round(float(np.median(spread_mm) / np.sqrt(placed.views)), 3),
            },
            "licence": head.licence,
        },
    )


if __name__ == "__main__":
    step.main(run, HeadConfig)
