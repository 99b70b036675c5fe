"""An object waits while a hand comes to it or lets go of it.

Generated hands and objects agree on what happens and not to the frame on when: a hand that takes a moving object over,
or lets go of it on its way, sweeps over it for a few frames. There the object is made to stand, and catches up on its
own path before and after. What each hand does as seen from the part it is at stays as it is, so no contact changes.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.geometry.intervals import runs
from hoidata.hands.model import HandPair
from hoidata.refinement.object_field import ObjectField, world_from_part
from hoidata.refinement.skin import HandPose, Skin

_EVERY = 5  # of a hand's vertices: enough to see whether it touches, and how fast
_ENOUGH = 500  # vertices tell how far an object moves
_STANDS = 1000.0  # what standing, and rest that stays rest, counts beside keeping a speed
_AT_REST = 0.1  # of its usual speed, while it moves


@dataclass(frozen=True)
class WaitSettings:
    """near_m, slip_m_s: a hand sweeps over an object where skin is nearer than this and moves faster on it. moving_m_s:
    the object moves if its surface does so in the mean. most: moving frames of one sweep; where it has more, or most of
    the motion is swept, hand and object are not merely out of step, and both stay. even, keep: what steps that are like
    their neighbours, and an object that is where it was at that time, count beside keeping a speed.
    """

    near_m: float = 0.012
    slip_m_s: float = 0.1
    moving_m_s: float = 0.02
    most: int = 12
    even: float = 4.0
    keep: float = 0.01


def wait_for_hands(pair: HandPair, clip: Clip, settings: WaitSettings = WaitSettings()) -> Clip:
    """The clip with its object standing while a hand sweeps over it; a clip in which none does stays as it was."""
    hands = {side: hand for side in SIDES if (hand := _HandAtPart.of(pair, side, clip, settings)) is not None}
    if not hands:
        return clip
    steps_m, sweeps = _steps_m(clip.object), np.any([hand.sweeps for hand in hands.values()], axis=0)
    moving = steps_m * FPS > settings.moving_m_s
    for start, stop in runs(sweeps):
        if moving[start:stop].sum() > settings.most:
            sweeps[start:stop] = False
    if not (sweeps & moving).any() or steps_m[sweeps].sum() > steps_m[~sweeps].sum():
        return clip
    thing = _retimed(clip.object, _moments(steps_m, sweeps, settings))
    return replace(
        clip, object=thing, hands={**clip.hands, **{side: own.carried(thing) for side, own in hands.items()}}
    )


@dataclass(frozen=True)
class _HandAtPart:
    """A hand, and where it is as seen from the part it is nearest to.

    sweeps: (frame - 1,) whether some skin that is near the part moves over it to the next frame.
    """

    track: HandTrack
    pose: HandPose
    part: int
    sweeps: np.ndarray

    @classmethod
    def of(cls, pair: HandPair, side: Side, clip: Clip, settings: WaitSettings) -> "_HandAtPart | None":
        """None for a hand that is never at the object."""
        track, thing = clip.hands[side], clip.object
        if not track.valid.any():
            return None
        skin, world = Skin(pair[side], np.asarray(track.betas, np.float64)[0], track.template_m), HandPose.of(track)
        points_m = skin.vertices_m(skin.chain(world))[:, ::_EVERY]
        field = ObjectField(thing)
        near = (field.distances(points_m)[0] < settings.near_m) & track.valid[:, None]
        if not near.any():
            return None
        part, near = field.part_touched(points_m, near)
        part_from_world = world_from_part(thing, part).inverse()
        local = part_from_world @ points_m
        slip = np.linalg.norm(np.diff(local, axis=0), axis=-1) * FPS
        sweeps = (near[1:] & near[:-1] & (slip > settings.slip_m_s)).any(axis=1)
        return cls(track, world.seen_from(part_from_world), part, sweeps)

    def carried(self, thing: ObjectTrack) -> HandTrack:
        """The hand as it was, seen from its part, where that is now; frames without it stay as they were."""
        pose, track, valid = self.pose.seen_from(world_from_part(thing, self.part)), self.track, self.track.valid
        made = pose.track(track.mean_betas, valid, track.template_m)
        wrist, turn = (
            np.where(valid[:, None], getattr(made, name), getattr(track, name)) for name in ("wrist_m", "global_orient")
        )
        return replace(track, wrist_m=wrist, global_orient=turn)


def _steps_m(thing: ObjectTrack) -> np.ndarray:
    """(frame - 1,) how far the object moves to the next frame: the mean over its vertices, metres."""
    some = slice(None, None, 1 + len(thing.model.vertices_m) // _ENOUGH)
    places = thing.points_in_world(thing.model.vertices_m[some], thing.model.part[some])
    return np.linalg.norm(np.diff(places, axis=0), axis=-1).mean(axis=1)


def _moments(steps_m: np.ndarray, sweeps: np.ndarray, settings: WaitSettings) -> np.ndarray:
    """(frame,) which moment of its own motion, in frames, the object is in.

    Least squares over the steps it takes: none where a hand sweeps over it, elsewhere its own, changes of speed spread
    out, and never far from where it was. So it makes up for what it misses near by, and where it moved already.
    """
    own = steps_m / np.median(steps_m[steps_m * FPS > settings.moving_m_s])  # of its usual speed while it moves
    weight = np.where(sweeps | (own < _AT_REST), _STANDS, 1.0)
    differences, sums = np.diff(np.eye(len(own)), axis=0), np.tri(len(own))
    matrix = np.diag(weight) + settings.even * differences.T @ differences + settings.keep * sums.T @ sums
    change = np.linalg.solve(matrix, np.where(sweeps, -weight * own, 0))
    steps = np.where(sweeps, 0, np.maximum(own + change, 0))
    steps *= own.sum() / steps.sum()  # it ends where it ended
    rising = 1e-6 * np.arange(len(own) + 1)  # so that every moment is found, at rest too
    way, new_way = (np.append(0, np.cumsum(array)) + rising for array in (own, steps))
    return np.interp(new_way, way, np.arange(len(way), dtype=np.float64))


def _retimed(thing: ObjectTrack, frames: np.ndarray) -> ObjectTrack:
    """The object at moments between its frames."""
    numbers = np.arange(thing.n_frames)
    turns = Slerp(numbers, Rotation.from_rotvec(np.asarray(thing.rotvec, np.float64)))(frames)
    place_m = np.stack([np.interp(frames, numbers, axis) for axis in thing.translation_m.T], axis=1)
    hinge = None if thing.hinge_rad is None else np.interp(frames, numbers, thing.hinge_rad).astype(np.float32)
    return replace(
        thing,
        rotvec=turns.as_rotvec().astype(thing.rotvec.dtype),
        translation_m=place_m.astype(thing.translation_m.dtype),
        hinge_rad=hinge,
    )
