"""The real ManipNet recordings with their own 17-joint hands at 60 Hz, as the table of fingers needs them."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.manipnet_hands import HandMotion
from hoidata.clips.clip import SIDES, Side
from hoidata.datasets.base import RawTree
from hoidata.datasets.manipnet.adapter import METRES_PER_UNIT, Recording, read_recording
from hoidata.datasets.manipnet.bvh import BvhMotion, angles_yxz_to_rotmat, parse_bvh, unpack_text
from hoidata.datasets.manipnet.hand import read_hand
from hoidata.datasets.manipnet.segments import LIFTED_M, height_above_table
from hoidata.geometry.intervals import Interval, runs
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.surface_index import SurfaceIndex, surface_index
from hoidata.physics.capsules import Capsules, ObjectPoses, joined
from hoidata.physics.scene import Scene
from models.manipnet.control import Control, Motion

RATE_HZ = 60
NAMES = ("cyl_med3", "cube_med2", "cup1", "mug1", "teapot2")
TENTHS, ROUND = 10, 5  # of five successive tenths three train, the fourth validates, the last tests
TRAIN, VALIDATION, TEST = (0, 1, 2), (3,), (4,)
GUARD_S = 0.5  # what a sample looks ahead and back


@dataclass(frozen=True, eq=False)
class HandRecording:
    """One recording. fingers: per side (frame, 16, 3, 3) local rotations. usable, lifted: (frame,) bool."""

    name: str
    control: Control
    hands: dict[Side, TrackedHand]
    fingers: dict[Side, np.ndarray]
    usable: np.ndarray
    lifted: np.ndarray
    table_m: float

    @property
    def time_s(self) -> np.ndarray:
        return self.control.thing.time_s

    @property
    def n_frames(self) -> int:
        return len(self.time_s)

    @property
    def surface(self) -> SurfaceIndex:
        return surface_index(self.control.model)

    def tenths(self, kinds: tuple[int, ...]) -> np.ndarray:
        """(frame,) bool: in a tenth of the recording of these kinds (number within its round)."""
        tenth = np.arange(self.n_frames) * TENTHS // self.n_frames
        return np.isin(tenth % ROUND, kinds)

    @property
    def trains(self) -> np.ndarray:
        """(frame,) bool: in a training tenth, and nothing within 0.5 s of it is tested or chosen by."""
        held = np.flatnonzero(~self.tenths(TRAIN))
        guard = round(GUARD_S * RATE_HZ) + 1
        near = np.zeros(self.n_frames + 2 * guard, dtype=bool)
        for shift in range(2 * guard + 1):
            near[held + shift] = True
        return ~near[guard:-guard]

    def intervals(self, frames: np.ndarray) -> list[Interval]:
        """Usable intervals of these frames, without a break, that hold a lifted frame."""
        return [found for found in runs(frames & self.usable) if self.lifted[slice(*found)].any()]

    def states(self, fingers: dict[Side, np.ndarray], frames: slice) -> dict[Side, HandState]:
        """Hands of some frames in the world; fingers: per side (frame, 16, 3, 3) of these frames."""
        time_s = self.time_s[frames]
        return {
            side: self.hands[side].state(fingers[side]).placed(self.control.wrists[side].at(time_s)) for side in SIDES
        }

    def scene(self, states: dict[Side, HandState], frames: slice) -> Scene:
        """For ``physics.realism``: the object and both hands' capsules, left before right, y up."""
        parts = [
            Capsules(state.capsule_start_m, state.capsule_end_m, self.hands[side].capsules.radius_m)
            for side, state in states.items()
        ]
        thing = self.control.thing
        poses = ObjectPoses(thing.rotmats[frames], thing.position_m[frames])
        return Scene(self.control.model, poses, joined(parts), RATE_HZ, np.array([0.0, -1.0, 0.0]), self.table_m)

    def motion(self, state: HandState) -> HandMotion:
        """For smoothness: the 22 points, the wrist first, and the wrist's turn."""
        return HandMotion(state.point_m, state.joint_rotmats[:, 0])


def read_hands(root: Path, name: str) -> HandRecording:
    """Read one recording from the data folder."""
    raw = RawTree(root)
    recording = read_recording(raw, name)
    left_path, right_path, object_path = recording.paths[:3]
    motions = {"left": _motion(raw, left_path), "right": _motion(raw, right_path)}
    step = round(recording.source_fps / RATE_HZ)
    every = slice(None, None, step)
    right = read_hand(raw, motions["right"])
    bodies = {side: _body(motions[side], every) for side in SIDES}
    thing = _body(_motion(raw, object_path), every)
    usable = np.ones(len(motions["left"].root_position), dtype=bool)
    for cut in recording.cuts:
        usable[cut.start // step * step : cut.stop] = False
    lowest = _lowest_m(recording, thing)
    height = height_above_table(lowest)
    return HandRecording(
        name,
        Control(bodies, thing, recording.model),
        {"left": right.mirrored(), "right": right},
        {side: angles_yxz_to_rotmat(motions[side].angles_yxz_rad[every, 1:]) for side in SIDES},
        usable[every],
        height > LIFTED_M,
        float((lowest - height)[0]),
    )


def _motion(raw: RawTree, path: str) -> BvhMotion:
    return parse_bvh(unpack_text(raw.read(path), path), path).seen_in_mirror_x()


def _body(motion: BvhMotion, every: slice) -> Motion:
    """The root of a motion at 60 Hz, metres."""
    rotmats = angles_yxz_to_rotmat(motion.angles_yxz_rad[every, 0])
    position = (motion.root_position[every] + motion.offsets[0]) * METRES_PER_UNIT
    return Motion(np.arange(len(position)) / RATE_HZ, rotmats, position)


def _lowest_m(recording: Recording, thing: Motion) -> np.ndarray:
    heights = recording.model.vertices_m @ thing.rotmats[:, 1].T + thing.position_m[:, 1]
    return heights.min(axis=0)
