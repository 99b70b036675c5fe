"""Hand models in MANO's layout: the arrays of one side, their checks and digest.

Units are metres and radians. Joint order is MANO's: wrist, index 1-3, middle 1-3, pinky 1-3, ring 1-3, thumb 1-3.
Arrays of 21 joints append the tips of index, middle, pinky, ring, thumb (Romero et al. 2017; Loper et al. 2015).
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Literal

import numpy as np

from hoidata.errors import BadInput
from hoidata.files import sha256_bytes

Side = Literal["left", "right"]

N_VERTICES, N_FACES, N_SHAPE, N_POSE = 778, 1538, 10, 45
N_ROTATIONS = 16  # joints that rotate, with the wrist
N_JOINTS = 21  # with the fingertips
N_POSE_FEATURES = (N_ROTATIONS - 1) * 9
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
# Fingertip vertices of MANO's mesh as used by Text2HOI and manopth: index, middle, pinky, ring, thumb.
TIP_VERTICES = (317, 445, 673, 556, 745)
JOINT_NAMES = (
    "wrist",
    *(f"{finger}{segment}" for finger in ("index", "middle", "pinky", "ring", "thumb") for segment in (1, 2, 3)),
    *(f"{finger}_tip" for finger in ("index", "middle", "pinky", "ring", "thumb")),
)

_SHAPES = {
    "template_m": (N_VERTICES, 3),
    "shape_directions": (N_VERTICES, 3, N_SHAPE),
    "pose_directions": (N_VERTICES, 3, N_POSE_FEATURES),
    "joint_regressor": (N_ROTATIONS, N_VERTICES),
    "skin_weights": (N_VERTICES, N_ROTATIONS),
    "parents": (N_ROTATIONS,),
    "faces": (N_FACES, 3),
    "mean_pose": (N_POSE,),
    "components": (N_POSE, N_POSE),
}
_ROW_SUM_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class HandModel:
    """One side of a hand model in MANO's layout, float64 (``parents`` and ``faces`` int64)."""

    side: Side
    name: str
    template_m: np.ndarray  # (778, 3) rest mesh; the wrist joint is not at its origin
    shape_directions: np.ndarray  # (778, 3, 10) metres per unit of beta
    pose_directions: np.ndarray  # (778, 3, 135) metres per element of ``R - I`` of joints 1-15, each row by row
    joint_regressor: np.ndarray  # (16, 778), rows sum to 1
    skin_weights: np.ndarray  # (778, 16), rows sum to 1
    parents: np.ndarray  # (16,), -1 for the wrist
    faces: np.ndarray  # (1538, 3), outward by the right-hand rule
    mean_pose: np.ndarray  # (45,) axis-angles
    components: np.ndarray  # (45, 45) principal components of the pose, one per row

    @cached_property
    def digest(self) -> str:
        """SHA-256 of side, shapes and little-endian bytes of all arrays."""
        pieces = [self.side.encode()]
        for field in fields(self):
            if field.name in _SHAPES:
                array = getattr(self, field.name)
                kind = "<i8" if array.dtype.kind in "iu" else "<f8"
                pieces += [field.name.encode(), repr(array.shape).encode(), np.ascontiguousarray(array, kind).tobytes()]
        return sha256_bytes(b"\0".join(pieces))

    def rest_joints_m(self, betas: np.ndarray, template_m: np.ndarray | None = None) -> np.ndarray:
        """Joints of the unposed hand, in the model's frame.

        betas: (frame, 10) shape coefficients. template_m: (778, 3) personal rest mesh instead of the model's template.
        Returns (frame, 16, 3) metres.
        """
        betas = np.asarray(betas, dtype=np.float64)
        template = self.template_m if template_m is None else np.asarray(template_m, dtype=np.float64)
        shift = (betas @ self.joint_directions).reshape(*betas.shape[:-1], N_ROTATIONS, 3)
        return self.joint_regressor @ template + shift

    def wrist_offset_m(self, betas: np.ndarray, template_m: np.ndarray | None = None) -> np.ndarray:
        """(frame, 3) J0, the unposed wrist in the model's frame; for MANO parameters ``wrist_m = transl + J0``."""
        return self.rest_joints_m(betas, template_m)[..., 0, :]

    @cached_property
    def joint_directions(self) -> np.ndarray:
        """(10, 48) shape directions of the 16 rest joints, metres per unit of beta."""
        directions = np.tensordot(self.joint_regressor, self.shape_directions, axes=1)
        return directions.transpose(2, 0, 1).reshape(N_SHAPE, N_ROTATIONS * 3)


@dataclass(frozen=True, eq=False)
class HandPair:
    """Both sides of one hand model; ``pair["left"]`` is ``pair.left``."""

    left: HandModel
    right: HandModel

    def __getitem__(self, side: Side) -> HandModel:
        return {"left": self.left, "right": self.right}[side]

    @property
    def name(self) -> str:
        return self.right.name

    def templates_of_length(self, length_m: float) -> np.ndarray:
        """(2, 778, 3) float32 rest meshes, scaled to a length from the wrist joint to the tip of the middle finger."""
        tips = [model.template_m[TIP_VERTICES[1]] for model in (self.left, self.right)]
        wrists = [model.wrist_offset_m(np.zeros(N_SHAPE)) for model in (self.left, self.right)]
        factor = length_m / np.linalg.norm(np.subtract(tips, wrists), axis=1)
        return (factor[:, None, None] * [self.left.template_m, self.right.template_m]).astype(np.float32)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of both models' digests."""
        return sha256_bytes(f"{self.left.digest} {self.right.digest}".encode())


def checked_model(source: str, remedy: str, **values) -> HandModel:
    """Build a HandModel from its fields. Raises BadInput for a wrong shape or impossible numbers, with ``remedy``."""
    arrays = {}
    for key, shape in _SHAPES.items():
        value = np.asarray(values.pop(key))
        field = f"{source}: {key}"
        if value.shape != shape:
            raise BadInput(field, f"shape {shape}", f"shape {value.shape}", remedy)
        if value.dtype.kind not in "fiu" or not np.isfinite(value).all():
            raise BadInput(field, "finite real numbers", f"dtype {value.dtype} with other values", remedy)
        arrays[key] = np.ascontiguousarray(value, np.int64 if key in ("parents", "faces") else np.float64)
    _check_meaning(source, remedy, arrays)
    return HandModel(**values, **arrays)


def _check_meaning(source: str, remedy: str, arrays: dict[str, np.ndarray]) -> None:
    for key in ("skin_weights", "joint_regressor"):
        sums = arrays[key].sum(axis=1)
        if np.abs(sums - 1).max() > _ROW_SUM_TOLERANCE:
            worst = sums[np.abs(sums - 1).argmax()]
            raise BadInput(f"{source}: {key}", "rows that sum to 1", f"a row that sums to {worst:.6g}", remedy)
    if tuple(arrays["parents"]) != PARENTS:
        raise BadInput(f"{source}: parents", f"{PARENTS}", f"{tuple(arrays['parents'].tolist())}", remedy)
    faces = arrays["faces"]
    if faces.min() < 0 or faces.max() >= N_VERTICES:
        raise BadInput(f"{source}: faces", f"vertex ids below {N_VERTICES}", f"{faces.min()} to {faces.max()}", remedy)


# Index in MANO's order of each of OpenPose's 21 joints; manopth and H2O use OpenPose's order.
OPENPOSE = (0, 13, 14, 15, 20, 1, 2, 3, 16, 4, 5, 6, 17, 10, 11, 12, 19, 7, 8, 9, 18)


def openpose_to_mano_order(joints: np.ndarray) -> np.ndarray:
    """Reorder joints (..., 21, 3) from OpenPose's order (wrist, thumb to pinky, base to tip) to MANO's with tips."""
    return joints[..., np.argsort(OPENPOSE), :]
