"""What a hand model is: the arrays of MANO's layout for one side, checked and known by their content.

Units are metres and radians. Joint order is MANO's: wrist, index 1-3, middle 1-3, pinky 1-3, ring 1-3, thumb 1-3;
the 21-joint arrays append the tips of index, middle, pinky, ring, thumb (Romero et al. 2017; Loper et al. 2015).
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Literal

import numpy as np

from hoidata.errors import BadInput
from hoidata.files import sha256_bytes

Side = Literal["left", "right"]

N_VERTICES, N_FACES, N_SHAPE, N_POSE = 778, 1538, 10, 45
N_ROTATIONS = 16  # joints that turn, the wrist among them
N_JOINTS = 21  # those, then the fingertips
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
    """One side of a hand model in MANO's layout, float64 (``parents`` and ``faces`` int64).

    template_m: (778, 3) rest mesh, metres; the wrist joint is not at its origin.
    shape_directions: (778, 3, 10) metres per unit of beta.
    pose_directions: (778, 3, 135) metres per element of ``R - I`` of joints 1-15, each row by row.
    joint_regressor: (16, 778) and skin_weights: (778, 16), rows summing to 1.
    parents: (16,) with -1 at the wrist. faces: (1538, 3), outward by the right-hand rule.
    mean_pose: (45,) axis-angle, radians. components: (45, 45) principal components of the pose, one per row.
    """

    side: Side
    name: str
    template_m: np.ndarray
    shape_directions: np.ndarray
    pose_directions: np.ndarray
    joint_regressor: np.ndarray
    skin_weights: np.ndarray
    parents: np.ndarray
    faces: np.ndarray
    mean_pose: np.ndarray
    components: np.ndarray

    @cached_property
    def digest(self) -> str:
        """SHA-256 over side, shapes and little-endian bytes of all arrays: equal digest, equal kinematics."""
        pieces = [self.side.encode()]
        for field in fields(self):
            if field.name in _SHAPES:
                array = getattr(self, field.name)
                kind = "<i8" if array.dtype.kind in "iu" else "<f8"
                pieces += [field.name.encode(), repr(array.shape).encode(), np.ascontiguousarray(array, kind).tobytes()]
        return sha256_bytes(b"\0".join(pieces))

    def rest_joints_m(self, betas: np.ndarray, template_m: np.ndarray | None = None) -> np.ndarray:
        """Joints of the unposed hand in the model's own frame: betas (frame, 10) to (frame, 16, 3), metres.

        template_m: (778, 3) personal rest mesh instead of the model's template.
        """
        betas = np.asarray(betas, dtype=np.float64)
        template = self.template_m if template_m is None else np.asarray(template_m, dtype=np.float64)
        shift = (betas @ self.joint_directions).reshape(*betas.shape[:-1], N_ROTATIONS, 3)
        return self.joint_regressor @ template + shift

    def wrist_offset_m(self, betas: np.ndarray, template_m: np.ndarray | None = None) -> np.ndarray:
        """(frame, 3) J0: the unposed wrist in the model's frame; ``wrist_m = transl + J0`` for MANO parameters."""
        return self.rest_joints_m(betas, template_m)[..., 0, :]

    @cached_property
    def joint_directions(self) -> np.ndarray:
        """(10, 48) metres per unit of beta: shape directions of the 16 rest joints, joint by joint."""
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

    @cached_property
    def digest(self) -> str:
        return sha256_bytes(f"{self.left.digest} {self.right.digest}".encode())


def checked_model(where: str, remedy: str, **values) -> HandModel:
    """Build a HandModel from its field values; BadInput names the first with a wrong shape or impossible numbers."""
    arrays = {}
    for key, shape in _SHAPES.items():
        value = np.asarray(values.pop(key))
        field = f"{where}: {key}"
        if value.shape != shape:
            raise BadInput(field, f"shape {shape}", f"shape {value.shape}", remedy)
        if value.dtype.kind not in "fiu" or not np.isfinite(value).all():
            raise BadInput(field, "finite real numbers", f"dtype {value.dtype} with other values", remedy)
        arrays[key] = np.ascontiguousarray(value, np.int64 if key in ("parents", "faces") else np.float64)
    _check_meaning(where, remedy, arrays)
    return HandModel(**values, **arrays)


def _check_meaning(where: str, remedy: str, arrays: dict[str, np.ndarray]) -> None:
    for key in ("skin_weights", "joint_regressor"):
        sums = arrays[key].sum(axis=1)
        if np.abs(sums - 1).max() > _ROW_SUM_TOLERANCE:
            worst = sums[np.abs(sums - 1).argmax()]
            raise BadInput(f"{where}: {key}", "rows that sum to 1", f"a row that sums to {worst:.6g}", remedy)
    if tuple(arrays["parents"]) != PARENTS:
        raise BadInput(f"{where}: parents", f"{PARENTS}", f"{tuple(arrays['parents'].tolist())}", remedy)
    faces = arrays["faces"]
    if faces.min() < 0 or faces.max() >= N_VERTICES:
        raise BadInput(f"{where}: faces", f"vertex ids below {N_VERTICES}", f"{faces.min()} to {faces.max()}", remedy)


# Index in our order of each of OpenPose's 21 joints; manopth and H2O use that order.
OPENPOSE = (0, 13, 14, 15, 20, 1, 2, 3, 16, 4, 5, 6, 17, 10, 11, 12, 19, 7, 8, 9, 18)


def openpose_to_mano_order(joints: np.ndarray) -> np.ndarray:
    """Joints (..., 21, 3) in OpenPose's order (wrist, then thumb to pinky, each from its base to its tip), in ours."""
    return joints[..., np.argsort(OPENPOSE), :]
