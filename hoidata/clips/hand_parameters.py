"""Hand parameters of any source to the one convention of ``HandTrack``.

MANO's ``transl`` places the hand so that its wrist joint lies at ``J0 + transl``, where J0 is the wrist of the shaped
rest mesh (about 10 cm from the model's origin); the hand turns about J0. Other sources give the wrist itself. Once a
hand is known by its wrist position, a change of frame is the plain ``R' = A R``, ``wrist' = A wrist + b``.
The mean pose is added to the numbers of the source as they are. Then rotations beyond pi are stored as the equal
rotations of at most pi (``canonical_rotvec``): numbers of equal poses are near each other, except across pi itself.
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
    """What the hand parameters of a dataset mean.

    translation: "transl" (the wrist lies at J0 + t) or "wrist" (it lies at t).
    fingers: "absolute" (zero is the flat hand) or "mean-relative" (the model's mean pose is to be added).
    components: so many principal components instead of 45 axis-angle numbers; 0 for axis-angles.
    shape: betas per frame or per sequence, a personal rest mesh without betas, or a shape fitted to keypoints.
    left_shape: whether the source fitted its left hands with the x of MANO_LEFT's shape directions as released (wrong
    sign) or corrected; "unused" where there are no betas of the source's own.
    note: one sentence for people.
    """

    translation: Literal["transl", "wrist"]
    fingers: Literal["absolute", "mean-relative"]
    shape: Literal["betas per frame", "betas per sequence", "personal mesh", "fitted"]
    left_shape: Literal["as released", "corrected", "unused"]
    components: int = 0
    note: str = ""

    def __post_init__(self) -> None:
        if not 0 <= self.components <= N_POSE:
            raise BadInput("components of a hand convention", f"0 (axis-angles) to {N_POSE}", f"{self.components}")

    @property
    def finger_columns(self) -> int:
        """Numbers per frame that describe the fingers."""
        return self.components or N_POSE

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class SourceHand:
    """Parameters of one hand as a source gives them; metres and radians.

    translation_m: (frame, 3); global_orient: (frame, 3) axis-angle; fingers: (frame, 45) axis-angle or
    (frame, components); betas: (1 or frame, 10); valid: (frame,) bool, None for all; template_m: (778, 3) or None.
    """

    translation_m: np.ndarray
    global_orient: np.ndarray
    fingers: np.ndarray
    betas: np.ndarray
    valid: np.ndarray | None = None
    template_m: np.ndarray | None = None


@dataclass(frozen=True)
class FrameChange:
    """``x_new = rotation @ x_old + translation_m`` per frame; the default changes nothing.

    rotation: (1 or frame, 3, 3); translation_m: (1 or frame, 3).
    """

    rotation: np.ndarray | None = None
    translation_m: np.ndarray | None = None

    def points(self, points_m: np.ndarray) -> np.ndarray:
        """One point per frame (frame, 3)."""
        if self.rotation is None:
            return points_m
        moved = (self.rotation @ points_m[..., None])[..., 0]
        return moved if self.translation_m is None else moved + self.translation_m

    def rotvecs(self, rotvec: np.ndarray) -> np.ndarray:
        """One axis-angle per frame (frame, 3): ``rotation @ R``."""
        if self.rotation is None:
            return rotvec
        return rotmat_to_rotvec(self.rotation @ rotvec_to_rotmat(np.asarray(rotvec, dtype=np.float64)))


SAME_FRAME = FrameChange()


def to_track(
    source: SourceHand, convention: HandConvention, model: HandModel, change: FrameChange = SAME_FRAME
) -> HandTrack:
    """Absolute parameters in the world frame, float32. change: world from the source's frame."""
    valid = np.ones(len(source.translation_m), dtype=bool) if source.valid is None else np.asarray(source.valid, bool)
    source = _only_valid(source, valid)
    wrist = np.asarray(source.translation_m, dtype=np.float64)
    if convention.translation == "transl":
        wrist = wrist + model.wrist_offset_m(source.betas, source.template_m)
    return hand_track(
        wrist_m=change.points(wrist),
        global_orient=change.rotvecs(source.global_orient),
        hand_pose=absolute_fingers(source.fingers, convention, model),
        betas=source.betas,
        valid=valid,
        template_m=source.template_m,
    )


def absolute_fingers(fingers: np.ndarray, convention: HandConvention, model: HandModel) -> np.ndarray:
    """(frame, 45) absolute axis-angles from axis-angles or principal components.

    Raises BadInput when there are not as many columns as the convention says.
    """
    angles = np.asarray(fingers, dtype=np.float64)
    if angles.ndim != 2 or angles.shape[1] != convention.finger_columns:
        raise BadInput("finger poses", f"{convention.finger_columns} columns", f"shape {angles.shape}")
    if convention.components:
        angles = angles @ model.components[: convention.components]
    return angles + model.mean_pose if convention.fingers == "mean-relative" else angles


def hands_for(convention: HandConvention, hands: HandPair) -> HandPair:
    """The hand models a dataset's parameters belong to: with the left shape directions corrected where it says so."""
    return with_corrected_left(hands) if convention.left_shape == "corrected" else hands


def with_corrected_left(hands: HandPair) -> HandPair:
    """The pair with the x of the left shape directions negated where it has the right hand's sign.

    In the released MANO_LEFT.pkl it equals the right hand's although the template is mirrored; a file that was mended
    already, and the embedded hand, stay as they are (smplx issue 48; the test of HOT3D's toolkit).
    """
    left, right = hands.left.shape_directions, hands.right.shape_directions
    if np.abs(left[:, 0] - right[:, 0]).sum() >= 1:
        return hands
    mended = left.copy()
    mended[:, 0] *= -1
    return replace(hands, left=replace(hands.left, shape_directions=mended))


def hand_track(
    wrist_m: np.ndarray,
    global_orient: np.ndarray,
    hand_pose: np.ndarray,
    betas: np.ndarray,
    valid: np.ndarray | None = None,
    template_m: np.ndarray | None = None,
) -> HandTrack:
    """A HandTrack in float32: zeros where the hand is not valid, one row of betas where they do not vary.

    Rotations beyond pi become the equal ones of at most pi.
    """
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
    """Zeros where a frame means nothing, so that whatever a file holds there cannot matter."""
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
