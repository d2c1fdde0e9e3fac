"""Adam on one frame's unknowns: the recipe of Neural Head Avatars' tracker (50 steps a frame), to compare speed and error with.

It minimises the same energy with the same gradients as `fitting.solver`; only the way down differs.
"""

from __future__ import annotations

import numpy as np

from fitting.energy import Problem
from fitting.rig import Pose

RATE, TRANSLATION_RATE = 5e-3, 1e-3  # NHA's learning rates
BETAS, EPSILON = (0.9, 0.999), 1e-8


def solve_frame(problem: Problem, pose: Pose, steps: int) -> tuple[Pose, float, int]:
    """Run Adam with a new optimiser state, as NHA does in each frame; returns pose, cost, steps.

    Raises:
        FloatingPointError: the cost at the start is not finite.
    """
    rate = np.full(len(problem.free), RATE)
    rate[3:6] = TRANSLATION_RATE
    mean, square = np.zeros(len(rate)), np.zeros(len(rate))
    cost = np.inf
    for step in range(1, steps + 1):
        cost, evaluated = problem.evaluate(pose)
        if not np.isfinite(cost):
            raise FloatingPointError("the cost of a frame is not finite")
        gradient = problem.gradient(pose, evaluated)
        mean = BETAS[0] * mean + (1 - BETAS[0]) * gradient
        square = BETAS[1] * square + (1 - BETAS[1]) * gradient**2
        way = (mean / (1 - BETAS[0] ** step)) / (np.sqrt(square / (1 - BETAS[1] ** step)) + EPSILON)
        pose = pose.moved(-rate * way)
    return pose, cost, steps
