"""The recorded clip with one thing spoilt, as families: a figure that is as good as the truth's does not see that."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip, HandTrack, Side
from hoidata.objects.model import articulate
from hoidata.store.annotated import AnnotatedStore
from models.baselines.families import GroundTruth
from models.baselines.lookups import Lookup, lookup_clips, of_the_hand
from models.common.family import EachAlone, Family, LeftOut

OBJECT_MOVED_M = 0.10
# From a joint to a sampled point: 2 cm of air, and the finger around the joint.
HANDS_AWAY_M = 0.03
PRESSED_M = 0.01
PRESSED_DEEP_M = SHIFTED_M = 0.03
# Of a wrist along each axis and of every angle: together 5 mm at a joint.
NOISE_WRIST_M, NOISE_RAD = 0.0018, 0.025
FRAMES_LOOKED_AT = 8
NEVER_TOUCHES = "its hands never touch the object in the frames asked for"
WAYS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], np.float64)
WAYS /= np.linalg.norm(WAYS, axis=1, keepdims=True)


@dataclass(frozen=True)
class SpoiltTruth:
    """The recorded clip after ``spoil``, which says in words where it cannot be. drawn: each motion is another."""

    truth: GroundTruth
    spoil: Callable[[Clip, "Recording"], Clip | str]
    drawn: bool

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        made = dict[str, Clip | str]()
        for request in requests:
            key = self._key(request)
            if key not in made:
                made[key] = self.spoil(self.truth.recorded(request), Recording(self.truth.annotated, request))
        return [_answer(request, made[self._key(request)]) for request in requests]

    def sample_asked(self, requests: Sequence[Request]) -> tuple[list[Clip | LeftOut], list[np.ndarray]]:
        return self.sample(requests), self.truth.contact_maps(requests)

    def _key(self, request: Request) -> str:
        return request.motion_id if self.drawn else request.clip_id


@dataclass(frozen=True)
class Recording:
    """What is known of the clip whose place a motion takes."""

    annotated: AnnotatedStore
    request: Request

    @property
    def sides(self) -> list[Side]:
        """The hands that are asked for; others are left alone."""
        return [side for side, active in zip(SIDES, self.request.active_hands, strict=True) if active]

    @property
    def draws(self) -> np.random.Generator:
        return np.random.default_rng(self.request.seed)

    def touching_frames(self, side: Side) -> np.ndarray:
        """(frame,) in which a joint of the hand touches, of those asked for."""
        frames = np.unique(self.annotated.distances(self.request.clip_id, side).frame)
        return frames[frames < self.request.n_frames]

    def joints_in_object(self, clip: Clip, side: Side, frames: np.ndarray) -> np.ndarray:
        """(chosen frame, 21, 3) joints in the object frame, metres."""
        joints_m = self.annotated.joints(self.request.clip_id, side)[frames]
        return clip.object.take(frames).world_from_object.inverse() @ joints_m


def _answer(request: Request, made: Clip | str) -> Clip | LeftOut:
    motion_id = request.motion_id
    return LeftOut(motion_id, made) if isinstance(made, str) else replace(made, clip_id=motion_id)


def static(clip: Clip, known: Recording) -> Clip | str:
    """Every frame is that of the first contact."""
    touching = np.concatenate([known.touching_frames(side) for side in known.sides])
    return _frames(clip, np.full(clip.n_frames, touching.min())) if len(touching) else NEVER_TOUCHES


def backwards(clip: Clip, known: Recording) -> Clip:
    """The last frame first."""
    return _frames(clip, np.arange(clip.n_frames)[::-1])


def object_moved(clip: Clip, known: Recording) -> Clip:
    """The object 10 cm to one side, another for each motion; the hands as recorded, to the bit."""
    angle = known.draws.uniform(0, 2 * np.pi)
    sideways = known.request.world_from_model[:3, :2] @ [np.cos(angle), np.sin(angle)]
    moved = clip.object.translation_m + OBJECT_MOVED_M * sideways
    return replace(clip, object=replace(clip.object, translation_m=moved.astype(np.float32)))


def hands_away(clip: Clip, known: Recording) -> Clip | str:
    """Each hand held off the surface by 2 cm: moved with the object, as far as that takes in all frames it touches."""
    return _with_hands(clip, {side: _held_off(clip, known, side) for side in known.sides})


def pressed(clip: Clip, known: Recording, by_m: float = PRESSED_M) -> Clip | str:
    """Each hand moved 1 cm into the object, against the surface at the point a joint comes nearest to."""
    return _with_hands(clip, {side: _pressed_in(clip, known, side, by_m) for side in known.sides})


def pressed_deep(clip: Clip, known: Recording) -> Clip | str:
    """The same, 3 cm."""
    return pressed(clip, known, PRESSED_DEEP_M)


def hands_still(clip: Clip, known: Recording) -> Clip | str:
    """Each hand as it is at its first contact; the object moves as recorded."""
    tracks: dict[Side, HandTrack | None] = {}
    for side in known.sides:
        touching, track = known.touching_frames(side), clip.hands[side]
        frames = np.full(clip.n_frames, touching[0]) if len(touching) else None
        tracks[side] = None if frames is None else track.take(_seen(track.valid, frames))
    return _with_hands(clip, tracks)


def hands_shifted(clip: Clip, known: Recording) -> Clip:
    """Each hand 3 cm along an axis of the object or against it, another for each motion: the whole recording long."""
    ways = np.concatenate((np.eye(3), -np.eye(3)))
    by_m = clip.object.world_from_object.rotation @ (SHIFTED_M * known.draws.choice(ways))
    return replace(clip, hands={**clip.hands, **{side: _shifted(clip.hands[side], by_m) for side in known.sides}})


def noisy(clip: Clip, known: Recording) -> Clip:
    """Noise on the wrist and every angle of each hand in every frame, about 5 mm at a joint."""
    draws = known.draws

    def shaken(track: HandTrack) -> HandTrack:
        def noise(values: np.ndarray, spread: float) -> np.ndarray:
            return (values + draws.normal(0, spread, values.shape)).astype(np.float32)

        return replace(
            track,
            wrist_m=noise(track.wrist_m, NOISE_WRIST_M),
            global_orient=noise(track.global_orient, NOISE_RAD),
            hand_pose=noise(track.hand_pose, NOISE_RAD),
        )

    return replace(clip, hands={**clip.hands, **{side: shaken(clip.hands[side]) for side in known.sides}})


@dataclass(frozen=True)
class OtherHands(EachAlone):
    """The object as recorded, with the hands of a training clip."""

    truth: GroundTruth
    lookup: Lookup

    def motion(self, request: Request) -> Clip | LeftOut:
        found = self.lookup.motion(request)
        return found if isinstance(found, LeftOut) else replace(found, object=self.truth.recorded(request).object)


def _frames(clip: Clip, rows: np.ndarray) -> Clip:
    """Other frames of the clip in the place of its own; a hand is taken from the nearest frame in which it is seen."""
    hands = {side: track.take(_seen(track.valid, rows)) for side, track in clip.hands.items()}
    return replace(clip, hands=hands, object=clip.object.take(rows))


def _seen(valid: np.ndarray, rows: np.ndarray) -> np.ndarray:
    there = np.flatnonzero(valid)
    return there[abs(rows[:, None] - there).argmin(axis=1)] if len(there) else rows


def _with_hands(clip: Clip, tracks: dict[Side, HandTrack | None]) -> Clip | str:
    """The clip with the tracks that are given; why not, where there is none."""
    moved = {side: track for side, track in tracks.items() if track is not None}
    return replace(clip, hands={**clip.hands, **moved}) if moved else NEVER_TOUCHES


def _held_off(clip: Clip, known: Recording, side: Side) -> HandTrack | None:
    touching = known.touching_frames(side)
    if not len(touching):
        return None
    frames = touching[np.linspace(0, len(touching) - 1, min(FRAMES_LOOKED_AT, len(touching))).astype(int)]
    points, thing = known.request.points, clip.object.take(frames)
    placed = articulate(points.points_m.astype(np.float64), points.part, thing.model.hinge, thing.hinge_rad)
    apart = known.joints_in_object(clip, side, frames)[:, :, None] - placed[:, None]
    shift = _shortest_way_out(apart.reshape(-1, 3), HANDS_AWAY_M)
    return _shifted(clip.hands[side], clip.object.world_from_object.rotation @ shift)


def _shortest_way_out(apart: np.ndarray, clear_m: float) -> np.ndarray:
    """(3,) the shortest of the moves along 26 ways after which all of ``apart (n, 3)`` are ``clear_m`` long or longer.

    v + d u is as long as that at the roots of d^2 + 2 d (v.u) + v.v = clear^2, and longer beyond the larger one.
    """
    along = apart @ WAYS.T
    inside = along**2 + clear_m**2 - (apart**2).sum(axis=1)[:, None]
    far = np.where(inside > 0, np.sqrt(np.maximum(inside, 0)) - along, 0.0).max(axis=0)
    return far.min() * WAYS[far.argmin()]


def _pressed_in(clip: Clip, known: Recording, side: Side, by_m: float) -> HandTrack | None:
    entries = known.annotated.distances(known.request.clip_id, side).window(0, clip.n_frames)
    if not len(entries.frame):
        return None
    points, nearest = known.request.points, entries.point[entries.distance_m.argmin()]
    ends = points.points_m[nearest] + np.outer((0.0, 1.0), points.normals[nearest])
    placed = clip.object.points_in_world(ends.astype(np.float64), np.repeat(points.part[nearest], 2))
    return _shifted(clip.hands[side], -by_m * (placed[:, 1] - placed[:, 0]))


def _shifted(track: HandTrack, by_m: np.ndarray) -> HandTrack:
    """The hand moved by (frame, 3) metres of the world."""
    return replace(track, wrist_m=(track.wrist_m + by_m).astype(np.float32))


def _spoilt(name: str, title: str, spoil: Callable[[Clip, Recording], Clip | str], drawn: bool = False) -> Family:
    return Family(name, title, lambda sources: SpoiltTruth(GroundTruth(sources.annotated), spoil, drawn))


STATIC = _spoilt("static", "truth held at its first contact", static)
REVERSED = _spoilt("reversed", "truth backwards", backwards)
OBJECT_MOVED = _spoilt("object-moved", "truth, object 10 cm away", object_moved, drawn=True)
HANDS_AWAY = _spoilt("hands-away", "truth, hands 2 cm off", hands_away)
PRESSED = _spoilt("pressed", "truth, hands 1 cm in", pressed)
PRESSED_DEEP = _spoilt("pressed-deep", "truth, hands 3 cm in", pressed_deep)
HANDS_STILL = _spoilt("hands-still", "truth, hands held still", hands_still)
HANDS_SHIFTED = _spoilt("hands-shifted", "truth, hands 3 cm to one side", hands_shifted, drawn=True)
NOISE = _spoilt("noise", "truth with 5 mm of noise", noisy, drawn=True)
OTHER_HANDS = Family(
    "other-hands",
    "truth, hands of another clip",
    lambda sources: OtherHands(
        GroundTruth(sources.annotated), Lookup(lookup_clips(sources), of_the_hand, "of this hand")
    ),
)
