"""Converts the hand parameters of a source to the convention of ``HandTrack``.

MANO's ``transl`` puts the wrist joint at ``J0 + transl``, where J0 is the wrist of the shaped rest mesh, about 10 cm
from the model's origin; the hand rotates about J0. Other sources give the wrist position. With the wrist position, a
change of frame is ``R' = A R``, ``wrist' = A wrist + b``.
The mean pose is added to the axis-angles of the source. Then each rotation gets an angle of at most pi
(``canonical_rotvec``), so that similar poses have similar numbers, except at pi.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from hoidata.clips.clip import HandTrack
from hoidata.errors import BadInput
from hoidata.geometry.rotations import canonical_rotvec, rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands import HandModel, HandPair
from hoidata.hands.model import N_POSE


@dataclass(frozen=True)
class HandConvention:
    """The convention of a dataset's hand parameters."""

    translation: Literal["transl", "wrist"]  # the wrist is at J0 + t, or at t
    fingers: Literal["absolute", "mean-relative"]  # zero is the flat hand, or the model's mean pose
    shape: Literal["betas per frame", "betas per sequence", "personal mesh", "fitted"]
    # Whether the source used MANO_LEFT's shape directions with the wrong sign of x, as released, or corrected; "unused"
    # if the source has no betas.
    left_shape: Literal["as released", "corrected", "unused"]
    components: int = 0  # number of principal components of the finger pose; 0 for axis-angles
    note: str = ""  # one sentence for people

    def __post_init__(self) -> None:
        if not 0 <= self.components <= N_POSE:
            raise BadInput("components of a hand convention", f"0 (axis-angles) to {N_POSE}", f"{self.components}")

    @property
    def finger_columns(self) -> int:
        """Number of finger parameters per frame."""
        return self.components or N_POSE

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class SourceHand:
    """Parameters of one hand in the convention of the source; metres and radians."""

    translation_m: np.ndarray  # (frame, 3)
    global_orient: np.ndarray  # (frame, 3) axis-angle
    fingers: np.ndarray  # (frame, 45) axis-angles, or (frame, components)
    betas: np.ndarray  # (1 or frame, 10)
    valid: np.ndarray | None = None  # (frame,) bool; None: all
    template_m: np.ndarray | None = None  # (778, 3)


@dataclass(frozen=True)
class FrameChange:
    """``x_new = rotation @ x_old + translation_m`` per frame."""

    rotation: np.ndarray  # (1 or frame, 3, 3)
    translation_m: np.ndarray | None = None  # (1 or frame, 3); None for zero

    def points(self, points_m: np.ndarray) -> np.ndarray:
        """Transform one point per frame (frame, 3)."""
        moved = (self.rotation @ points_m[..., None])[..., 0]
        return moved if self.translation_m is None else moved + self.translation_m

    def rotvecs(self, rotvec: np.ndarray) -> np.ndarray:
        """Transform one axis-angle per frame (frame, 3): ``rotation @ R``."""
        return rotmat_to_rotvec(self.rotation @ rotvec_to_rotmat(np.asarray(rotvec, dtype=np.float64)))


def to_track(
    source: SourceHand, convention: HandConvention, model: HandModel, change: FrameChange | None = None
) -> HandTrack:
    """Convert to absolute parameters in the world frame, float32. change: world from the source's frame, if it differs.

    Raises BadInput if the number of finger parameters differs from the convention.
    """
    valid = np.ones(len(source.translation_m), dtype=bool) if source.valid is None else np.asarray(source.valid, bool)
    source = _only_valid(source, valid)
    wrist_m, global_orient = np.asarray(source.translation_m, dtype=np.float64), source.global_orient
    if convention.translation == "transl":
        wrist_m = wrist_m + model.wrist_offset_m(source.betas, source.template_m)
    if change is not None:
        wrist_m, global_orient = change.points(wrist_m), change.rotvecs(global_orient)
    return hand_track(
        wrist_m=wrist_m,
        global_orient=global_orient,
        hand_pose=absolute_fingers(source.fingers, convention, model),
        betas=source.betas,
        valid=valid,
        template_m=source.template_m,
    )


def absolute_fingers(fingers: np.ndarray, convention: HandConvention, model: HandModel) -> np.ndarray:
    """Return (frame, 45) absolute axis-angles from axis-angles or principal components.

    Raises BadInput if the number of columns differs from the convention.
    """
    angles = np.asarray(fingers, dtype=np.float64)
    if angles.ndim != 2 or angles.shape[1] != convention.finger_columns:
        raise BadInput("finger poses", f"{convention.finger_columns} columns", f"shape {angles.shape}")
    if convention.components:
        angles = angles @ model.components[: convention.components]
    return angles + model.mean_pose if convention.fingers == "mean-relative" else angles


def hands_for(convention: HandConvention, hands: HandPair) -> HandPair:
    """Return the hand models of a dataset, with corrected left shape directions if its convention needs them."""
    return with_corrected_left(hands) if convention.left_shape == "corrected" else hands


def with_corrected_left(hands: HandPair) -> HandPair:
    """Negate x of the left shape directions if it has the sign of the right hand (smplx issue 48).

    In the released MANO_LEFT.pkl x equals that of the right hand although the template is mirrored. A corrected file
    and the embedded hand are unchanged. The test is that of HOT3D's toolkit.
    """
    left, right = hands.left.shape_directions, hands.right.shape_directions
    if np.abs(left[:, 0] - right[:, 0]).sum() >= 1:
        return hands
    corrected = left.copy()
    corrected[:, 0] *= -1
    return replace(hands, left=replace(hands.left, shape_directions=corrected))


def hand_track(
    wrist_m: np.ndarray,
    global_orient: np.ndarray,
    hand_pose: np.ndarray,
    betas: np.ndarray,
    valid: np.ndarray | None = None,
    template_m: np.ndarray | None = None,
) -> HandTrack:
    """Build a HandTrack in float32: zeros in invalid frames, one row of constant betas, angles of at most pi."""
    valid = np.ones(len(wrist_m), dtype=bool) if valid is None else np.asarray(valid, dtype=bool)
    hand_pose = canonical_rotvec(hand_pose.reshape(len(wrist_m), N_POSE // 3, 3)).reshape(len(wrist_m), N_POSE)
    return HandTrack(
        wrist_m=_float32(wrist_m, valid),
        global_orient=_float32(canonical_rotvec(global_orient), valid),
        hand_pose=_float32(hand_pose, valid),
        betas=_short_betas(np.asarray(betas, dtype=np.float32), valid),
        valid=valid,
        template_m=None if template_m is None else np.ascontiguousarray(template_m, dtype=np.float32),
    )


def _only_valid(source: SourceHand, valid: np.ndarray) -> SourceHand:
    """Set invalid frames to zero, so that the result does not depend on their contents."""
    if valid.all():
        return source
    names = ("translation_m", "global_orient", "fingers", *(("betas",) if len(source.betas) > 1 else ()))
    return replace(source, **{name: np.where(valid[:, None], getattr(source, name), 0.0) for name in names})


def _float32(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    return np.where(valid[:, None], values, 0.0).astype(np.float32)


def _short_betas(betas: np.ndarray, valid: np.ndarray) -> np.ndarray:
    if len(betas) == 1:
        return betas
    if not valid.any():
        return np.zeros((1, betas.shape[1]), dtype=np.float32)
    betas = np.where(valid[:, None], betas, betas[valid.argmax()])
    return betas[:1] if (betas == betas[:1]).all() else betas
