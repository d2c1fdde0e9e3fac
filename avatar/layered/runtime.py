"""A layered avatar made ready to be drawn frame after frame on the CPU: 8-bit textures, buffers, the network in its best type."""

from __future__ import annotations

import copy
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor, nn

from avatar.features import Condition
from avatar.layered import posing, threads
from avatar.layered.draw import draw, quantised
from avatar.layered.model import LayeredAvatar, Posed
from avatar.layered.posing import PosedHead
from avatar.layered.raster import Fragments, rasterise
from avatar.uses.sequence import Camera
from avatar.view import View


class Lowered(nn.Module):
    """A copy of a network in another type, channels last in memory: the fastest way through small convolutions on a CPU."""

    def __init__(self, network: nn.Module, precision: torch.dtype) -> None:
        super().__init__()
        self.precision = precision
        self.network = copy.deepcopy(network).to(precision, memory_format=torch.channels_last)

    def forward(self, maps: Tensor) -> Tensor:
        """maps: [B, C, H, W] float32. Returns the network's output as float32, in the order of its axes."""
        return self.network(maps.to(self.precision, memory_format=torch.channels_last)).float().contiguous()


class Runtime:
    """One layered avatar before one camera."""

    def __init__(
        self, avatar: LayeredAvatar, neutral_m: np.ndarray, camera: Camera, precision: torch.dtype, samples: int
    ) -> None:
        """neutral_m: [V, 3] of the subject; precision: of the convolutions; samples: of a pixel, 1 or 2."""
        self._samples = samples
        self._avatar = copy.copy(avatar)
        self._avatar._modules = avatar._modules | {"unet": Lowered(avatar.unet, precision)}
        self._textures = quantised(avatar.textures.cpu().numpy())
        self._offsets = np.ascontiguousarray(avatar.offsets_m.cpu().numpy(), np.float32)
        self._neutral = torch.from_numpy(neutral_m)
        self._focal, self._centre, self._size = float(camera.focal_px), np.asarray(camera.centre_px, np.float64), camera.size
        self._memory: dict[str, np.ndarray] = {}
        self._beside = ThreadPoolExecutor(1, "networks")
        self.milliseconds: dict[str, float] = {}

    def frame(self, head: PosedHead) -> np.ndarray:
        """[H, W, 3] uint8, red, green, blue on white. The network runs beside the rasteriser."""
        started = time.perf_counter()
        normals = posing.normals(head.vertices_m, self._avatar.triangles)
        where = np.ascontiguousarray(head.rotation), np.ascontiguousarray(head.offset_m), self._focal, self._centre
        places, points, box = posing.layers(head.vertices_m, normals, self._offsets, *where)
        condition = Condition(torch.from_numpy(head.displacement_m)[None], torch.from_numpy(head.codes)[None], self._neutral)
        view = View(self._focal, self._centre, head.rotation, head.offset_m, self._size)
        self.milliseconds = {"pose": 1e3 * (time.perf_counter() - started)}
        together = threads.count() > 1
        waiting = self._beside.submit(self._maps, Posed(places, normals, condition), view) if together else None
        started = time.perf_counter()
        window = _window(box, self._size)
        fragments = self._fragments(points, window, max(1, threads.count() - 1))
        self.milliseconds["raster"] = 1e3 * (time.perf_counter() - started)
        maps = waiting.result() if waiting else self._maps(Posed(places, normals, condition), view)
        started = time.perf_counter()
        left, top, width, height = window
        picture = np.full((*self._size, 3), 255, np.uint8)
        drawn = draw(self._textures, maps, fragments, self._buffer("drawn", (height, width, 4), np.uint8), samples=self._samples)
        picture[top : top + height, left : left + width] = drawn[..., :3]
        self.milliseconds["draw"] = 1e3 * (time.perf_counter() - started)
        return picture

    def _maps(self, posed: Posed, view: View) -> np.ndarray:
        """The frame's maps [L, r, r, D], by one thread: more wait for each other longer than they compute."""
        started, before = time.perf_counter(), torch.get_num_threads()
        if before > 1:
            torch.set_num_threads(1)
        try:
            with torch.inference_mode():
                maps = self._avatar.maps(posed, view).numpy()
        finally:
            if before > 1:
                torch.set_num_threads(before)
        self.milliseconds["networks"] = 1e3 * (time.perf_counter() - started)
        return maps

    def _fragments(self, points: np.ndarray, window: tuple[int, int, int, int], shares: int) -> Fragments:
        shape = len(points), self._samples * window[3], window[2]
        out = Fragments(self._buffer("depth", shape), self._buffer("uv", (*shape, 2)))
        avatar = self._avatar
        return rasterise(points, avatar.triangles, avatar.corner_uv, avatar.drawn, window, out, shares, self._samples)

    def _buffer(self, name: str, shape: tuple[int, ...], kind: type = np.float32) -> np.ndarray:
        """Memory of the last frames, as an array of a shape: fresh pages cost more than what is written to them."""
        count = int(np.prod(shape))
        if name not in self._memory or self._memory[name].size < count:
            self._memory[name] = np.zeros(count + count // 4, kind)
        return self._memory[name][:count].reshape(shape)


def _window(box: tuple[float, float, float, float], size: tuple[int, int]) -> tuple[int, int, int, int]:
    """x, y, width, height of the pixels of a picture (H, W) that a box (left, top, right, bottom in px) touches."""
    left, right = (int(np.clip(edge, 0, size[1])) for edge in (np.floor(box[0]), np.ceil(box[2])))
    top, bottom = (int(np.clip(edge, 0, size[0])) for edge in (np.floor(box[1]), np.ceil(box[3])))
    return left, top, max(0, right - left), max(0, bottom - top)
