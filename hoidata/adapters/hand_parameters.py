"""Hand parameters from a source's convention to the one of ``HandTrack``.

MANO's ``transl`` places the hand so that its wrist joint lies at ``J0 + transl``, where J0 is the wrist of the shaped
rest mesh; the hand turns about J0. Once a hand is known by its wrist position, a change of frame is the plain
``R' = A R``, ``wrist' = A wrist + b``.
"""

import numpy as np

from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat
from hoidata.hands import HandModel
from hoidata.schema.clip import HandTrack


def wrist_from_transl(
    transl_m: np.ndarray, betas: np.ndarray, model: HandModel, template_m: np.ndarray | None = None
) -> np.ndarray:
    """World position of the wrist joint (frame, 3) from MANO's ``transl`` (frame, 3), same frame, metres.

    betas: (frame or 1, 10). template_m: (778, 3) personal rest mesh instead of the model's.
    """
    return np.asarray(transl_m) + model.wrist_offset_m(betas, template_m)


def move_rotvec(rotvec: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Axis-angles (frame, 3) seen from another frame: ``rotation @ R``; rotation: (frame, 3, 3)."""
    return rotmat_to_rotvec(rotation @ rotvec_to_rotmat(np.asarray(rotvec, dtype=np.float64)))


def move_points(points_m: np.ndarray, rotation: np.ndarray, translation_m: np.ndarray) -> np.ndarray:
    """One point per frame (frame, 3) to another frame: ``rotation @ x + translation``."""
    return np.einsum("fij,fj->fi", rotation, points_m) + translation_m


def hand_track(
    wrist_m: np.ndarray,
    global_orient: np.ndarray,
    hand_pose: np.ndarray,
    betas: np.ndarray,
    valid: np.ndarray | None = None,
    template_m: np.ndarray | None = None,
) -> HandTrack:
    """A HandTrack in float32: zeros where the hand is not valid, one row of betas where they do not vary."""
    valid = np.ones(len(wrist_m), dtype=bool) if valid is None else np.asarray(valid, dtype=bool)
    return HandTrack(
        wrist_m=_float32(wrist_m, valid),
        global_orient=_float32(global_orient, valid),
        hand_pose=_float32(hand_pose, valid),
        betas=_short_betas(np.asarray(betas, dtype=np.float32), valid),
        valid=valid,
        template_m=None if template_m is None else np.ascontiguousarray(template_m, dtype=np.float32),
    )


def _float32(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    return np.where(valid[:, None], values, 0.0).astype(np.float32)


def _short_betas(betas: np.ndarray, valid: np.ndarray) -> np.ndarray:
    if len(betas) == 1:
        return betas
    if not valid.any():
        return np.zeros((1, betas.shape[1]), dtype=np.float32)
    betas = np.where(valid[:, None], betas, betas[valid.argmax()])
    return betas[:1] if (betas == betas[:1]).all() else betas
