"""Two parts that were tracked one by one, as one object with a hinge."""

from itertools import product
from typing import NamedTuple

import numpy as np

from hoidata.clips.quarantine import Quarantined
from hoidata.geometry.rotations import rotation_angle, rotmat_to_rotvec
from hoidata.objects.model import Hinge, ObjectModel

ROUNDS = 3
LEAST_KEPT = 0.95
LEAST_TURN_RAD = np.deg2rad(15)  # parts that turn less against each other do not tell where their hinge is


class HingeFit(NamedTuple):
    """world_from_object (frame, 4, 4), hinge_rad (frame,), unwrapped.

    residual_m, residual_rad: (frame,) how far both parts lie from where they were tracked, root mean square over the
    corners of their boxes, and how far their relative rotation is off the hinge.
    """

    world_from_object: np.ndarray
    hinge_rad: np.ndarray
    residual_m: np.ndarray
    residual_rad: np.ndarray

    def off(self, most_mm: float, most_deg: float) -> np.ndarray:
        """(frame,) bool: the parts lie farther than that from one hinge."""
        return (self.residual_m > most_mm / 1000) | (self.residual_rad > np.deg2rad(most_deg))

    @property
    def note(self) -> str:
        """How well the parts keep to the hinge, in words."""
        mm, degrees = (np.percentile(v, 95) for v in (1000 * self.residual_m, np.rad2deg(self.residual_rad)))
        return f"hinge: {mm:.2f} mm and {degrees:.2f} degrees off in 95 % of frames"

    def left_out(self, source_key: str, where: str, frames: np.ndarray, most_mm: int, most_deg: int) -> Quarantined:
        """The frames of the source (frame,) in which the parts lie farther off, as one reason."""
        far = frames[self.off(most_mm, most_deg)]
        worst = f"up to {1000 * self.residual_m.max():.1f} mm and {np.rad2deg(self.residual_rad.max()):.1f} degrees"
        expected = f"both parts within {most_mm} mm and {most_deg} degrees of one hinge"
        got = f"{worst} in {len(far)} frames, the first {far[0]}"
        return Quarantined(source_key, where, expected, got, "nothing to do, or raise most_off_mm")


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


def find_hinge(turned: np.ndarray) -> Hinge | None:
    """The axis that the turns of a part against its base (frame, 4, 4) share; None where it turns too little to tell.

    turned: base from the part as it lies at rest. The axis points the way of its largest component.
    """
    rotvec = rotmat_to_rotvec(turned[:, :3, :3])
    axis = np.linalg.eigh(rotvec.T @ rotvec)[1][:, -1]
    axis *= np.sign(axis[np.abs(axis).argmax()])
    if np.ptp(np.unwrap(_angle_about(axis, turned[:, :3, :3]))) < LEAST_TURN_RAD:
        return None
    plane = np.linalg.svd(axis[None])[2][1:].T  # (3, 2): along the axis its origin may lie anywhere
    ways = (np.eye(3) - turned[:, :3, :3]) @ plane
    place = np.linalg.lstsq(ways.reshape(-1, 2), turned[:, :3, 3].reshape(-1), rcond=None)[0]
    return Hinge(axis, plane @ place)


def hinge_between(
    base: np.ndarray, turned: np.ndarray, corners_m: tuple[np.ndarray, np.ndarray], most_mm: int, most_deg: int
) -> tuple[Hinge, HingeFit] | None:
    """The hinge of two parts that were tracked apart; None where they turn too little, or keep to none.

    base: (frame, 4, 4) world from the base; turned: (frame, 4, 4) base from the other part as it lies at rest;
    corners_m: (8, 3) of each part's box at rest. Frames farther off than ``most_mm`` or ``most_deg`` are found out
    and have no say; of more than 5 % the parts have no hinge.
    """
    kept = np.ones(len(base), bool)
    for _ in range(2):
        hinge = find_hinge(turned[kept]) if kept.any() else None
        if hinge is None:
            return None
        fit = fit_hinge(base, base @ turned, hinge, corners_m)
        kept = ~fit.off(most_mm, most_deg)
    return (hinge, fit) if kept.mean() >= LEAST_KEPT else None


def hinged_model(name: str, vertices_m: list[np.ndarray], faces: list[np.ndarray], hinge: Hinge) -> ObjectModel:
    """Two meshes as one object at rest, the base first."""
    counts = [len(own) for own in vertices_m]
    part = np.repeat(np.array([0, 1], np.uint8), counts)
    return ObjectModel(name, np.concatenate(vertices_m), np.concatenate([faces[0], faces[1] + counts[0]]), part, hinge)


def box_corners(points_m: np.ndarray) -> np.ndarray:
    """(8, 3) of the box around points (point, 3)."""
    return np.array(list(product(*np.stack([points_m.min(axis=0), points_m.max(axis=0)]).T)))


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
