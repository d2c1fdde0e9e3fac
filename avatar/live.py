"""An avatar made ready to draw frames of new parameters, one after the other, as fast as it goes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from avatar.features import Condition
from avatar.layered.model import SAMPLES, LayeredAvatar
from avatar.layered.posing import PosedHead, Poser
from avatar.layered.runtime import Runtime
from avatar.networks import best_precision
from avatar.uses.sequence import Camera
from avatar.view import View
from fitting.head_model import HeadModel


class Live:
    """One avatar, one identity, one camera; not for two threads at once.

    A layered avatar on the CPU is drawn by its compiled pass (`avatar.layered.runtime`), every other by its own `picture`.
    """

    def __init__(
        self,
        avatar: torch.nn.Module,
        head: HeadModel,
        shape: np.ndarray,
        camera: Camera,
        precision: torch.dtype | None = None,
        device: str = "cpu",
        samples: int = SAMPLES,
    ) -> None:
        """shape: [S] of the identity; precision: of the networks, None takes the device's best; samples: 1 or 2 of a pixel that
        the compiled pass draws.
        """
        self._avatar, self._camera, self._device = avatar, camera, device
        self._precision = best_precision(device) if precision is None else precision
        self._poser = Poser(head, shape)
        self._neutral = torch.from_numpy(self._poser.neutral_m).to(device)
        self._runtime = None
        if isinstance(avatar, LayeredAvatar) and torch.device(device).type == "cpu":
            self._runtime = Runtime(avatar, self._poser.neutral_m, camera, self._precision, samples)
        self.milliseconds: dict[str, float] = {}
        """Of the last frame: its stages (pose, networks, raster, draw; only pose and draw of an avatar that is not layered), and
        all of it (frame), less than the sum where stages ran beside each other."""

    def frame(self, row: Mapping[str, Any] | Any) -> np.ndarray:
        """One picture, uint8 [H, W, 3], red, green, blue on white; the caller's own.

        row: a mapping, or a named tuple or other object with attributes, of expression [E], rotation [3], neck [3], jaw [3],
        eyes [2, 3] (axis-angle, rad) and translation [3] (m), as one frame of fit/track.npz.
        Raises ValueError naming what is missing, has another shape or is not finite, or where the picture is not finite.
        """
        started = time.perf_counter()
        head = self._poser.pose(row if isinstance(row, Mapping) else _Attributes(row))
        posed = 1e3 * (time.perf_counter() - started)
        if self._runtime is not None:
            image = self._runtime.frame(head)
            self.milliseconds = self._runtime.milliseconds | {"pose": self._runtime.milliseconds["pose"] + posed}
        else:
            image, self.milliseconds = self._pictured(head, posed)
        self.milliseconds["frame"] = 1e3 * (time.perf_counter() - started)
        return image

    def _pictured(self, head: PosedHead, before: float) -> tuple[np.ndarray, dict[str, float]]:
        """By the avatar's own `picture`; before: ms spent so far."""
        started = time.perf_counter()
        displacement, codes = (torch.from_numpy(part)[None].to(self._device) for part in (head.displacement_m, head.codes))
        vertices = torch.from_numpy(head.vertices_m)[None].to(self._device)
        view = View(self._camera.focal_px, self._camera.centre_px, head.rotation, head.offset_m, self._camera.size)
        with torch.inference_mode():
            posed = self._avatar.pose(vertices, Condition(displacement, codes, self._neutral))
            middle = time.perf_counter()
            rendered, _ = self._avatar.picture(posed, view, self._precision)
        if not torch.isfinite(rendered.colour).all():
            raise ValueError("the picture is not finite; train the avatar again")
        image = (rendered.colour.clamp(0, 1) * 255 + 0.5).byte().cpu().numpy().reshape(*self._camera.size, 3)
        done = time.perf_counter()
        return image, {"pose": before + 1e3 * (middle - started), "draw": 1e3 * (done - middle)}


class _Attributes(Mapping):
    """An object's attributes as a mapping."""

    def __init__(self, row: Any) -> None:
        self._row = row

    def __getitem__(self, name: str) -> Any:
        return getattr(self._row, name)

    def __contains__(self, name: object) -> bool:
        return hasattr(self._row, str(name))

    def __iter__(self):  # noqa: ANN204
        return iter(())

    def __len__(self) -> int:
        return 0
