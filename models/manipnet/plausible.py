"""Plausibility check of trajectory files: finds wrong units, wrong quaternion order and wrong wrist axes.

The check uses the hand poses relative to the object, because such a mistake moves or rotates the hands. Of 296 clips
(embedded H2O, GRAB and ARCTIC, real ManipNet) in five world rotations each, it refuses 2 of 1,480. With quaternions in
another order, it accepts 2 of 1,480; with other wrist axes none. It accepts both demos of ManipNet with 14 objects.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Side
from hoidata.errors import BadInput
from hoidata.geometry.motion import Motion
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.object_paths.trajectory_files import TrajectoryFile
from hoidata.objects.convex_hull import convex_hull
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.objects.user_mesh import UNITS_M
from models.manipnet.control import Control, untracked_wrist

NEAR_M = 0.12  # from the palm centre to the object; a hand that never comes this close is not active
PALM_M = 0.08  # from the wrist to the palm centre
REACH_M = NEAR_M + PALM_M  # from the wrist, for any direction of the palm
MAX_PALM_DEPTH_M = 0.03  # a palm deeper in the object is implausible
MIN_WRIST_DISTANCE_M = 0.015  # from the object's hull; recorded wrists are at least 1.9 cm away
MAX_FRACTION = 0.5  # of a hand's near frames that may violate a limit
PALM_DIRECTION = np.array([0.8, 0.0, -0.6])  # from the wrist to a grasped object, canonical axes
MIN_ALIGNMENT = 0.6  # of the palm; recorded hands have at least 0.8, with other wrist axes at most 0.3
MIN_GAIN = 0.02  # of the sum of both hands' alignment, for quaternions in the order x, y, z, w
MAX_CHECKED_FRAMES = 10_000  # longer files are thinned evenly


class Reading(NamedTuple):
    """One interpretation of a file."""

    control: Control
    nearest_m: Mapping[Side, float]  # least distance of each palm from the object
    alignment: Mapping[Side, float]  # mean cosine between palm direction and object: 1 towards it, -1 away
    fault: BadInput | None  # why it is implausible; None if it is plausible

    @property
    def active(self) -> list[Side]:
        return [side for side in SIDES if self.nearest_m.get(side, np.inf) < NEAR_M]

    def gain_over(self, other: "Reading") -> float:
        """By how much this reading's near hands are aligned better than in the other reading."""
        return sum(self.alignment[side] - other.alignment[side] for side in self.active)


def plausible_reading(file: TrajectoryFile, model: ObjectModel, hands: Mapping[Side, TrackedHand]) -> Reading:
    """The file as given. Raises BadInput if it is implausible; the remedy names the probable changes."""
    as_given = reading(file, model, hands)
    fault, fits_reordered = as_given.fault, False
    if not file.is_calibrated:  # else quaternions differ from those of the file
        reordered = reading(file.with_bodies(_reordered), model, hands)
        fits_reordered = not reordered.fault and (fault is not None or reordered.gain_over(as_given) > MIN_GAIN)
    if fault is None and not fits_reordered:
        return as_given
    units = [unit for unit, scaled in _other_units(file) if fault and not reading(scaled, model, hands).fault]
    if fault is None or (fits_reordered and not units):
        got = "hands that fit the object only in the order x, y, z, w"
        fault = BadInput(file.source, "quaternions in the order w, x, y, z", got, "put w first")
    remedy = fault.remedy
    if units:
        remedy = f"perhaps the positions have another unit: --trajectory-unit {' or '.join(units)}"
    elif file.is_calibrated:
        remedy += "; or record the calibration again"
    elif as_given.fault and file.unit:
        remedy += "; or the wrists have other axes: name them (--wrist-axes) or measure them (--calibration)"
    raise BadInput(file.source, fault.expected, fault.got, remedy)


def reading(file: TrajectoryFile, model: ObjectModel, hands: Mapping[Side, TrackedHand]) -> Reading:
    """Read a file's trajectories with an object and measure their plausibility."""
    control = _control(file, model, hands)
    time_s = control.object_motion.time_s
    thinned = control.at(time_s[:: 1 + (len(time_s) - 1) // MAX_CHECKED_FRAMES])
    placed_hands: dict[Side, _PlacedHand] = {side: _PlacedHand(thinned, side, hands[side]) for side in file.wrists}
    nearest: dict[Side, float] = {side: float(placed.palm_distance_m.min()) for side, placed in placed_hands.items()}
    alignment: dict[Side, float] = {side: placed.alignment() for side, placed in placed_hands.items()}
    fault = _far(file, nearest) or _inside(file, placed_hands) or _turned_away(file, alignment, nearest)
    return Reading(control, nearest, alignment, fault)


def _control(file: TrajectoryFile, model: ObjectModel, hands: Mapping[Side, TrackedHand]) -> Control:
    """Convert a file to a control signal; a missing hand is placed out of range of all sensors."""
    object_body = file.object_body
    if file.at_box:
        middle = (model.vertices_m.min(axis=0) + model.vertices_m.max(axis=0)) / 2
        object_body = replace(object_body, position_m=object_body.position_m - object_body.rotmats @ middle)
    wrists: dict[Side, Motion] = {
        side: replace(wrist, rotmats=wrist.rotmats @ _file_from_model(file, hands[side]))
        for side, wrist in file.wrists.items()
    }
    absent_wrist = untracked_wrist(object_body.time_s[:1], object_body.position_m[:1])
    both: dict[Side, Motion] = {side: wrists.get(side, absent_wrist) for side in SIDES}
    return Control(both, object_body, model, file.hinge_rad)


def _file_from_model(file: TrajectoryFile, hand: TrackedHand) -> np.ndarray:
    """(3, 3) rotation from the hand model's wrist axes to the file's."""
    if file.axes == "model":
        return np.eye(3)
    file_from_canonical = np.diag([-1.0 if hand.side == "left" else 1.0, 1.0, 1.0])
    return file_from_canonical @ hand.wrist_from_canonical.T


class _PlacedHand:
    """The wrist and palm of a hand in the object's frame, with their distances from its surface."""

    def __init__(self, control: Control, side: Side, hand: TrackedHand) -> None:
        wrist, object_motion = control.wrists[side], control.object_motion
        self.control, self.hand = control, hand
        self.object_from_wrist = np.swapaxes(object_motion.rotmats, 1, 2) @ wrist.rotmats  # (frame, 3, 3) rotation
        self.wrist_m = ((wrist.position_m - object_motion.position_m)[:, None] @ object_motion.rotmats)[:, 0]
        self.palm_m = self.wrist_m + self.object_from_wrist @ (hand.wrist_from_canonical @ [PALM_M, 0.0, 0.0])
        nearest = surface_index(control.model).nearest(self.palm_m[:, None], control.hinge_rad)
        self.palm_distance_m, self.closest_m = nearest.distance_m[:, 0], nearest.closest_m[:, 0]
        self.is_near = self.palm_distance_m < NEAR_M

    def distance_m(self, model: ObjectModel) -> np.ndarray:
        """(frame,) signed distance of the wrist from a model with the object's hinge angles."""
        return surface_index(model).nearest(self.wrist_m[:, None], self.control.hinge_rad).distance_m[:, 0]

    def fraction_of_near(self, frames: np.ndarray) -> float:
        return float((frames & self.is_near).sum() / max(self.is_near.sum(), 1))

    def alignment(self) -> float:
        """Mean cosine of the palm direction with the object, in the frames in which the hand can reach it.

        The mean of those with the object's centre and with its surface point nearest to the palm; -1 without a frame.
        """
        reachable = self.distance_m(self.control.model) < REACH_M
        if not reachable.any():
            return -1.0
        palm_directions = self.object_from_wrist[reachable] @ (self.hand.wrist_from_canonical @ PALM_DIRECTION)
        targets_m = self.control.model.vertices_m.mean(axis=0), self.closest_m[reachable]
        return sum(_mean_cosine(palm_directions, target_m - self.wrist_m[reachable]) for target_m in targets_m) / 2


def _mean_cosine(directions: np.ndarray, vectors: np.ndarray) -> float:
    """Mean cosine of the angle between unit vectors and vectors of any length, both (frame, 3)."""
    length = np.maximum(np.linalg.norm(vectors, axis=1), 1e-9)
    return float(((directions * vectors).sum(axis=1) / length).mean())


def _far(file: TrajectoryFile, nearest_m: Mapping[Side, float]) -> BadInput | None:
    if min(nearest_m.values()) < NEAR_M:
        return None
    expected = f"a palm that comes within {NEAR_M} m of the object"
    got = ", ".join(f"the {side} one {metres:.3g} m" for side, metres in nearest_m.items())
    return BadInput(file.source, expected, got, "check the positions and their unit")


def _turned_away(
    file: TrajectoryFile, alignments: Mapping[Side, float], nearest_m: Mapping[Side, float]
) -> BadInput | None:
    """The fault of near palms of which none faces the object."""
    alignment = max(alignment for side, alignment in alignments.items() if nearest_m[side] < NEAR_M)
    if alignment > MIN_ALIGNMENT:
        return None
    expected = f"a palm that faces the object, with a cosine above {MIN_ALIGNMENT}"
    return BadInput(file.source, expected, f"at most {alignment:.2g}", "check the origin and axes of the mesh")


def _inside(file: TrajectoryFile, placed_hands: Mapping[Side, _PlacedHand]) -> BadInput | None:
    """The fault of a palm deep in the object, or a wrist in its convex hull, in most near frames."""
    for side, placed in placed_hands.items():
        name = placed.control.model.name
        if (fraction := placed.fraction_of_near(placed.palm_distance_m < -MAX_PALM_DEPTH_M)) > MAX_FRACTION:
            got = f"a {side} palm inside it in {100 * fraction:.0f} % of the frames in which it is near"
            remedy = "perhaps the mesh has another unit (--unit cm), or another origin than in the trajectories"
            return BadInput(file.source, f"{name} outside of the hands", got, remedy)
        buried = placed.distance_m(convex_hull(placed.control.model)) < MIN_WRIST_DISTANCE_M
        if (fraction := placed.fraction_of_near(buried)) > MAX_FRACTION:
            got = f"a {side} wrist in it or closer in {100 * fraction:.0f} % of the frames in which the palm is near"
            remedy = "check the unit of the positions (--trajectory-unit) and of the mesh (--unit)"
            return BadInput(file.source, f"a wrist at least {100 * MIN_WRIST_DISTANCE_M} cm off {name}", got, remedy)
    return None


def _reordered(body: Motion) -> Motion:
    """The body if its quaternions are in the order x, y, z, w instead of w, x, y, z."""
    # SciPy's order is x, y, z, w.
    as_read = Rotation.from_matrix(body.rotmats).as_quat()[:, [3, 0, 1, 2]]
    return replace(body, rotmats=Rotation.from_quat(as_read).as_matrix())


def _other_units(file: TrajectoryFile) -> Iterator[tuple[str, TrajectoryFile]]:
    """The file in other units, in the order of their ratio to the given one."""
    if not file.unit:
        return
    factors = {unit: metres / UNITS_M[file.unit] for unit, metres in UNITS_M.items() if unit != file.unit}
    for unit, factor in sorted(factors.items(), key=lambda item: abs(np.log(item[1]))):
        yield unit, file.with_bodies(lambda body, factor=factor: replace(body, position_m=body.position_m * factor))
