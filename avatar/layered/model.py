"""The layered avatar: a stack of textured surfaces that move with the head, each pixel composited by its own depth order.

What LegacyAvatars and BakedAvatar bake from a trained field is trained here directly; the dynamic part comes from the same
displacement -> convolutional network in UV as the paper's Ours-D (section 3.2). Letters: L layers, V vertices, R texels a side of
a texture, r of a frame's map, K bases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from avatar.features import Condition
from avatar.layered import composite, packing, raster, shells
from avatar.layered.layout import layout
from avatar.layered.raster import Fragments
from avatar.networks import UNet
from avatar.uv import rasterise
from avatar.view import View
from avatar.volume import Rendered
from fitting.head_model import HeadModel
from fitting.raster import vertex_normals

FADE, ASIDE = 8.0, 0.5  # logits of opacity that a shell loses at first when seen edge on, and the cosine from which it does
FADING, UNIT = 10.0, 0.5413  # how far a step moves a place's own factor on that, and what makes the factor 1 at first
LARGEST_MOVE = 0.03  # of a fetch in UV: what tracking and shape are wrong by, never another part of the face
MOVES_M = 0.003  # expressions move the skin by millimetres: inputs of about one
WIDTH = 64  # channels of the U-Net's output
START = 0.02  # standard deviation of the output layer's weights: at the start the static texture is all there is
LEARNED = ("unet.", "out.", "fading")  # entries of the state that a file holds as the networks'
SAMPLES = 2  # of a pixel, in training too: with one, rims of shells and what is seen edge on are ragged
BASIS_START = 0.01  # of the bases: a basis of zeros would never get a gradient, nor its weight


@dataclass
class Posed:
    """One posed head."""

    layers_m: np.ndarray  # [L, V, 3] float32, where each layer's vertices are
    normals: np.ndarray  # [V, 3] float32
    condition: Condition


class LayeredAvatar(nn.Module):
    """Displacement -> U-Net -> maps; textures and maps -> pixels."""

    precision = torch.float32  # of `picture`, whatever is asked for; `avatar.live` draws in others

    def __init__(self, settings: dict, head: HeadModel) -> None:
        """settings: `layers`, `bases`, `texture_size` and `uv_size`; see `avatar.build.settings_of`."""
        super().__init__()
        count, bases, side = settings["layers"], settings["bases"], settings["texture_size"]
        self.head, self.count, self.bases = head, count, bases
        self.triangles = head.triangles.cpu().numpy().astype(np.int32)
        self.corner_uv, self.drawn = layout(head), shells.drawn(head, count)  # [F, 3, 2], [L, F]
        for name, part in (("skin", self.drawn[0]), ("inner", self.drawn[-1])):
            corners, barycentric = self._map_of(part, settings["uv_size"])
            self.register_buffer(f"{name}_corners", corners, persistent=False)  # [r, r, 3] vertices
            self.register_buffer(f"{name}_barycentric", barycentric, persistent=False)
        self.register_buffer("thickness_m", torch.zeros(head.vertex_count))
        self.register_buffer("offsets_m", torch.zeros(count, head.vertex_count))
        textures = torch.zeros(count, side, side, composite.texture_channels(bases))
        textures[..., 4:] = torch.randn(textures[..., 4:].shape) * BASIS_START
        self.register_buffer("textures", textures)  # trained by `texel_adam`
        # What each place of each shell that is not beneath the skin makes of FADE.
        self.fading = nn.Parameter(torch.zeros(count - 2, settings["uv_size"], settings["uv_size"]))
        self.unet = UNet(9, WIDTH)
        self.out = nn.Conv2d(WIDTH, count * composite.map_channels(bases), 1)
        nn.init.normal_(self.out.weight, std=START)
        nn.init.zeros_(self.out.bias)

    def _map_of(self, part: np.ndarray, side: int) -> tuple[Tensor, Tensor]:
        """Vertices and their shares [r, r, 3] at the texels of a map, of the triangles `part` [F] bool; zeros for none."""
        if not part.any():
            return torch.zeros(side, side, 3, dtype=torch.int64), torch.zeros(side, side, 3)
        corners = self.corner_uv[part].reshape(-1, 2).astype(np.float64)
        face, barycentric = rasterise(corners, np.arange(len(corners)).reshape(-1, 3), side)
        return torch.from_numpy(self.triangles[part].astype(np.int64)[face]), torch.from_numpy(barycentric).float()

    def read(self, attributes: Tensor, part: str) -> Tensor:
        """Attributes [V, N] of vertices in the map [N, r, r] of the `skin` or of the `inner` parts."""
        corners, shares = self.get_buffer(f"{part}_corners"), self.get_buffer(f"{part}_barycentric")
        return (attributes[corners] * shares[..., None]).sum(2).permute(2, 0, 1)

    def shape_shell(self, thickness_m: Tensor) -> None:
        """Place the layers: thickness [V] m of what stands off the mesh."""
        self.thickness_m = thickness_m.to(self.thickness_m)
        self.offsets_m = torch.from_numpy(shells.offsets(self.head, self.thickness_m.cpu().numpy(), self.count)).to(
            self.offsets_m
        )

    def place_shells(self, surface_m: np.ndarray) -> None:
        """Move shells close to a surface, [V] m above the skin, NaN where it is not known; see `avatar.layered.shells.around`."""
        self.offsets_m = torch.from_numpy(shells.around(self.head, self.offsets_m.cpu().numpy(), surface_m)).to(self.offsets_m)

    def packed(self) -> dict:
        """What a file of this avatar holds, a few megabytes; see `avatar.layered.packing`."""
        networks = {name: value.bfloat16() for name, value in self.state_dict().items() if name.startswith(LEARNED)}
        return {
            "thickness_m": self.thickness_m,
            "offsets_m": self.offsets_m,
            "textures": packing.packed_textures(self.textures.cpu()),
            "networks": networks,
        }

    def unpack(self, stored: dict) -> None:
        """Take over what `packed` gave. Raises ValueError, RuntimeError or KeyError when it does not fit."""
        self.textures = packing.unpacked_textures(stored["textures"], tuple(self.textures.shape)).to(self.textures.device)
        networks = {name for name in self.state_dict() if name.startswith(LEARNED)}
        found = {"fading": torch.zeros_like(self.fading)} | stored["networks"]  # files of before it was learned have none
        if networks != set(found):
            raise KeyError(f"the file's network has other layers: {sorted(networks ^ set(found))[:3]}")
        self.load_state_dict(self.state_dict() | {name: value.float() for name, value in found.items()})
        self.thickness_m = stored["thickness_m"].to(self.thickness_m)
        self.offsets_m = stored["offsets_m"].to(self.offsets_m)

    def sharpen(self, factor: float) -> None:
        """Nothing: there are no samples along a ray to multiply."""

    def pose(self, vertices_m: Tensor, condition: Condition) -> Posed:
        """The layers of one posed head, vertices [1, V, 3]."""
        vertices = vertices_m[0].cpu().numpy()
        normals = vertex_normals(vertices, self.triangles).astype(np.float32)
        return Posed(vertices + self.offsets_m.cpu().numpy()[..., None] * normals, normals, condition)

    def told(self, posed: Posed, view: View) -> Tensor:
        """What the network is told of a frame, [10, r, r]: displacement (3) and turn (3) of the skin, displacement of the inner
        parts (3), and the cosine under which the skin is seen, which it does not read.

        The turn is how a place's normal differs from a frontal head's, and so its turn to the light, which stands still.
        """
        towards = view.rotation.T @ -view.offset_m - posed.layers_m[-1]  # camera's centre in the head frame, less the vertex
        facing = (posed.normals * towards).sum(-1, keepdims=True) / np.linalg.norm(towards, axis=-1, keepdims=True)
        turned = np.concatenate([posed.normals @ (view.rotation.T - np.eye(3)), facing], 1).astype(np.float32)
        displacement = posed.condition.displacement_m[0] / MOVES_M
        skin = self.read(torch.cat([displacement, torch.from_numpy(turned).to(displacement.device)], -1), "skin")  # [7, r, r]
        return torch.cat([skin[:6], self.read(displacement, "inner"), skin[6:]])

    def maps(self, posed: Posed, view: View, told: Tensor | None = None) -> Tensor:
        """A frame's maps [L, r, r, D], with gradients; told: instead of the frame's own.

        Shells that stand off the skin fade out where they are seen from the side: their outlines would be hard edges in the air.
        Where hair ends at the shell itself, as a place learns from the views that show it edge on, it stays.
        """
        told = self.told(posed, view) if told is None else told
        maps = self.out(self.unet(told[None, :-1])).unflatten(1, (self.count, -1))[0].permute(0, 2, 3, 1)
        move, colour, opacity, weights = maps.split([composite.MOVE, 3, 1, self.bases], -1)
        aside = 1 - torch.clamp(told[-1] / ASIDE, 0, 1)
        fade = FADE * aside.square() * functional.softplus(FADING * self.fading + UNIT)
        fade = torch.cat([fade, fade.new_zeros(self.count - len(fade), *fade.shape[1:])])[..., None]
        return torch.cat([LARGEST_MOVE * torch.tanh(move), colour, opacity - fade, weights], -1)

    def fragments(self, posed: Posed, view: View, samples: int = 1) -> Fragments:
        """What each layer shows to each sample of each pixel; see `avatar.layered.raster.rasterise`."""
        if samples == 1 or view.stride == 1:
            points, window = view.pixels_of(posed.layers_m).astype(np.float32), (0, 0, view.size[1], view.size[0])
            return raster.rasterise(points, self.triangles, self.corner_uv, self.drawn, window, samples=samples)
        moves = np.array([0.25, -0.25]) / view.stride  # where pixels are left out, both samples lie close to its centre
        each = [self.fragments(posed, view._replace(centre_px=view.centre_px + move)) for move in moves]
        return Fragments(*(np.stack(parts, 2).reshape(self.count, -1, *parts[0].shape[2:]) for parts in zip(*each, strict=True)))

    @torch.no_grad()
    def picture(self, posed: Posed, view: View, precision: torch.dtype) -> tuple[Rendered, int]:
        """All pixels of a view, row by row, and how many texels were asked for."""
        maps, fragments = self.maps(posed, view), self.fragments(posed, view, SAMPLES)
        if maps.device.type == "cpu":
            image, depth, count = composite.composite(self.textures, maps, fragments)
        else:
            there = Fragments(*(torch.from_numpy(part).to(maps.device) for part in fragments))
            image, depth, count = composite.reference(self.textures, maps, there)
        image, depth = composite.averaged(image, depth, SAMPLES)
        rows, columns = np.mgrid[: view.size[0], : view.size[1]] + 0.5
        slant = np.sqrt(1 + ((np.stack([columns, rows], -1) - view.centre_px) ** 2).sum(-1) / view.focal_px**2)
        along = depth.cpu() * torch.from_numpy(slant.astype(np.float32))
        return Rendered(image[..., :3].reshape(-1, 3).cpu(), image[..., 3].reshape(-1).cpu(), along.reshape(-1)), count
