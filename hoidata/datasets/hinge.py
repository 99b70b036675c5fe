"""Fits a hinge to two separately tracked parts and joins them to one articulated object."""

from itertools import product
from typing import NamedTuple

import numpy as np

from hoidata.clips.quarantine import Quarantined
from hoidata.geometry.rotations import rotation_angle, rotmat_to_rotvec
from hoidata.objects.model import Hinge, ObjectModel

N_ITERATIONS = 3
MIN_USED_FRACTION = 0.95
MIN_ROTATION_RAD = np.deg2rad(15)  # a smaller relative rotation does not determine the hinge


class HingeFit(NamedTuple):
    """Poses of an articulated object that approximate two tracked parts."""

    world_from_object: np.ndarray  # (frame, 4, 4)
    hinge_rad: np.ndarray  # (frame,) unwrapped
    residual_m: np.ndarray  # (frame,) RMS distance of both parts' box corners from their tracked positions
    residual_rad: np.ndarray  # (frame,) angle between the relative rotation and the hinge rotation

    def exceeds(self, most_mm: float, most_deg: float) -> np.ndarray:
        """(frame,) bool: a residual is larger than the limit."""
        return (self.residual_m > most_mm / 1000) | (self.residual_rad > np.deg2rad(most_deg))

    @property
    def note(self) -> str:
        """The residuals in words."""
        mm, degrees = (np.percentile(v, 95) for v in (1000 * self.residual_m, np.rad2deg(self.residual_rad)))
        return f"hinge: {mm:.2f} mm and {degrees:.2f} degrees off in 95 % of frames"

    def rejected_frames_reason(
        self, source_key: str, location: str, frames: np.ndarray, most_mm: int, most_deg: int
    ) -> Quarantined:
        """One reason for the frames whose residuals exceed the limits. frames: (frame,) numbers in the source."""
        rejected_frames = frames[self.exceeds(most_mm, most_deg)]
        worst = f"{1000 * self.residual_m.max():.1f} mm and {np.rad2deg(self.residual_rad.max()):.1f} degrees"
        expected = f"both parts within {most_mm} mm and {most_deg} degrees of one hinge"
        got = f"up to {worst} in {len(rejected_frames)} frames, the first {rejected_frames[0]}"
        remedy = "nothing to do, or raise most_off_mm"
        return Quarantined(source_key, where=location, expected=expected, got=got, remedy=remedy)


def rigid_fit(from_m: np.ndarray, to_m: np.ndarray) -> np.ndarray:
    """Least-squares rigid transforms (frame, 4, 4) between corresponding points (frame, point, 3) (Kabsch 1976)."""
    from_mean, to_mean = from_m.mean(axis=1, keepdims=True), to_m.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd((to_m - to_mean).transpose(0, 2, 1) @ (from_m - from_mean))
    signs = np.ones((len(u), 3))  # excludes reflections
    signs[:, 2] = np.sign(np.linalg.det(u @ vt))
    transforms = np.tile(np.eye(4), (len(u), 1, 1))
    transforms[:, :3, :3] = (u * signs[:, None]) @ vt
    transforms[:, :3, 3] = (to_mean - from_mean @ transforms[:, :3, :3].transpose(0, 2, 1))[:, 0]
    return transforms


def fit_hinge(base: np.ndarray, moving: np.ndarray, hinge: Hinge, corners_m: tuple[np.ndarray, np.ndarray]) -> HingeFit:
    """Fit one object pose and one hinge angle per frame to two separately tracked parts.

    Alternates two steps: the angle of the relative rotation about the axis, and the pose closest to the corners of both
    parts. base, moving: (frame, 4, 4) world from part, in the coordinates of the whole object at rest. corners_m: (8,
    3) box corners of each part at rest.
    """
    tracked_m = np.concatenate([_transformed(base, corners_m[0]), _transformed(moving, corners_m[1])], axis=1)
    pose = base
    for _ in range(N_ITERATIONS):
        angle = np.unwrap(_angle_about(hinge.axis, pose[:, :3, :3].transpose(0, 2, 1) @ moving[:, :3, :3]))
        of_base = np.broadcast_to(corners_m[0], (len(base), 8, 3))
        rest = np.concatenate([of_base, hinge.turn(angle) @ corners_m[1]], axis=1)
        pose = rigid_fit(rest, tracked_m)
    distance_m = np.linalg.norm(_transformed(pose, rest) - tracked_m, axis=2)
    relative = pose[:, :3, :3].transpose(0, 2, 1) @ moving[:, :3, :3]
    residual_rotation = hinge.turn(angle).rotation.transpose(0, 2, 1) @ relative
    return HingeFit(pose, angle, np.sqrt((distance_m**2).mean(axis=1)), rotation_angle(residual_rotation))


def find_hinge(base_from_part: np.ndarray) -> Hinge | None:
    """Estimate the common axis of a part's rotations relative to its base; its largest component is positive.

    base_from_part: (frame, 4, 4), relative to the pose at rest. None if the part rotates by less than 15 degrees.
    """
    rotvec = rotmat_to_rotvec(base_from_part[:, :3, :3])
    axis = np.linalg.eigh(rotvec.T @ rotvec)[1][:, -1]
    axis *= np.sign(axis[np.abs(axis).argmax()])
    if np.ptp(np.unwrap(_angle_about(axis, base_from_part[:, :3, :3]))) < MIN_ROTATION_RAD:
        return None
    # Points on the axis are fixed: (I - R) origin = t. The origin is unique only in the plane normal to the axis.
    plane = np.linalg.svd(axis[None])[2][1:].T  # (3, 2)
    displacement = (np.eye(3) - base_from_part[:, :3, :3]) @ plane
    origin = np.linalg.lstsq(displacement.reshape(-1, 2), base_from_part[:, :3, 3].reshape(-1), rcond=None)[0]
    return Hinge(axis, plane @ origin)


def hinge_between(
    base: np.ndarray, base_from_part: np.ndarray, corners_m: tuple[np.ndarray, np.ndarray], most_mm: int, most_deg: int
) -> tuple[Hinge, HingeFit] | None:
    """Estimate the hinge between two separately tracked parts, and fit it.

    Frames whose residuals exceed the limits are excluded from a second estimate. None if the parts rotate too little,
    or if more than 5 % of the frames exceed a limit. base: (frame, 4, 4) world from base. base_from_part: (frame, 4,
    4), relative to the pose at rest. corners_m: (8, 3) box corners of each part at rest.
    """
    used_frames = np.ones(len(base), bool)
    for _ in range(2):
        hinge = find_hinge(base_from_part[used_frames]) if used_frames.any() else None
        if hinge is None:
            return None
        fit = fit_hinge(base, base @ base_from_part, hinge, corners_m)
        used_frames = ~fit.exceeds(most_mm, most_deg)
    return (hinge, fit) if used_frames.mean() >= MIN_USED_FRACTION else None


def hinged_model(name: str, vertices_m: list[np.ndarray], faces: list[np.ndarray], hinge: Hinge) -> ObjectModel:
    """Join two meshes to one object at rest. The base is the first mesh."""
    counts = [len(vertices) for vertices in vertices_m]
    part, joined = np.repeat(np.array([0, 1], np.uint8), counts), np.concatenate([faces[0], faces[1] + counts[0]])
    return ObjectModel(name, np.concatenate(vertices_m), joined, part, hinge=hinge)


def box_corners(points_m: np.ndarray) -> np.ndarray:
    """(8, 3) corners of the bounding box of points (point, 3)."""
    return np.array(list(product(*np.stack([points_m.min(axis=0), points_m.max(axis=0)]).T)))


def _transformed(transforms: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    return points_m @ transforms[:, :3, :3].transpose(0, 2, 1) + transforms[:, None, :3, 3]


def _angle_about(axis: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(frame,) angle of the rotation about the unit axis that is closest to each rotation (frame, 3, 3)."""
    doubled_sine = rotation - rotation.transpose(0, 2, 1)
    sine_axis = np.stack([doubled_sine[:, 2, 1], doubled_sine[:, 0, 2], doubled_sine[:, 1, 0]], axis=1)
    along = np.einsum("i,fij,j->f", axis, rotation, axis)
    return np.arctan2(sine_axis @ axis, np.trace(rotation, axis1=1, axis2=2) - along)
