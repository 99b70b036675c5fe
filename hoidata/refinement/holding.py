"""Contact refinement of generated grasps: hands do not slide on the object, touch its surface and can carry it.

Each hand is refined in the frame of the part that it touches most, in which a grasp is a constant pose.
``grasp_solver`` finds this pose and a smooth correction of the frames around it. If the hands cannot carry an object
in the air, skin is attracted from farther away in further attempts. If that fails, alternative grasps are sampled and
the closest stable one is used (``regrasping``).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from types import MappingProxyType

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.errors import BadInput
from hoidata.geometry.intervals import Interval, runs
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.model import N_VERTICES, HandModel, HandPair
from hoidata.objects.surface_index import surface_index
from hoidata.physics.capsules import CapsuleContacts, Capsules, joined
from hoidata.physics.realism import StandardUnits
from hoidata.physics.scene import Scene, capsules_or_nan, object_scene
from hoidata.refinement.grasp_solver import Attraction, HandMotion, SolverSettings
from hoidata.refinement.kernels import N_UNKNOWNS
from hoidata.refinement.object_field import ObjectField, world_from_part
from hoidata.refinement.regrasping import GraspSearchSettings, Held, bends_rad, search_grasps
from hoidata.refinement.resting import RestingSettings, snap_to_rest
from hoidata.refinement.skin import HandPose, SkinnedHand
from hoidata.workers import one_thread

_OPPOSITE: Mapping[Side, Side] = {"left": "right", "right": "left"}
_ALONG = 9  # places along a capsule's axis at which it is looked at
_SOME_SKIN = 3  # one of so many vertices is looked at in the search of another grasp
_LEAST_SLOPE = 1e-6  # shorter ones say no direction
_PASSING_RAD = 0.05  # a lid that opens by this much moves past a hand on the base
_UNDER_M = 0.005  # so much lower than the table, or than before, a hand with another grasp may be


@dataclass(frozen=True)
class GraspSettings:
    """Contact refinement: what counts as a grasp, and how it is corrected.

    Raises BadInput if reach_m and keypoint_m differ in length or are empty.
    """

    near_m: float = 0.006  # a hand touches if its skin is closer than this
    still_m_s: float = 0.02  # a touching hand slower than this on a part at rest grasps it
    carried_m_s: float = 0.3  # the same on a moving part
    moving_m_s: float = 0.02  # a part faster than this moves
    least: int = 6  # frames of a grasp
    gap: int = 12  # two grasps with at most so many frames between them are one
    same_m: float = 0.08  # if the hand moved less than this on the part between them
    blend: int = 8  # frames in which a hand comes to its grasp, and leaves it
    carry: int = 4  # frames by which a grasp is extended if the part moves in no hand
    reach_m: tuple[float, ...] = (0.003, 0.012, 0.03, 0.06)  # per attempt, as in Attraction
    keypoint_m: tuple[float, ...] = (0.006, 0.012, 0.02, 0.04)  # per attempt, as in Attraction
    air_frames: int = (
        4  # frames with the object in the air in which the hands must carry it, or there is another attempt
    )
    solver: SolverSettings = field(default_factory=SolverSettings)
    regrasp: GraspSearchSettings = field(default_factory=GraspSearchSettings)  # after the last attempt
    rest: RestingSettings = field(default_factory=RestingSettings)  # before the first attempt

    def __post_init__(self) -> None:
        if len(self.reach_m) != len(self.keypoint_m) or not self.reach_m:
            got = f"{len(self.reach_m)} and {len(self.keypoint_m)}"
            raise BadInput(
                "hold: reach_m, keypoint_m", "as many of each, one at least", got, "give one of each per attempt"
            )


@one_thread()
def refine_grasps(pair: HandPair, clip: Clip, settings: GraspSettings = GraspSettings()) -> Clip:
    """Snap a resting object to its first height (``resting``), then refine the hands (``refined_tracks``)."""
    clip = snap_to_rest(clip, settings.rest)
    return replace(clip, hands=refined_tracks(pair, clip, settings))


@one_thread()
def carried_fraction(pair: HandPair, clip: Clip, settings: GraspSettings = GraspSettings()) -> float:
    """Fraction of some frames with the object in the air in which the hands can carry it; 1 without such frames."""
    return _Load.of(clip, settings.air_frames).carried_fraction(pair, clip.hands)


@one_thread()
def refined_tracks(pair: HandPair, clip: Clip, settings: GraspSettings = GraspSettings()) -> dict[Side, HandTrack]:
    """Refine the hands of a clip; hands without a grasp and invalid frames are unchanged.

    An object without known gravity or without an inside counts as carried.
    """
    load, best, most = _Load.of(clip, settings.air_frames), dict(clip.hands), -1.0
    parts: dict[Side, int] = {}  # what each hand holds at first: to the next try it may seem to hold the other one
    for number, (reach, keypoint) in enumerate(zip(settings.reach_m, settings.keypoint_m, strict=True)):
        # Once drawn out is enough.
        starts = _starts(pair, clip, settings if not number else replace(settings, carry=0), parts)
        if not starts:
            break
        for side, start in starts.items():
            parts.setdefault(side, start.part)
        tracks = _solved(pair, clip, starts, settings.solver, Attraction(reach, keypoint))
        share = load.carried_fraction(pair, tracks)
        # A try that carries no more than the best so far is no answer, but the next one goes on from it.
        if share > most:
            best, most = tracks, share
        clip = replace(clip, hands=tracks)
        if share == 1:
            break
    if 0 <= most < 1 and settings.regrasp.tries:
        return _regrasped(pair, replace(clip, hands=best), load, settings, parts)
    return best


def _regrasped(
    pair: HandPair, clip: Clip, load: "_Load", settings: GraspSettings, parts: Mapping[Side, int]
) -> dict[Side, HandTrack]:
    """The hands of a clip, with another grasp in every hold that cannot carry and where one that can is found.

    parts: what each hand holds, by number.
    """
    tracks = dict(clip.hands)
    for side in SIDES:
        if (grip := _grip(pair, side, clip, settings, parts.get(side))) is None:
            continue
        opposite = _OPPOSITE[side]
        other = capsules_or_nan(tracks[opposite], pair[opposite]) if tracks[opposite].valid.any() else None
        tracks[side] = grip.regrasped(pair[side], load, other, settings)
    return tracks


def _starts(pair: HandPair, clip: Clip, settings: GraspSettings, parts: Mapping[Side, int]) -> dict[Side, "_Start"]:
    """The hands that hold something; of ``parts`` that one, where a hand has one there."""
    grips: dict[Side, _Grip] = {}
    for side in SIDES:
        if (grip := _grip(pair, side, clip, settings, parts.get(side))) is not None:
            grips[side] = grip
    free = ~np.any([grip.held for grip in grips.values()], axis=0) if grips else np.zeros(0, bool)
    return {
        side: grip.carrying(free, settings.carry).start(clip.object, settings.blend) for side, grip in grips.items()
    }


def _solved(
    pair: HandPair, clip: Clip, starts: Mapping[Side, "_Start"], wishes: SolverSettings, draw: Attraction
) -> dict[Side, HandTrack]:
    """All hands of a clip, those that hold something corrected one after the other."""
    tracks = dict(clip.hands)
    for side, start in starts.items():
        opposite = _OPPOSITE[side]
        other = capsules_or_nan(tracks[opposite], pair[opposite]) if tracks[opposite].valid.any() else None
        tracks[side] = start.solved(other, wishes, draw)
    return tracks


@dataclass(frozen=True)
class _Load:
    """An object in the air, and some frames in which hands have to carry it; no frames where it never is."""

    clip: Clip
    scene: Scene | None
    frames: np.ndarray
    field: ObjectField

    @classmethod
    def of(cls, clip: Clip, count: int) -> "_Load":
        field = ObjectField(clip.object)
        if clip.gravity is None or clip.n_frames < 3 or not surface_index(clip.object.model).is_solid:
            return cls(clip, None, np.zeros(0, int), field)
        scene = object_scene(clip)
        air = np.flatnonzero(scene.lifted)
        some = ((np.arange(count) + 0.5) * len(air) / count).astype(int)
        return cls(clip, scene, air[some] if len(air) else air, field)

    def within(self, hold: Interval) -> "_Load":
        """Those frames of it that lie in a hold."""
        return replace(self, frames=self.frames[(self.frames >= hold.start) & (self.frames < hold.stop)])

    def carried_by(self, track: HandTrack, hand: HandModel, other: Capsules | None) -> bool:
        """Whether a hand, with the capsules of the other where there is one, carries in all of the frames."""
        if not len(self.frames):
            return True
        hands = [capsules_or_nan(track.take(self.frames), hand)]
        return self.carried([*hands, *([] if other is None else [other.taken(self.frames)])]) == 1

    def carried_fraction(self, pair: HandPair, tracks: Mapping[Side, HandTrack]) -> float:
        """As ``carried``, by the hands that are there at all."""
        there: list[Side] = [side for side in SIDES if tracks[side].valid.any()]
        if not len(self.frames) or not there:
            return float(not len(self.frames))
        return self.carried([capsules_or_nan(tracks[side].take(self.frames), pair[side]) for side in there])

    def carried(self, hands: Sequence[Capsules]) -> float:
        """Share of the frames in which friction at the contacts can give the object's motion; hands in those frames."""
        if self.scene is None or not len(self.frames):
            return 1.0
        contacts, physics = self._contacts(joined(list(hands))), StandardUnits()
        return float((physics.residuals(self.scene, contacts)[self.frames] < physics.limit).mean())

    def _contacts(self, capsules: Capsules) -> CapsuleContacts:
        """Where capsules, in the frames looked at, touch the object: at the deepest of some places along each axis.

        Read from the distance grid, as all of the hold is: ``hoidata.physics.capsules.capsule_contacts`` is exact
        and far slower.
        """
        there = np.isfinite(capsules.start_m[..., 0])
        capsules = Capsules(np.nan_to_num(capsules.start_m), np.nan_to_num(capsules.end_m), capsules.radius_m)
        along = np.linspace(0, 1, _ALONG)[:, None]
        axis = (capsules.end_m - capsules.start_m)[:, :, None]
        places = (capsules.start_m[:, :, None] + along * axis).reshape(len(self.frames), -1, 3)
        found = self.field.distances(places, self.frames)
        shape = (*capsules.start_m.shape[:2], _ALONG)
        distance, slope, place = (array.reshape(*shape, -1) for array in (*found, places))
        deepest = distance.argmin(axis=2, keepdims=True)
        distance, slope, place = (np.take_along_axis(a, deepest, 2)[:, :, 0] for a in (distance, slope, place))
        # Slopes of what is interpolated are shorter than one at edges, and nothing in the middle of a thin thing.
        length = np.linalg.norm(slope, axis=-1)
        slope /= np.maximum(length, _LEAST_SLOPE)[..., None]
        frame, capsule = np.nonzero(there & (distance[..., 0] < capsules.radius_m) & (length > _LEAST_SLOPE))
        depth, normal = (capsules.radius_m - distance[..., 0])[frame, capsule], slope[frame, capsule]
        point = (place - distance * slope)[frame, capsule]
        number = self.frames[frame]
        return CapsuleContacts(number, capsule, np.zeros_like(number), depth, point, normal, point, normal)


@dataclass(frozen=True)
class _Start:
    """One hand in the frame of the part it holds, at rest in its holds. part: its number. passed: (frame,) bool, holds
    in which the other one moves past the hand; None: there are none.
    """

    track: HandTrack
    skin: SkinnedHand
    pose: HandPose
    holds: list[Interval]
    part_from_world: RigidTransform
    field: ObjectField
    part: int
    passed: np.ndarray | None

    def solved(self, other: Capsules | None, settings: SolverSettings, draw: Attraction) -> HandTrack:
        """The corrected hand; frames without it stay as they were. other: capsules of the other, world frame."""
        other = None if other is None else other.relative_to(self.part_from_world)
        valid, held = self.track.valid, (self.part, self.passed)
        hand = HandMotion(self.skin, self.field, self.pose, self.holds, valid, other, settings, draw, *held)
        pose = hand.corrected()
        track = self.track
        made = pose.relative_to(self.part_from_world.inverse()).track(track.mean_betas, track.valid, track.template_m)
        kept = {name: getattr(track, name) for name in ("wrist_m", "global_orient", "hand_pose")}
        return replace(
            track, **{name: np.where(valid[:, None], getattr(made, name), own) for name, own in kept.items()}
        )


@dataclass(frozen=True)
class _Grip:
    """Where one hand holds a part. part: its number. pose: of the hand, world. moving: (frame - 1,) whether the part
    moves under it to the next frame.
    """

    track: HandTrack
    skin: SkinnedHand
    part: int
    pose: HandPose
    holds: list[Interval]
    moving: np.ndarray
    object_from_part: RigidTransform
    world_from_part: RigidTransform

    @property
    def held(self) -> np.ndarray:
        """(frame,) bool."""
        held = np.zeros(len(self.track.valid), bool)
        for start, stop in self.holds:
            held[start:stop] = True
        return held

    def carrying(self, free: np.ndarray, most: int) -> "_Grip":
        """With holds drawn out over up to ``most`` frames before and after in which the part moves.

        free: (frame,) bool, no hand holds it. What moves in nobody's hand would slip through the one that comes.
        """
        free = free & self.track.valid
        before, after = free & np.append(self.moving, False), free & np.append(False, self.moving)
        holds = []
        for number, (start, stop) in enumerate(self.holds):
            # A third of the frames between two holds at most: the hand has to go from one to the other.
            early = min(most, (start - self.holds[number - 1].stop) // 3) if number else most
            late = min(most, (self.holds[number + 1].start - stop) // 3) if number + 1 < len(self.holds) else most
            holds.append(Interval(start - _leading(before[:start][::-1], early), stop + _leading(after[stop:], late)))
        return replace(self, holds=holds)

    def regrasped(self, hand: HandModel, load: _Load, other: Capsules | None, settings: GraspSettings) -> HandTrack:
        """The hand with another grasp in each hold that cannot carry and where one is found that can.

        other: capsules of the other hand, world.
        """
        thing, own = load.clip.object, settings.regrasp
        allowed = np.maximum((own.bent_rad, own.way_deep_m, own.step_m), self._extremes(thing, self.track))
        made, grasps, loads = self.track, dict[int, HandPose](), [load.within(hold) for hold in self.holds]
        carrying = {number for number, there in enumerate(loads) if there.carried_by(made, hand, other)}
        for number in sorted(set(range(len(loads))) - carrying):
            for grasp in self._other_grasps(hand, self.holds[number], loads[number], other, settings):
                tried = {**grasps, number: grasp}
                start = self.start(thing, own.blend, tried)
                # Every frame is looked at: a hand that closes on its way to an edge is quickly in it.
                track = start.solved(other, replace(settings.solver, every=1), own.holding)
                wanted = carrying | {number}
                if (self._extremes(thing, track) > allowed).any():
                    continue
                if all(loads[hold].carried_by(track, hand, other) for hold in wanted):
                    made, grasps, carrying = track, tried, wanted
                    break
        return made

    def _extremes(self, thing: ObjectTrack, track: HandTrack) -> np.ndarray:
        """(3,) of a hand while it is there: most bent finger joint, rad; depth in the object and way of a frame, m."""
        pose = HandPose.of(track)
        there = np.flatnonzero(track.valid)
        depth_m = -ObjectField(thing).distances(self.skin.vertices_m(self.skin.chain(pose)))[0]
        ways_m = np.linalg.norm(np.diff(pose.wrist_m, axis=0), axis=1)[track.valid[1:] & track.valid[:-1]]
        return np.array([bends_rad(pose)[there].max(), depth_m[there].max(), ways_m.max(initial=0)])

    def _other_grasps(
        self, hand: HandModel, hold: Interval, load: _Load, other: Capsules | None, settings: GraspSettings
    ) -> Iterator[HandPose]:
        """Some for a hold that carry where the hand's own does not, one frame each in the part's frame.

        load: in frames of the hold.
        """
        scene, every = load.scene, np.arange(hold.start, hold.stop)
        if scene is None:
            return iter(())
        floor_m = min(scene.table_height_m, scene.lowest_of_m(capsules_or_nan(self.track.take(every), hand)))

        def carries(pose: HandPose) -> bool:
            track = self._everywhere(pose)
            lowest_m = scene.lowest_of_m(capsules_or_nan(track.take(every), hand))
            return lowest_m > floor_m - _UNDER_M and load.carried_by(track, hand, other)

        held = self._held(hand, load, other, _passed(load.clip.object, [hold]) is not None)
        found = search_grasps(held, carries, settings.solver, settings.regrasp)
        return islice(found, settings.regrasp.answers)

    def _everywhere(self, pose: HandPose) -> HandTrack:
        """The hand in one pose, one frame in the part's frame, all the time."""
        moved = pose.taken(np.zeros(len(self.track.valid), int)).relative_to(self.world_from_part)
        return moved.track(self.track.mean_betas, self.track.valid, self.track.template_m)

    def _held(self, hand: HandModel, load: _Load, other: Capsules | None, passed: bool) -> Held:
        """The hand in the middle one of frames in which it has to carry."""
        assert load.scene is not None
        middle = load.frames[[len(load.frames) // 2]]
        part_from_world = self.world_from_part.inverse()[middle]
        some = np.arange(0, N_VERTICES, _SOME_SKIN)
        return Held(
            SkinnedHand(hand, np.asarray(self.track.betas, np.float64)[0], self.track.template_m, some),
            ObjectField(_in_part(load.clip.object, self.object_from_part)),
            self.part,
            passed,
            self.pose.taken(middle).relative_to(part_from_world),
            int(middle[0]),
            (part_from_world @ load.scene.motion.centre_m[middle][:, None])[0, 0],
            None if other is None else other.taken(middle).relative_to(part_from_world),
        )

    def start(self, thing: ObjectTrack, blend: int, grasps: Mapping[int, HandPose] = MappingProxyType({})) -> _Start:
        """The hand in the part's frame, at rest in its holds: in the ones numbered in ``grasps`` in that pose."""
        part_from_world = self.world_from_part.inverse()
        pose = _at_rest(self.pose.relative_to(part_from_world), self.holds, blend, grasps)
        field = ObjectField(_in_part(thing, self.object_from_part))
        passed = _passed(thing, self.holds)
        return _Start(self.track, self.skin, pose, self.holds, part_from_world, field, self.part, passed)


def _passed(thing: ObjectTrack, holds: Sequence[Interval]) -> np.ndarray | None:
    """(frame,) bool: holds in which one part of an object moves past the other; None where there are none."""
    hinge_rad, passed = thing.hinge_rad, np.zeros(thing.n_frames, bool)
    for start, stop in holds:
        passed[start:stop] = hinge_rad is not None and np.ptp(hinge_rad[start:stop]) > _PASSING_RAD
    return passed if passed.any() else None


def _leading(wanted: np.ndarray, most: int) -> int:
    """How many of the first ``most`` are True before one is not."""
    return int(np.append(wanted[:most], False).argmin())


def _grip(pair: HandPair, side: Side, clip: Clip, settings: GraspSettings, part: int | None = None) -> _Grip | None:
    """None for a hand that holds nothing. part: the one it is to hold, else the one it touches most."""
    track, thing = clip.hands[side], clip.object
    if not track.valid.any():
        return None
    skin = SkinnedHand(pair[side], np.asarray(track.betas, np.float64)[0], track.template_m)
    world = HandPose.of(track)
    points_m = skin.vertices_m(skin.chain(world))
    field = ObjectField(thing)
    touching: np.ndarray = (field.distances(points_m)[0] < settings.near_m) & track.valid[:, None]
    part, touching = field.part_touched(points_m, touching, part)
    moved, touched = world_from_part(thing, part), np.any(touching, axis=1)
    holds, moving = _holds(points_m, touched, moved, track.valid, settings)
    object_from_part = thing.model.object_from_part(part, thing.hinge_rad)
    return _Grip(track, skin, part, world, holds, moving, object_from_part, moved) if holds else None


def _in_part(thing: ObjectTrack, object_from_part: RigidTransform) -> ObjectTrack:
    """The object's motion as the part sees it."""
    back = object_from_part.inverse()
    rotation, place = (
        np.broadcast_to(array, (thing.n_frames, *array.shape[back.rotation.ndim - 2 :]))
        for array in (back.rotation, back.translation)
    )
    return replace(thing, rotvec=rotmat_to_rotvec(rotation), translation_m=place)


def _holds(
    points_m: np.ndarray,
    touching: np.ndarray,
    world_from_part: RigidTransform,
    valid: np.ndarray,
    own: GraspSettings,
) -> tuple[list[Interval], np.ndarray]:
    """Intervals in which a hand, vertices (frame, vertex, 3) world, touches (frame,) a part and hardly moves on it; and
    (frame - 1,) whether the part moves under it.
    """
    some = world_from_part.inverse() @ points_m[:, ::20]
    speed = np.linalg.norm(np.diff(some, axis=0), axis=-1).mean(axis=1) * FPS
    carried = world_from_part[1:] @ some[:-1] - world_from_part[:-1] @ some[:-1]
    moving = np.linalg.norm(carried, axis=-1).mean(axis=1) * FPS > own.moving_m_s
    slow = speed < np.where(moving, own.carried_m_s, own.still_m_s)
    held = touching & (np.append(slow, False) | np.append(False, slow))
    for start, stop in runs(~held):
        short = start > 0 and stop < len(held) and stop - start <= own.gap and valid[start:stop].all()
        if short and np.linalg.norm(some[stop] - some[start - 1], axis=-1).mean() < own.same_m:
            held[start:stop] = True
    return [found for found in runs(held) if found.stop - found.start >= own.least], moving


def _at_rest(pose: HandPose, holds: Sequence[Interval], blend: int, grasps: Mapping[int, HandPose]) -> HandPose:
    """One pose in all frames of each hold, its mean or that of ``grasps``; the way to it is shared out over frames
    before and after.
    """
    step, n_frames = np.zeros((len(pose.wrist_m), N_UNKNOWNS)), len(pose.wrist_m)
    for number, (start, stop) in enumerate(holds):
        own = pose.taken(np.arange(start, stop))
        everywhere = np.zeros(stop - start, int)
        rest = grasps[number].taken(everywhere) if number in grasps else _mean(own).taken(everywhere)
        step[start:stop] = ways = own.step_to(rest)
        # Two holds share the frames between them.
        before = min(blend, (start - holds[number - 1].stop) // 2 if number else start)
        after = min(blend, (holds[number + 1].start - stop) // 2 if number + 1 < len(holds) else n_frames - stop)
        step[start - before : start] = _ramp(before)[:, None] * ways[0]
        step[stop : stop + after] = _ramp(after)[::-1, None] * ways[-1]
    return pose.moved(step)


def _mean(pose: HandPose) -> HandPose:
    """One frame."""
    mean = pose.taken(np.array([len(pose.wrist_m) // 2]))
    for _ in range(2):
        everywhere = mean.taken(np.zeros(len(pose.wrist_m), int))
        mean = mean.moved(everywhere.step_to(pose).mean(axis=0)[None])
    return mean


def _ramp(count: int) -> np.ndarray:
    """(count,) from near 0 to near 1, level at both ends."""
    u = np.arange(1, count + 1) / (count + 1)
    return u * u * (3 - 2 * u)
