"""Two parts that were tracked one by one, as one object with a hinge; and which tracked part is which mesh."""

from collections.abc import Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np

from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotation_angle
from hoidata.objects.model import Hinge

MOST_OFF = 0.15  # of a part's extents: boxes are annotated to some per cent
CLEARLY = 2.0  # another assignment must be so many times worse
ROUNDS = 3


class HingeFit(NamedTuple):
    """world_from_object (frame, 4, 4), hinge_rad (frame,), unwrapped.

    residual_m, residual_rad: (frame,) how far both parts lie from where they were tracked, root mean square over the
    corners of their boxes, and how far their relative rotation is off the hinge.
    """

    world_from_object: np.ndarray
    hinge_rad: np.ndarray
    residual_m: np.ndarray
    residual_rad: np.ndarray


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


def rigid_fit(from_m: np.ndarray, to_m: np.ndarray) -> np.ndarray:
    """(frame, 4, 4) the turn and shift that take points (frame, point, 3) nearest to others (Kabsch 1976)."""
    from_mean, to_mean = from_m.mean(axis=1, keepdims=True), to_m.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd((to_m - to_mean).transpose(0, 2, 1) @ (from_m - from_mean))
    signs = np.ones((len(u), 3))
    signs[:, 2] = np.sign(np.linalg.det(u @ vt))
    found = np.tile(np.eye(4), (len(u), 1, 1))
    found[:, :3, :3] = (u * signs[:, None]) @ vt
    found[:, :3, 3] = (to_mean - from_mean @ found[:, :3, :3].transpose(0, 2, 1))[:, 0]
    return found


def fit_hinge(base: np.ndarray, moving: np.ndarray, hinge: Hinge, corners_m: tuple[np.ndarray, np.ndarray]) -> HingeFit:
    """One pose and one angle per frame for two parts that were tracked apart.

    base, moving: (frame, 4, 4) world from each part, in the coordinates of the whole object at rest. corners_m: (8, 3)
    of each part's box there. The angle is that of the relative rotation about the axis; the pose is nearest to both
    parts' corners; both in turn.
    """
    seen = np.concatenate([_moved(base, corners_m[0]), _moved(moving, corners_m[1])], axis=1)
    pose = base
    for _ in range(ROUNDS):
        angle = np.unwrap(_angle_about(hinge.axis, pose[:, :3, :3].transpose(0, 2, 1) @ moving[:, :3, :3]))
        rest = np.concatenate(
            [np.broadcast_to(corners_m[0], (len(base), 8, 3)), hinge.turn(angle) @ corners_m[1]], axis=1
        )
        pose = rigid_fit(rest, seen)
    off = np.linalg.norm(_moved(pose, rest) - seen, axis=2)
    relative = pose[:, :3, :3].transpose(0, 2, 1) @ moving[:, :3, :3]
    left = hinge.turn(angle).rotation.transpose(0, 2, 1) @ relative
    return HingeFit(pose, angle, np.sqrt((off**2).mean(axis=1)), rotation_angle(left))


def _moved(transforms: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    return points_m @ transforms[:, :3, :3].transpose(0, 2, 1) + transforms[:, None, :3, 3]


def _angle_about(axis: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(frame,) angle about the unit axis whose rotation is nearest to each of (frame, 3, 3)."""
    way = np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=1,
    )
    along = np.einsum("i,fij,j->f", axis, rotation, axis)
    return np.arctan2(way @ axis, np.trace(rotation, axis1=1, axis2=2) - along)
