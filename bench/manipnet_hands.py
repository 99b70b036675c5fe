"""ManipNet's own hands, without any fit: 17 joints and 19 capsules of each hand at the rate of the files (120 Hz).

What ManipNet's own measures are defined on. World, units and mirror as in ManipNet's adapter.
"""

import json
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hoidata.clips.clip import SIDES, Side
from hoidata.datasets.base import RawTree
from hoidata.datasets.manipnet.adapter import (
    HAND_JOINTS,
    HAND_REFERENCE,
    METRES_PER_UNIT,
    MIRROR_X,
    TIP_JOINTS,
    keypoints_m,
    read_recording,
)
from hoidata.datasets.manipnet.bvh import BvhMotion, parse_bvh, unpack_text
from hoidata.datasets.manipnet.segments import LIFTED_M, height_above_table
from hoidata.errors import BadInput
from hoidata.objects.model import ObjectModel
from hoidata.physics.capsules import Capsules, ObjectPoses, joined
from hoidata.physics.scene import Scene

N_CAPSULES = 19


class HandMotion(NamedTuple):
    """joints_m: (frame, joint, 3) world, metres, the wrist first; NaN in frames in which the hand is not there.

    wrist_rotmats: (frame, 3, 3) world_from_wrist.
    """

    joints_m: np.ndarray
    wrist_rotmats: np.ndarray


@dataclass(frozen=True)
class SourceRecording:
    """One two-hand sequence at its own rate, right-handed world, metres.

    joints_m: per side (frame, 22, 3): the 17 joints in file order, then the tips of index, middle, pinky, ring, thumb.
    wrist_rotmats: per side (frame, 3, 3) world_from_wrist. capsules: per side, in the order of the reference file.
    usable: (frame,) bool, not in a stretch the adapter leaves out. lift_m: (frame,) height of the lowest vertex above
    the table, which is its 3rd percentile over the sequence.
    """

    fps: float
    model: ObjectModel
    poses: ObjectPoses
    joints_m: dict[Side, np.ndarray]
    wrist_rotmats: dict[Side, np.ndarray]
    capsules: dict[Side, Capsules]
    usable: np.ndarray
    lift_m: np.ndarray

    @property
    def lifted(self) -> np.ndarray:
        """(frame,) bool: more than 1.5 cm above the table."""
        return self.lift_m > LIFTED_M

    @property
    def scene(self) -> Scene:
        """For ``physics.realism``: every frame, the left hand's 19 capsules before the right's, y up."""
        capsules = joined([self.capsules[side] for side in SIDES])
        return Scene(self.model, self.poses, capsules, self.fps, np.array([0.0, -1.0, 0.0]))

    @property
    def motions(self) -> dict[str, HandMotion]:
        """For ``physics.realism``: joints and wrists of both hands."""
        return {side: HandMotion(self.joints_m[side], self.wrist_rotmats[side]) for side in SIDES}


@dataclass(frozen=True)
class _LocalCapsules:
    """Of the right hand, in joint frames, source units, right-handed axes. joint: (19,) index in HAND_JOINTS."""

    joint: np.ndarray
    start: np.ndarray
    end: np.ndarray
    radius: np.ndarray


def read_source_hands(raw: RawTree, name: str) -> SourceRecording:
    """Read one sequence with both hands, every frame. Raises BadInput as the adapter does."""
    recording = read_recording(raw, name)
    left_path, right_path, object_path = recording.paths[:3]
    motions = {"left": _motion(raw, left_path), "right": _motion(raw, right_path)}
    thing = _motion(raw, object_path)
    local = read_capsules(raw)
    ends = {HAND_JOINTS[joint]: end for joint, end in zip(local.joint, local.end, strict=True)}
    tips = {joint: ends[joint] for joint in TIP_JOINTS}
    placed = {side: motions[side].world_joints() for side in SIDES}
    positions, rotations = thing.world_joints()
    poses = ObjectPoses(rotations[:, 0], positions[:, 0] * METRES_PER_UNIT)
    usable = np.ones(thing.n_frames, dtype=bool)
    for cut in recording.cuts:
        usable[cut.start : cut.stop] = False
    lowest = (recording.model.vertices_m @ poses.rotmats[:, 1].T + poses.translation_m[:, 1]).min(axis=0)
    return SourceRecording(
        fps=recording.source_fps,
        model=recording.model,
        poses=poses,
        joints_m={
            side: np.concatenate(
                [placed[side][0] * METRES_PER_UNIT, keypoints_m(motions[side], side, tips)[:, 16:]], axis=1
            )
            for side in SIDES
        },
        wrist_rotmats={side: placed[side][1][:, 0] for side in SIDES},
        capsules={side: _placed(local, side, *placed[side]) for side in SIDES},
        usable=usable,
        lift_m=height_above_table(lowest),
    )


def read_capsules(raw: RawTree) -> _LocalCapsules:
    """The 19 capsules of the right hand. Raises BadInput when the reference file does not hold them."""
    try:
        rows = json.loads(raw.read(HAND_REFERENCE))["capsules"]
        joint = np.array([HAND_JOINTS.index(row["joint"]) for row in rows])
        start, end = (np.array([row[key] for row in rows], dtype=np.float64) for key in ("start_local", "end_local"))
        radius = np.array([row["radius"] for row in rows], dtype=np.float64)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        expected = "capsules with joint, start_local, end_local and radius"
        raise BadInput(HAND_REFERENCE, expected, f"{type(error).__name__}: {error}") from error
    right = start.shape == end.shape == (N_CAPSULES, 3) and radius.shape == (N_CAPSULES,)
    if not right or not all(np.isfinite(array).all() for array in (start, end, radius)) or not (radius > 0).all():
        expected = f"{N_CAPSULES} capsules of finite numbers with positive radii"
        raise BadInput(HAND_REFERENCE, expected, f"arrays {start.shape}, {end.shape}, {radius.shape}")
    return _LocalCapsules(joint, start * MIRROR_X, end * MIRROR_X, radius)


def _motion(raw: RawTree, path: str) -> BvhMotion:
    return parse_bvh(unpack_text(raw.read(path), path), path).seen_in_mirror_x()


def _placed(local: _LocalCapsules, side: Side, positions: np.ndarray, rotations: np.ndarray) -> Capsules:
    mirror = np.ones(3) if side == "right" else MIRROR_X
    start, end = (
        (positions[:, local.joint] + np.einsum("fcij,cj->fci", rotations[:, local.joint], points * mirror))
        * METRES_PER_UNIT
        for points in (local.start, local.end)
    )
    return Capsules(start, end, local.radius * METRES_PER_UNIT)
