"""Negative controls: recorded clips with one property perturbed.

A metric that is as good on a control as on the recorded clips is blind to the perturbed property.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.distance import cdist

from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip, HandTrack, Side
from hoidata.objects.model import articulate
from hoidata.store.annotated import AnnotatedStore
from models.baselines.families import GroundTruth
from models.baselines.retrieval import Retrieval, of_the_hand, retrieval_clips
from models.common.family import Family, SingleRequestSampler, Skipped, Sources

OBJECT_MOVED_M = 0.10
# From a joint to a sampled point: 2 cm of air plus the radius of a finger.
HANDS_AWAY_M = 0.03
PRESSED_M = 0.01
PRESSED_DEEP_M = SHIFTED_M = 0.03
# Standard deviation of the wrist along each axis and of every angle: together 5 mm at a joint.
NOISE_WRIST_M, NOISE_RAD = 0.0018, 0.025
FIRST_FRAMES_MEASURED, ROUNDING_M = 8, 1e-9
NEVER_TOUCHES = "its hands never touch the object in the frames asked for"
DIRECTIONS = np.array(
    [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], np.float64
)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


@dataclass(frozen=True)
class PerturbedRecording:
    """Samples the recorded clip after ``perturb``."""

    truth: GroundTruth
    perturb: Callable[[Clip, "Recording"], Clip | str]  # returns the reason if a clip cannot be perturbed
    differs_per_motion: bool  # the perturbation is random, with the seed of the motion

    def sample(self, requests: Sequence[Request]) -> list[Clip | Skipped]:
        perturbed = dict[str, Clip | str]()
        for request in requests:
            key = self._key(request)
            if key not in perturbed:
                perturbed[key] = self.perturb(self.truth.recorded(request), Recording(self.truth.annotated, request))
        answers = [(request.motion_id, perturbed[self._key(request)]) for request in requests]
        return [Skipped(name, one) if isinstance(one, str) else replace(one, clip_id=name) for name, one in answers]

    def sample_with_targets(self, requests: Sequence[Request]) -> tuple[list[Clip | Skipped], list[np.ndarray]]:
        return self.sample(requests), self.truth.contact_maps(requests)

    def _key(self, request: Request) -> str:
        return request.motion_id if self.differs_per_motion else request.clip_id


@dataclass(frozen=True)
class Recording:
    """The recorded clip of a request: contact, joints and random numbers for its perturbation."""

    annotated: AnnotatedStore
    request: Request

    @property
    def sides(self) -> list[Side]:
        """The requested hands; the others are not perturbed."""
        return [side for side, active in zip(SIDES, self.request.active_hands, strict=True) if active]

    @property
    def draws(self) -> np.random.Generator:
        return np.random.default_rng(self.request.seed)

    def touching_frames(self, side: Side) -> np.ndarray:
        """(frame,) requested frames in which a joint of the hand touches the object."""
        frames = np.unique(self.annotated.distances(self.request.clip_id, side).frame)
        return frames[frames < self.request.n_frames]


def static(clip: Clip, recording: Recording) -> Clip | str:
    """Repeat the frame of the first contact."""
    touching = np.concatenate([recording.touching_frames(side) for side in recording.sides])
    return _frames(clip, np.full(clip.n_frames, touching.min())) if len(touching) else NEVER_TOUCHES


def backwards(clip: Clip, recording: Recording) -> Clip:
    """Reverse the order of the frames."""
    return _frames(clip, np.arange(clip.n_frames)[::-1])


def object_moved(clip: Clip, recording: Recording) -> Clip:
    """Shift the object by 10 cm in a random horizontal direction; the hands keep their exact values."""
    angle = recording.draws.uniform(0, 2 * np.pi)
    sideways = recording.request.world_from_model[:3, :2] @ [np.cos(angle), np.sin(angle)]
    moved = clip.object.translation_m + OBJECT_MOVED_M * sideways
    return replace(clip, object=replace(clip.object, translation_m=moved.astype(np.float32)))


def hands_away(clip: Clip, recording: Recording) -> Clip | str:
    """Keep each hand 2 cm off the surface: one shift in the object frame, for all frames."""
    return _with_hands(clip, {side: _moved_off(clip, recording, side) for side in recording.sides})


def pressed(clip: Clip, recording: Recording, by_m: float = PRESSED_M) -> Clip | str:
    """Move each hand into the object, against the normal at the point closest to a joint."""
    return _with_hands(clip, {side: _pressed_in(clip, recording, side, by_m) for side in recording.sides})


def hands_still(clip: Clip, recording: Recording) -> Clip | str:
    """Freeze each hand at its first contact; the object moves as recorded."""
    tracks: dict[Side, HandTrack | None] = {}
    for side in recording.sides:
        touching, track = recording.touching_frames(side), clip.hands[side]
        frames = np.full(clip.n_frames, touching[0]) if len(touching) else None
        tracks[side] = None if frames is None else track.take(_nearest_valid(track.valid, frames))
    return _with_hands(clip, tracks)


def hands_shifted(clip: Clip, recording: Recording) -> Clip:
    """Shift each hand by 3 cm along a random positive or negative object axis, constant over the clip."""
    axes = np.concatenate((np.eye(3), -np.eye(3)))
    by_m = clip.object.world_from_object.rotation @ (SHIFTED_M * recording.draws.choice(axes))
    return replace(clip, hands={**clip.hands, **{side: _shifted(clip.hands[side], by_m) for side in recording.sides}})


def noisy(clip: Clip, recording: Recording) -> Clip:
    """Add noise to the wrist and every angle of each hand in every frame, about 5 mm at a joint."""
    draws = recording.draws

    def shaken(track: HandTrack) -> HandTrack:
        def noise(values: np.ndarray, spread: float) -> np.ndarray:
            return (values + draws.normal(0, spread, values.shape)).astype(np.float32)

        return replace(
            track,
            wrist_m=noise(track.wrist_m, NOISE_WRIST_M),
            global_orient=noise(track.global_orient, NOISE_RAD),
            hand_pose=noise(track.hand_pose, NOISE_RAD),
        )

    return replace(clip, hands={**clip.hands, **{side: shaken(clip.hands[side]) for side in recording.sides}})


@dataclass(frozen=True)
class OtherHands(SingleRequestSampler):
    """Combines the recorded object motion with the hands of a retrieved training clip."""

    truth: GroundTruth
    retrieval: Retrieval

    def motion(self, request: Request) -> Clip | Skipped:
        retrieved = self.retrieval.motion(request)
        if isinstance(retrieved, Skipped):
            return retrieved
        return replace(retrieved, object=self.truth.recorded(request).object)


def _frames(clip: Clip, frames: np.ndarray) -> Clip:
    """The clip with frames reordered; a hand is taken from the nearest frame in which it is valid."""
    hands = {side: track.take(_nearest_valid(track.valid, frames)) for side, track in clip.hands.items()}
    return replace(clip, hands=hands, object=clip.object.take(frames))


def _nearest_valid(valid: np.ndarray, frames: np.ndarray) -> np.ndarray:
    valid_frames = np.flatnonzero(valid)
    return valid_frames[abs(frames[:, None] - valid_frames).argmin(axis=1)] if len(valid_frames) else frames


def _with_hands(clip: Clip, tracks: dict[Side, HandTrack | None]) -> Clip | str:
    """The clip with the tracks that are not None replaced; the reason if there is none."""
    moved = {side: track for side, track in tracks.items() if track is not None}
    return replace(clip, hands={**clip.hands, **moved}) if moved else NEVER_TOUCHES


def _moved_off(clip: Clip, recording: Recording, side: Side) -> HandTrack | None:
    """The hand moved by one shift in the object's frame, after which it is ``HANDS_AWAY_M`` away in all frames."""
    if not len(recording.touching_frames(side)):
        return None
    valid = np.flatnonzero(clip.hands[side].valid)
    points, track = recording.request.points, clip.object.take(valid)
    points_m = articulate(points.points_m.astype(np.float64), points.part, track.model.hinge, track.hinge_rad)
    points_m = np.broadcast_to(points_m, (len(valid), *points_m.shape[1:]))
    joints_m = track.world_from_object.inverse() @ recording.annotated.joints(recording.request.clip_id, side)[valid]
    frames = np.linspace(0, len(valid) - 1, min(FIRST_FRAMES_MEASURED, len(valid))).astype(int)
    while True:
        joints_from_points = joints_m[frames][:, :, None] - points_m[frames][:, None]
        shift = _shortest_clearing_move(joints_from_points.reshape(-1, 3), HANDS_AWAY_M)
        nearest_m = [cdist(joints + shift, points).min() for joints, points in zip(joints_m, points_m, strict=True)]
        if min(nearest_m) >= HANDS_AWAY_M - ROUNDING_M:
            return _shifted(clip.hands[side], clip.object.world_from_object.rotation @ shift)
        frames = np.append(frames, np.argmin(nearest_m))  # the shift has to clear this frame too


def _shortest_clearing_move(offsets: np.ndarray, clear_m: float) -> np.ndarray:
    """(3,) the shortest shift along one of 26 directions after which all ``offsets`` (n, 3) have length >= ``clear_m``.

    |v + d u| = clear at the roots of d^2 + 2 d (v.u) + v.v = clear^2, and |v + d u| grows beyond the larger root.
    """
    along_direction = offsets @ DIRECTIONS.T
    inside = along_direction**2 + clear_m**2 - (offsets**2).sum(axis=1)[:, None]
    distance = np.where(inside > 0, np.sqrt(np.maximum(inside, 0)) - along_direction, 0.0).max(axis=0)
    return distance.min() * DIRECTIONS[distance.argmin()]


def _pressed_in(clip: Clip, recording: Recording, side: Side, by_m: float) -> HandTrack | None:
    entries = recording.annotated.distances(recording.request.clip_id, side).window(0, clip.n_frames)
    if not len(entries.frame):
        return None
    points, nearest = recording.request.points, entries.point[entries.distance_m.argmin()]
    ends = points.points_m[nearest] + np.outer((0.0, 1.0), points.normals[nearest])
    normal_ends = clip.object.points_in_world(ends.astype(np.float64), np.repeat(points.part[nearest], 2))
    return _shifted(clip.hands[side], -by_m * (normal_ends[:, 1] - normal_ends[:, 0]))


def _shifted(track: HandTrack, by_m: np.ndarray) -> HandTrack:
    """The hand moved by (frame, 3) metres of the world."""
    return replace(track, wrist_m=(track.wrist_m + by_m).astype(np.float32))


def _control(
    name: str, title: str, perturb: Callable[[Clip, Recording], Clip | str], differs_per_motion: bool = False
) -> Family:
    def load(sources: Sources) -> PerturbedRecording:
        return PerturbedRecording(GroundTruth(sources.annotated), perturb, differs_per_motion)

    return Family(name, title, load)


STATIC = _control("static", "recorded, frozen at the first contact", static)
REVERSED = _control("reversed", "recorded, backwards", backwards)
OBJECT_MOVED = _control("object-moved", "recorded, object 10 cm away", object_moved, differs_per_motion=True)
HANDS_AWAY = _control("hands-away", "recorded, hands 2 cm off the surface", hands_away)
PRESSED = _control("pressed", "recorded, hands 1 cm inside", pressed)
PRESSED_DEEP = _control("pressed-deep", "recorded, hands 3 cm inside", partial(pressed, by_m=PRESSED_DEEP_M))
HANDS_STILL = _control("hands-still", "recorded, hands frozen", hands_still)
HANDS_SHIFTED = _control("hands-shifted", "recorded, hands 3 cm to one side", hands_shifted, differs_per_motion=True)
NOISE = _control("noise", "recorded, with 5 mm of noise", noisy, differs_per_motion=True)
OTHER_HANDS = Family(
    "other-hands",
    "recorded, hands of another clip",
    lambda sources: OtherHands(
        GroundTruth(sources.annotated), Retrieval(retrieval_clips(sources), of_the_hand, "of this hand")
    ),
)
