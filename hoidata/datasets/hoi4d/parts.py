"""Matches HOI4D's tracked boxes to meshes, and upsamples motion from 15 to 30 fps.

One frame is interpolated between every two source frames. Rotations use the midpoint of the shortest rotation (slerp).
Positions use the cubic through four neighbours, and the line between two neighbours at the ends. An interpolated frame
has the number of the source frame before it, so ``Clip.recorded`` is False and metrics skip it.
"""

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from hoidata.clips.clip import HandTrack
from hoidata.datasets.hinge import rigid_fit
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat

MAX_SIZE_ERROR = 0.15  # relative, of a part's extents: annotated boxes are accurate to some per cent
MIN_AMBIGUITY_RATIO = 2.0  # the second best assignment must be this many times worse


def match_boxes(
    location: str, tracked_m: np.ndarray, names: Sequence[str], meshes_m: np.ndarray
) -> tuple[list[int], np.ndarray]:
    """Assign a tracked box to each mesh by size.

    Args:
        location: for errors.
        tracked_m: (box, 3) extents of the boxes along their axes.
        names: of the meshes.
        meshes_m: (mesh, 3) extents of the meshes along their axes.

    Returns:
        Index of the box of each mesh, and (mesh, 3) ratio of box to mesh extents.

    Raises:
        BadInput: no assignment is accurate to 15 %, or two are about equally good.
    """
    log_ratio = np.abs(np.log(tracked_m[None] / meshes_m[:, None])).max(axis=2)  # (mesh, box)
    assignments = sorted(
        (max(log_ratio[mesh, box] for mesh, box in enumerate(assignment)), assignment)
        for assignment in permutations(range(len(tracked_m)), len(names))
    )
    if not assignments or assignments[0][0] > np.log1p(MAX_SIZE_ERROR):
        got = "none" if not assignments else f"at best {np.expm1(assignments[0][0]):.0%} off"
        remedy = "nothing to do: poses of other objects, or fewer than its parts"
        raise BadInput(location, f"boxes of the size of {', '.join(names)}", got, remedy)
    if len(assignments) > 1 and assignments[1][0] < MIN_AMBIGUITY_RATIO * max(assignments[0][0], np.log1p(0.02)):
        got = f"parts of nearly the same size: {assignments[0][0]:.1%} and {assignments[1][0]:.1%} off"
        raise BadInput(
            location, "parts that their sizes tell apart", got, "nothing to do: which is which cannot be told"
        )
    chosen = list(assignments[0][1])
    return chosen, tracked_m[chosen] / meshes_m


def aligned_from_whole(path: str, aligned_m: np.ndarray, whole_m: np.ndarray) -> np.ndarray:
    """(4, 4) rigid transform from the whole object to an aligned copy of a mesh. Raises BadInput for another mesh."""
    if aligned_m.shape != whole_m.shape:
        raise BadInput(path, f"{len(whole_m)} vertices as in the whole object", f"{len(aligned_m)}")
    transform = rigid_fit(whole_m[None], aligned_m[None])[0]
    max_error_m = float(np.abs(whole_m @ transform[:3, :3].T + transform[:3, 3] - aligned_m).max())
    if max_error_m > 1e-4 * max(1.0, float(np.ptp(whole_m))):
        raise BadInput(
            path, "the same mesh, turned and moved", f"one {max_error_m:.3g} m off", "download the models again"
        )
    return transform


def upsample_frames(n_frames: int) -> np.ndarray:
    """(2 n - 1,) source frame of each frame; interpolated frames have that of the frame before."""
    return np.arange(2 * n_frames - 1) // 2


def upsample_values(values: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """(2 n - 1, ...) cubic interpolation. valid: (n,) bool; next to invalid frames the interpolation is linear."""
    valid = np.ones(len(values), bool) if valid is None else valid
    middle = (values[:-1] + values[1:]) / 2
    if len(values) > 3:
        cubic = (9 * (values[1:-2] + values[2:-1]) - values[:-3] - values[3:]) / 16
        usable = valid[:-3] & valid[1:-2] & valid[2:-1] & valid[3:]
        middle[1:-1][usable] = cubic[usable]
    return _interleave(values, middle)


def upsample_rotvecs(rotvec: np.ndarray) -> np.ndarray:
    """(2 n - 1, 3) axis-angles, interpolated along the shortest rotation."""
    rotation = rotvec_to_rotmat(rotvec.astype(np.float64))
    half = rotmat_to_rotvec(rotation[:-1].swapaxes(-1, -2) @ rotation[1:]) / 2
    middle = rotmat_to_rotvec(rotation[:-1] @ rotvec_to_rotmat(half))
    return _interleave(rotvec, middle.astype(rotvec.dtype))


def upsample_hand(track: HandTrack) -> HandTrack:
    """Upsample a hand. An interpolated frame is valid if both of its neighbours are."""
    fingers = track.hand_pose.reshape(-1, 15, 3)
    pose = np.stack([upsample_rotvecs(fingers[:, joint]) for joint in range(15)], axis=1)
    valid = _interleave(track.valid, track.valid[:-1] & track.valid[1:])

    def zero_if_invalid(values: np.ndarray) -> np.ndarray:
        return np.where(valid[:, None], values, 0).astype(np.float32)

    return HandTrack(
        wrist_m=zero_if_invalid(upsample_values(track.wrist_m, track.valid)),
        global_orient=zero_if_invalid(upsample_rotvecs(track.global_orient)),
        hand_pose=zero_if_invalid(pose.reshape(len(valid), 45)),
        betas=track.betas if len(track.betas) == 1 else upsample_values(track.betas, track.valid).astype(np.float32),
        valid=valid,
    )


def _interleave(values: np.ndarray, middle: np.ndarray) -> np.ndarray:
    woven = np.empty((2 * len(values) - 1, *values.shape[1:]), values.dtype)
    woven[::2], woven[1::2] = values, middle
    return woven
