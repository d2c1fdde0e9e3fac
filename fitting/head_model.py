"""The head model: a linear 3D morphable model with five joints, whichever source it was baked from.

Axes are OpenCV's (x right in the image, y down, z forward) and a frontal head is the identity rotation: the face looks along
-z and the subject's left is +x.  Metres, radians.  The origin lies inside the head, so that rotations are well conditioned.
One letter an axis: T frames, V vertices, S shape and E expression coefficients, F triangles, U texture vertices, L landmarks.
"""

from __future__ import annotations

import hashlib
from dataclasses import MISSING, dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

JOINTS = ("root", "neck", "jaw", "left_eye", "right_eye")
PARENTS = (-1, 0, 1, 1, 1)
REGIONS = ("face", "scalp", "ears", "neck", "eyeballs", "mouth_cavity", "teeth", "tongue")


@dataclass(frozen=True)
class HeadModel:
    """One baked head model; `load` reads the file that the step `head` writes."""

    template: Tensor  # [V, 3] m, neutral mean head
    shape_basis: Tensor  # [S, V, 3] m per standard deviation
    expression_basis: Tensor  # [E, V, 3] m per unit
    expression_low: Tensor  # [E] lower end of each coefficient's range (0 for actions, -inf for a statistical basis)
    expression_high: Tensor  # [E] upper end
    expression_names: tuple[str, ...]  # E names
    pose_basis: Tensor  # [36 or 0, V, 3] m, correctives of the four non-root joint rotations (R - I, row-major)
    joints: Tensor  # [5, 3] m, rest joints of the template, order JOINTS
    joint_shape_basis: Tensor  # [S, 5, 3] m per standard deviation
    skinning_weights: Tensor  # [V, 5], rows sum to 1
    triangles: Tensor  # [F, 3] int64, outward by the right-hand rule in these axes
    uvs: Tensor  # [U, 2] in [0, 1], v upwards
    uv_triangles: Tensor  # [F, 3] int64 into uvs
    region: Tensor  # [V] int64 into REGIONS
    landmark_triangles: Tensor  # [L] int64, L = 478 MediaPipe points, -1 where a point has no place on the mesh
    landmark_barycentric: Tensor  # [L, 3], rows sum to 1
    name: str
    licence: str
    digest: str  # `content_digest()` of the finished model: stored in every track and avatar
    joint_expression_basis: Tensor | None = None  # [E, 5, 3] m per unit; None becomes zeros (joints that expressions leave alone)
    source: str = ""  # what it was baked from: sha256 of the user's file, or package and version
    version: str = ""  # of the source model, such as "2023 Open"
    landmark_slide: Tensor | None = None  # [L, 3, 1 + S + 2] m, the detector's habits (`fitting.habits`); None becomes zeros
    landmark_sigma: Tensor | None = None  # [L] m, what they leave unexplained; None becomes NaN: not known
    source_joints: Tensor | None = None  # [5] int64, number in the source file of each joint; None becomes 0, 1, 2, 3, 4

    def __post_init__(self) -> None:
        if self.joint_expression_basis is None:
            zeros = self.expression_basis.new_zeros(len(self.expression_basis), len(JOINTS), 3)
            object.__setattr__(self, "joint_expression_basis", zeros)
        if self.landmark_slide is None:
            features = 1 + len(self.shape_basis) + 2
            object.__setattr__(self, "landmark_slide", self.template.new_zeros(len(self.landmark_triangles), 3, features))
        if self.landmark_sigma is None:
            object.__setattr__(self, "landmark_sigma", self.template.new_full((len(self.landmark_triangles),), float("nan")))
        if self.source_joints is None:
            object.__setattr__(self, "source_joints", torch.arange(len(JOINTS)))

    @staticmethod
    def load(path: Path | str, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> HeadModel:
        """Read a baked head model (`.npz`, no pickles).

        Raises:
            ValueError: the file is not a baked head model; the message names it.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            values = {}
            for item in fields(HeadModel):
                if item.name not in arrays and item.default is not MISSING:
                    continue  # baked before the field existed
                array = arrays[item.name]
                if array.dtype.kind == "U":
                    values[item.name] = tuple(array.tolist()) if array.ndim else str(array)
                else:
                    tensor = torch.from_numpy(array).to(device)
                    values[item.name] = tensor.to(dtype) if array.dtype.kind == "f" else tensor
        except Exception as error:
            raise ValueError(f"{path}: not a baked head model ({error}); delete it and run the step `head` again") from error
        return HeadModel(**values)

    def save(self, path: Path | str) -> None:
        """Write the model as a plain `.npz`."""
        arrays = {item.name: getattr(self, item.name) for item in fields(self)}
        np.savez_compressed(
            path,
            **{name: value.cpu().numpy() if isinstance(value, Tensor) else np.array(value) for name, value in arrays.items()},
        )

    def content_digest(self) -> str:
        """First 16 hex digits of the sha256 over what gives a track its meaning: names, geometry, ranges, texture layout.

        Reals are rounded to a millionth (a micrometre), so that BLAS kernels do not change it.
        """
        total = hashlib.sha256(" ".join(self.expression_names).encode())
        for array in (
            self.template,
            self.shape_basis,
            self.expression_basis,
            self.expression_low,
            self.expression_high,
            self.pose_basis,
            self.joints,
            self.joint_shape_basis,
            self.joint_expression_basis,
            self.skinning_weights,
            self.triangles,
            self.uvs,
            self.uv_triangles,
            self.region,
            self.landmark_triangles,
        ):
            values = array.cpu().numpy()
            if values.dtype.kind == "f":
                values = np.round(np.clip(values.astype(np.float64), -1e9, 1e9) * 1e6)  # a range may be infinite
            total.update(f"{values.shape}".encode() + values.astype(np.int64).tobytes())
        return total.hexdigest()[:16]

    @property
    def vertex_count(self) -> int:
        return self.template.shape[0]

    def shaped(self, shape: Tensor) -> Tensor:
        """Neutral head of one identity.

        Args:
            shape: [S] standard deviations.

        Returns:
            [V, 3] m.
        """
        return self.template + torch.einsum("s,svd->vd", shape, self.shape_basis)

    def joints_of(self, shape: Tensor, expression: Tensor | None = None) -> Tensor:
        """Rest joints of one identity, shape [S]: [5, 3] m, or [T, 5, 3] m under expressions [T, E] (FLAME's move its joints)."""
        rest = self.joints + torch.einsum("s,sjd->jd", shape, self.joint_shape_basis)
        return rest if expression is None else rest + torch.einsum("te,ejd->tjd", expression, self.joint_expression_basis)

    def local(
        self, shape: Tensor, expression: Tensor, jaw: Tensor, eyes: Tensor | None = None, neck: Tensor | None = None
    ) -> Tensor:
        """Posed vertices in the neck-normalised head frame (design note 3): `M^-1 V`.

        Args:
            shape: [S].
            expression: [T, E].
            jaw: [T, 3] axis-angle.
            eyes: [T, 2, 3] axis-angle, left then right; None leaves them neutral (the displacement that the U-Net reads).
            neck: [T, 3] axis-angle; None is a straight neck. Vertices that hang from the neck joint do not depend on it.

        Returns:
            [T, V, 3] m.
        """
        frames = expression.shape[0]
        zeros = expression.new_zeros(frames, 3)
        eyes = zeros[:, None].expand(frames, 2, 3) if eyes is None else eyes
        neck = zeros if neck is None else neck
        rotations = axis_angle_to_matrix(torch.stack([neck, jaw, eyes[:, 0], eyes[:, 1]], 1))  # [T, 4, 3, 3]
        posed = self.shaped(shape) + torch.einsum("te,evd->tvd", expression, self.expression_basis)
        if len(self.pose_basis):
            correctives = (rotations - torch.eye(3, dtype=rotations.dtype, device=rotations.device)).flatten(1)
            posed = posed + torch.einsum("tp,pvd->tvd", correctives, self.pose_basis)
        rest = self.joints_of(shape, expression)[:, :, None]  # [T, 5, 1, 3]
        result = posed * self.skinning_weights[:, 1:2]  # neck joint: the frame itself
        # Root: undo the neck rotation about the neck joint.
        around_neck = torch.einsum("tji,tvj->tvi", rotations[:, 0], posed - rest[:, 1]) + rest[:, 1]
        result = result + around_neck * self.skinning_weights[:, 0:1]
        for joint in (2, 3, 4):  # children of the neck joint
            turned = torch.einsum("tij,tvj->tvi", rotations[:, joint - 1], posed - rest[:, joint]) + rest[:, joint]
            result = result + turned * self.skinning_weights[:, joint : joint + 1]
        return result

    def rigid(
        self, shape: Tensor, rotation: Tensor, neck: Tensor, translation: Tensor, expression: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The rigid head transform M of each frame: root rotation, neck rotation and translation in one.

        Args:
            shape: [S]; rotation, neck: [T, 3] axis-angle; translation: [T, 3] m.
            expression: [T, E]; None is neutral, which is exact for a model whose expressions leave the joints alone.

        Returns:
            rotation matrices [T, 3, 3] and offsets [T, 3]: a head-frame point x lies at `R x + t` in camera axes.
        """
        rest = self.joints_of(shape, shape.new_zeros(1, len(self.expression_names)) if expression is None else expression)
        root = axis_angle_to_matrix(rotation)
        bent = axis_angle_to_matrix(neck)
        offset = rest[:, 1] - (bent @ rest[:, 1, :, None])[..., 0]  # neck joint stays where it is
        turned = torch.einsum("tij,tj->ti", root, offset - rest[:, 0]) + rest[:, 0]
        return root @ bent, turned + translation

    def forward(
        self, shape: Tensor, expression: Tensor, rotation: Tensor, neck: Tensor, jaw: Tensor, eyes: Tensor, translation: Tensor
    ) -> Tensor:
        """Posed vertices [T, V, 3] m in camera axes; arguments as in `local` and `rigid`."""
        matrix, offset = self.rigid(shape, rotation, neck, translation, expression)
        return torch.einsum("tij,tvj->tvi", matrix, self.local(shape, expression, jaw, eyes, neck)) + offset[:, None]

    def landmarks(self, vertices: Tensor) -> Tensor:
        """Points [..., L, 3] of the landmark embedding on vertices [..., V, 3]; unplaced ones are NaN."""
        corners = vertices[..., self.triangles[self.landmark_triangles.clamp_min(0)], :]  # [..., L, 3, 3]
        points = torch.einsum("lk,...lkd->...ld", self.landmark_barycentric, corners)
        return torch.where((self.landmark_triangles >= 0)[:, None], points, torch.nan)


def axis_angle_to_matrix(vector: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of axis-angle vectors [..., 3] (Rodrigues), exact with finite gradients at zero."""
    squared = vector.square().sum(-1)[..., None, None]
    small = squared < 1e-8  # below it the series is exact to float64
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    sine = torch.where(small, 1 - squared / 6, torch.sin(angle) / angle)
    cosine = torch.where(small, 0.5 - squared / 24, (1 - torch.cos(angle)) / safe)
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    return torch.eye(3, dtype=vector.dtype, device=vector.device) + sine * cross + cosine * (cross @ cross)
