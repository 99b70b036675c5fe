"""Which tracked box is which mesh of HOI4D, and where a mesh of its own lies in the whole object.

15 frames a second become 30. Between every two frames of the source one is made: halfway along the shortest turn for
rotations, on the cubic through four neighbours for places (on the line between two at the ends). A made frame has the
number of the source frame before it, so a clip tells which these are (``Clip.recorded``), and no figure looks at them.
"""

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from hoidata.clips.clip import HandTrack
from hoidata.datasets.hinge import rigid_fit
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec, rotvec_to_rotmat

MOST_OFF = 0.15  # of a part's extents: boxes are annotated to some per cent
CLEARLY = 2.0  # another assignment must be so many times worse


def matched(
    where: str, tracked_m: np.ndarray, names: Sequence[str], meshes_m: np.ndarray
) -> tuple[list[int], np.ndarray]:
    """Which of the tracked boxes each mesh is, and the ratio of their extents (mesh, 3).

    tracked_m: (box, 3) and meshes_m: (mesh, 3) extents along each one's own axes. Raises BadInput where no assignment
    fits to 15 %, or a second one fits nearly as well.
    """
    off = np.abs(np.log(tracked_m[None] / meshes_m[:, None])).max(axis=2)  # (mesh, box)
    ways = sorted(
        (max(off[mesh, box] for mesh, box in enumerate(way)), way)
        for way in permutations(range(len(tracked_m)), len(names))
    )
    if not ways or ways[0][0] > np.log1p(MOST_OFF):
        got = "none" if not ways else f"at best {np.expm1(ways[0][0]):.0%} off"
        remedy = "nothing to do: poses of other objects, or fewer than its parts"
        raise BadInput(where, f"boxes of the size of {', '.join(names)}", got, remedy)
    if len(ways) > 1 and ways[1][0] < CLEARLY * max(ways[0][0], np.log1p(0.02)):
        got = f"parts of nearly the same size: {ways[0][0]:.1%} and {ways[1][0]:.1%} off"
        raise BadInput(where, "parts that their sizes tell apart", got, "nothing to do: which is which cannot be told")
    chosen = list(ways[0][1])
    return chosen, tracked_m[chosen] / meshes_m


def aligned_from_whole(where: str, aligned_m: np.ndarray, whole_m: np.ndarray) -> np.ndarray:
    """(4, 4) rigid transform between two copies of a mesh with the same vertices. Raises BadInput for others."""
    if aligned_m.shape != whole_m.shape:
        raise BadInput(where, f"{len(whole_m)} vertices as in the whole object", f"{len(aligned_m)}")
    transform = rigid_fit(whole_m[None], aligned_m[None])[0]
    off = float(np.abs(whole_m @ transform[:3, :3].T + transform[:3, 3] - aligned_m).max())
    if off > 1e-4 * max(1.0, float(np.ptp(whole_m))):
        raise BadInput(where, "the same mesh, turned and moved", f"one {off:.3g} m off", "download the models again")
    return transform


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
