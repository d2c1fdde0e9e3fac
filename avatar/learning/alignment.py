"""Small corrections of the head's pose in each training frame, so that tracking error does not blur what is learned.

Direct alignment: the render of a step is moved rigidly until it lies on the frame, one damped Gauss-Newton step at a time, with a
prior that holds the correction near zero. At test there is none; their mean over the frames is taken out, for else the textures
would follow a drift that the test frames do not have.
"""

from __future__ import annotations

import cv2
import numpy as np

from avatar.view import View
from fitting.camera import exp_rotation

PRIOR = np.array([0.006, 0.006, 0.006, 0.0007, 0.0007, 0.003])  # standard deviations: turn in rad, shift in m (lateral, depth)
NOISE = 0.05  # of a colour's residual, in [0, 1]; what one crop says counts as one pixel in CORRELATED
CORRELATED = 15.0
SOLID = 0.9  # opacity of a pixel that takes part
OUTLIER = 0.1  # residuals beyond it count as this
GAIN = 0.5  # of a step that is taken: another window of the frame says something else
SMOOTH_PX = 1.0
STRIDE = 2  # every other pixel of every other row: neighbours say the same


class Alignment:
    """Corrections of T frames: a turn about the head's middle and a shift, in camera axes."""

    def __init__(self, frames: int) -> None:
        """No correction yet."""
        self.moves = np.zeros((frames, 6))

    def applied(self, place: int, view: View, middle_m: np.ndarray) -> View:
        """The corrected view of frame `place`; middle_m: [3] the head's, in the head frame."""
        move = self.moves[place] - self.moves.mean(0)
        turn, pivot = exp_rotation(move[:3]), view.rotation @ middle_m + view.offset_m
        return view._replace(rotation=turn @ view.rotation, offset_m=turn @ (view.offset_m - pivot) + pivot + move[3:])

    def learn(
        self, place: int, view: View, middle_m: np.ndarray, image: np.ndarray, depth_m: np.ndarray, truth: np.ndarray
    ) -> None:
        """One step for frame `place` from a window of it.

        view: the window's, corrected; image: [h, w, 4] its render; depth_m: [h, w]; truth: [h, w, 3].
        """
        smooth, wanted = (cv2.GaussianBlur(part, (0, 0), SMOOTH_PX) for part in (image[..., :3], truth))
        across, down = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=1, scale=0.5) for order in ((1, 0), (0, 1)))
        solid = (image[..., 3] > SOLID) & (depth_m > 0) & np.isfinite(smooth).all(-1)
        solid[[0, -1]], solid[:, [0, -1]] = False, False
        kept = np.zeros_like(solid)
        kept[::STRIDE, ::STRIDE] = solid[::STRIDE, ::STRIDE]
        solid = kept
        rows, columns = np.nonzero(solid)
        if not len(rows):
            return
        z = depth_m[solid].astype(np.float64)
        ray = (np.stack([columns, rows], -1) + 0.5 - view.centre_px) / view.focal_px
        point = np.concatenate([ray * z[:, None], z[:, None]], 1) - (view.rotation @ middle_m + view.offset_m)
        # A turn w and a shift t move a point by w x point + t, its pixel by focal / z (that, less its depth along the ray).
        zero = np.zeros(len(z))
        motion = np.stack(
            [
                np.stack([zero, point[:, 2], -point[:, 1], zero + 1, zero, zero], -1),
                np.stack([-point[:, 2], zero, point[:, 0], zero, zero + 1, zero], -1),
                np.stack([point[:, 1], -point[:, 0], zero, zero, zero, zero + 1], -1),
            ],
            1,
        )  # [n, 3, 6]
        pixels = view.focal_px / z[:, None, None] * (motion[:, :2] - ray[..., None] * motion[:, 2:])  # [n, 2, 6]
        slope = np.stack([across[solid], down[solid]], -1).astype(np.float64)  # [n, 3, 2]
        jacobian = -np.einsum("nck,nkm->ncm", slope, pixels).reshape(-1, 6)
        residual = np.clip((wanted - smooth)[solid].astype(np.float64), -OUTLIER, OUTLIER).ravel()
        weight = 1 / (NOISE**2 * CORRELATED)
        prior = np.diag(1 / PRIOR**2)
        matrix, right = weight * jacobian.T @ jacobian + prior, weight * jacobian.T @ residual - prior @ self.moves[place]
        move = GAIN * np.linalg.solve(matrix, right)
        if np.isfinite(move).all():  # one bad window must not turn every frame, by way of the mean
            self.moves[place] += move
