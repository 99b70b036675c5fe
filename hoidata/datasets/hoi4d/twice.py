"""15 frames a second as 30: each frame of the source, and one between every two of them.

What lies between is made: halfway along the shortest turn for rotations, on the cubic through four neighbours for
places (on the line between two at the ends). A made frame has the number of the source frame before it, so a clip
tells which these are (``Clip.recorded``), and no figure looks at them.
"""

import numpy as np

from hoidata.clips.clip import HandTrack
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat


def twice_frames(n_frames: int) -> np.ndarray:
    """(2 n - 1,) the source frame of each, or the one before it."""
    return np.arange(2 * n_frames - 1) // 2


def twice_values(values: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """(2 n - 1, ...) numbers on cubics. valid: (n,) frames that may be used; beside others the line between two is."""
    valid = np.ones(len(values), bool) if valid is None else valid
    middle = (values[:-1] + values[1:]) / 2
    if len(values) > 3:
        cubic = (9 * (values[1:-2] + values[2:-1]) - values[:-3] - values[3:]) / 16
        usable = valid[:-3] & valid[1:-2] & valid[2:-1] & valid[3:]
        middle[1:-1][usable] = cubic[usable]
    return _woven(values, middle)


def twice_rotvecs(rotvec: np.ndarray) -> np.ndarray:
    """(2 n - 1, 3) axis-angles, halfway along the shortest turn."""
    rotation = rotvec_to_rotmat(rotvec.astype(np.float64))
    half = rotmat_to_rotvec(rotation[:-1].swapaxes(-1, -2) @ rotation[1:]) / 2
    middle = rotmat_to_rotvec(rotation[:-1] @ rotvec_to_rotmat(half))
    return _woven(rotvec, middle.astype(rotvec.dtype))


def twice_hand(track: HandTrack) -> HandTrack:
    """A made frame has a hand where both of its neighbours do."""
    fingers = track.hand_pose.reshape(-1, 15, 3)
    pose = np.stack([twice_rotvecs(fingers[:, joint]) for joint in range(15)], axis=1)
    valid = _woven(track.valid, track.valid[:-1] & track.valid[1:])

    def seen(values: np.ndarray) -> np.ndarray:
        return np.where(valid[:, None], values, 0).astype(np.float32)

    return HandTrack(
        seen(twice_values(track.wrist_m, track.valid)),
        seen(twice_rotvecs(track.global_orient)),
        seen(pose.reshape(len(valid), 45)),
        track.betas if len(track.betas) == 1 else twice_values(track.betas, track.valid).astype(np.float32),
        valid,
    )


def _woven(values: np.ndarray, middle: np.ndarray) -> np.ndarray:
    woven = np.empty((2 * len(values) - 1, *values.shape[1:]), values.dtype)
    woven[::2], woven[1::2] = values, middle
    return woven
