"""Metrics of one motion: joint error, smoothness, action, length, and the physical realism of ManipNet.

Each function returns the values of one motion, or why it has none. Physical realism needs gravity and a lifted object.
Derivatives use every frame, whatever the frame step.
"""

from functools import lru_cache

import numpy as np

from hoidata.actions.action import action_numbers, object_middle_m
from hoidata.clips.clip import FPS, SIDES, Side
from hoidata.metrics.pair import Pair
from hoidata.metrics.touch import contact_entries
from hoidata.metrics.unmeasured import NO_GRAVITY, Unmeasured, Values
from hoidata.physics.mano_capsules import world_rotmats
from hoidata.physics.realism import VARIANTS, Realism, every_frame_passes, has_acceleration, score, smoothness_m_s2
from hoidata.physics.scene import Scene

NO_VERB = Unmeasured("the clip has no verb")


def joint_error_mm(pair: Pair, frame_step: int) -> np.ndarray:
    """(hand and frame,) mean distance of the 21 joints from those of the reference in the world frame, millimetres."""
    errors_m = []
    for side in pair.sides:
        frames = pair.frames(side, frame_step)
        offset_m = pair.predicted.joints_m[side][frames] - pair.reference.joints_m[side][frames]
        errors_m.append(np.linalg.norm(offset_m.astype(np.float64), axis=-1).mean(axis=-1))
    return 1000 * _concatenated(errors_m)


def smoothness(pair: Pair, _frame_step: int) -> np.ndarray:
    """(hand,) mean acceleration of the joints in the wrist's frame, m/s^2; needs three successive valid frames."""
    accelerations = []
    for side in pair.sides:
        joints = _visible_joints(pair, side)
        if has_acceleration(joints, FPS):
            wrist = world_rotmats(pair.predicted.clip.hands[side])[:, 0]
            accelerations.append(smoothness_m_s2(joints, wrist, FPS))
    return np.array(accelerations)


def jitter_m_s3(pair: Pair, _frame_step: int) -> np.ndarray:
    """(hand and frame,) mean over the joints of the third difference (jerk) of world positions, m/s^3."""
    jitters = []
    for side in pair.sides:
        third = np.linalg.norm(np.diff(_visible_joints(pair, side), n=3, axis=0), axis=-1).mean(axis=-1) * FPS**3
        jitters.append(third[np.isfinite(third)])
    return _concatenated(jitters)


def object_jitter_m_s3(pair: Pair, _frame_step: int) -> np.ndarray:
    """(frame,) third difference (jerk) of the world position of the object's centre, m/s^3."""
    third = np.diff(object_middle_m(pair.predicted.clip.object).astype(np.float64), n=3, axis=0)
    return np.linalg.norm(third, axis=-1) * FPS**3


def length_error_frames(pair: Pair, _frame_step: int) -> Values:
    """(1,) absolute error of an estimated length, frames; unmeasured if the length was given."""
    wrong = abs(pair.predicted.clip.n_frames - pair.reference.clip.n_frames)
    return Unmeasured("the length was given") if pair.aligned else np.array([float(wrong)])


def length_error_share(pair: Pair, frame_step: int) -> Values:
    """(1,) absolute error of an estimated length as a fraction of the recorded length."""
    wrong = length_error_frames(pair, frame_step)
    return wrong if isinstance(wrong, Unmeasured) else wrong / pair.reference.clip.n_frames


def action_followed(pair: Pair, _frame_step: int) -> Values:
    """(1,) 1 if the object's motion satisfies the limits of the verb, else 0; unmeasured for a verb without limits."""
    if pair.verb is None:
        return NO_VERB
    if pair.actions is None or pair.verb not in pair.actions.limits:
        return Unmeasured("the verb has too few training clips, or an object at rest is within their usual range")
    followed = pair.actions.satisfies_limits(pair.verb, _action(pair))
    return NO_GRAVITY if followed is None else np.array([float(followed)])


def action_named(pair: Pair, _frame_step: int) -> Values:
    """(1,) 1 if the nearest centroid of training clips belongs to the requested verb, else 0."""
    if pair.verb is None:
        return NO_VERB
    if pair.actions is None or pair.verb not in pair.actions.centroids:
        return Unmeasured("no training clip has the verb")
    named = pair.actions.nearest_verb(_action(pair))
    return NO_GRAVITY if named is None else np.array([float(named == pair.verb)])


@lru_cache(maxsize=1)
def _action(pair: Pair) -> dict[str, float]:
    """Motion measures of the predicted object (``hoidata.actions``), by name."""
    clip = pair.predicted.clip
    touching = np.zeros((len(SIDES), clip.n_frames), bool)
    for side, near in contact_entries(pair).items():
        touching[SIDES.index(side), near["frame"]] = True
    return action_numbers(clip.object, pair.reference.clip.gravity, touching)


def _visible_joints(pair: Pair, side: Side) -> np.ndarray:
    """(frame, 21, 3) float64 predicted world joints, NaN in frames in which the hand is not measured."""
    return np.where(pair.valid(side)[:, None, None], pair.predicted.joints_m[side].astype(np.float64), np.nan)


def _concatenated(arrays: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *arrays])


def realism_si(pair: Pair, frame_step: int) -> Values:
    """(scored frame,) 1 where friction forces at the contacts explain the object's motion, in SI units."""
    return _passed(_realism(pair, "SI", frame_step))


def realism_as_released(pair: Pair, frame_step: int) -> Values:
    """(scored frame,) as ``realism_si``, with the units of ManipNet's released code."""
    return _passed(_realism(pair, "as released", frame_step))


def floor_si(pair: Pair, frame_step: int) -> Values:
    """(lifted frame,) as ``realism_si`` without hands: 1 only in free fall. Lower bound of the metric."""
    return _passed(_scored(_without_hands(pair), pair, "SI", frame_step))


def floor_as_released(pair: Pair, frame_step: int) -> Values:
    """(lifted frame,) as ``realism_as_released`` without hands."""
    return _passed(_scored(_without_hands(pair), pair, "as released", frame_step))


def realism_every_frame(pair: Pair, frame_step: int) -> Values:
    """(frame,) 1 where contact forces of hands and table explain the object's motion and no hand is deep inside it."""
    return _every_frame(pair.scene, pair, frame_step)


def floor_every_frame(pair: Pair, frame_step: int) -> Values:
    """(frame,) as ``realism_every_frame`` without hands: 1 where the object rests on the table or falls."""
    return _every_frame(_without_hands(pair), pair, frame_step)


def _every_frame(scene: Scene | Unmeasured, pair: Pair, frame_step: int) -> Values:
    if isinstance(scene, Unmeasured):
        return scene
    return every_frame_passes(scene, _every_nth(pair.measured, frame_step)).astype(np.float64)


def capsule_depth_mm(pair: Pair, frame_step: int) -> Values:
    """(1,) mean depth over the hand capsules that overlap the object in lifted frames, millimetres."""
    realism = _realism(pair, "SI", frame_step)
    if isinstance(realism, Unmeasured):
        return realism
    if np.isnan(realism.colliding_m):
        return Unmeasured("no hand capsule overlaps the object in a lifted frame")
    return np.array([1000 * realism.colliding_m])


def _passed(realism: Realism | Unmeasured) -> Values:
    return realism if isinstance(realism, Unmeasured) else realism.passed.astype(np.float64)


@lru_cache(maxsize=1)
def _without_hands(pair: Pair) -> Scene | Unmeasured:
    scene = pair.scene
    if isinstance(scene, Unmeasured):
        return scene
    return scene.with_capsules(scene.capsules.taken(slice(None), slice(0, 0)))


@lru_cache(maxsize=2)
def _realism(pair: Pair, variant: str, frame_step: int) -> Realism | Unmeasured:
    return _scored(pair.scene, pair, variant, frame_step)


def _scored(scene: Scene | Unmeasured, pair: Pair, variant: str, frame_step: int) -> Realism | Unmeasured:
    if isinstance(scene, Unmeasured):
        return scene
    return score(scene, VARIANTS[variant], _every_nth(scene.lifted & pair.measured, frame_step))


def _every_nth(frames: np.ndarray, frame_step: int) -> np.ndarray:
    """Every n-th of frames (frame,) bool. Derivatives use all frames; only the scored frames are thinned."""
    chosen = np.zeros_like(frames)
    chosen[np.flatnonzero(frames)[::frame_step]] = True
    return chosen
