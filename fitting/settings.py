"""The fit's constants: standard deviations and limits, chosen on training frames of real clips and on simulated clips with truth.

What a user may change stands in `fitting.config`; these belong to the method.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fitting.bundle import Smoothness
from fitting.config import TermWeights
from fitting.energy import Weights
from fitting.pictures import Strength

WEIGHTS = Weights(
    landmark_sigma=0.012,
    robust_sigmas=3.0,
    correlated=8.0,
    iris=1.0,
    eyelid_sigma=0.02,
    expression_sd=0.3,
    statistical_sd=1.0,
    action_wall_sd=0.03,
    gaze_sd_rad=np.radians(15),
    vergence_sd_rad=np.radians(2),
    shut_gaze_sd_rad=np.radians(0.5),
    jaw_sd_rad=(np.radians(15), np.radians(2), np.radians(2)),
    jaw_wall_rad=np.radians(-3),
    log_focal_sd=0.3,
    shape_sd=1.0,
    shape_wall=2.5,
    shape_wall_sd=0.15,
)
SMOOTHNESS = Smoothness(
    rotation_rad=np.radians(0.4), across_m=0.0005, depth_m=0.001, expression=0.15, gaze_rad=np.radians(4), jaw_rad=np.radians(2)
)
BUNDLE_ITERATIONS = 2
BIAS_SD_M = 0.0025  # landmarks slide over the surface from one identity to the next (simulated clips)
FOCAL_OF_LONG_SIDE = 1.2  # prior of focal length over the longer source side (45 degrees)
MAX_FOCAL_SD = 0.15
ANOTHER_FACE = 2.5  # a stretch between two cuts whose median error is this many times the clip's shows somebody else
LOST_OF_MEDIAN, LOST_OF_EYES = 4.0, 0.05  # a frame this much worse than the median, and this bad, is lost
SAMPLES = 2000
PIXEL_ITERATIONS = 3  # a level of the photometric pyramid
SILHOUETTE_ROUNDS = 3  # the rim is found anew this often
STRENGTH = Strength(
    photometric=0.08,  # stronger, lids close further and brows follow wrinkles, but the head turns with what the shape has wrong
    photometric_robust=3.0,
    photometric_rigid=0.3,
    silhouette=0.05,
    silhouette_sigma=0.01,
    silhouette_robust=3.0,
)


def weights(terms: TermWeights) -> Weights:
    """Standard deviations with the terms' weights from config in them: a weight w divides a variance."""
    return replace(
        WEIGHTS,
        landmark_sigma=WEIGHTS.landmark_sigma / np.sqrt(terms.landmarks),
        iris=terms.irises,
        eyelid_sigma=WEIGHTS.eyelid_sigma / np.sqrt(max(terms.eyelids, 1e-12)),
        expression_sd=WEIGHTS.expression_sd / np.sqrt(max(terms.priors, 1e-12)),
        statistical_sd=WEIGHTS.statistical_sd / np.sqrt(max(terms.priors, 1e-12)),
    )


def strength(terms: TermWeights) -> Strength:
    """The pixel terms with their weights from config."""
    return replace(
        STRENGTH,
        photometric=STRENGTH.photometric * terms.photometric,
        silhouette=STRENGTH.silhouette * terms.silhouette,
    )
