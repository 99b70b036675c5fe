"""How far joints are from the truth, how smoothly they move, what the object does, how long it all takes; and
ManipNet's physical measures: can the contacts carry the object?

Each function gives the values of one motion, or why there are none. Of the physical ones there are none without known
gravity, or where the object is never lifted.
"""

from functools import lru_cache

import numpy as np

from hoidata.actions.action import action_numbers, object_middle_m
from hoidata.clips.clip import FPS, SIDES, Side
from hoidata.metrics.pair import Pair
from hoidata.metrics.touch import made_entries
from hoidata.metrics.unmeasured import NO_GRAVITY, Unmeasured, Values
from hoidata.physics.mano_capsules import world_rotmats
from hoidata.physics.realism import VARIANTS, Realism, has_acceleration, score, smoothness_m_s2
from hoidata.physics.scene import Scene

NO_VERB = Unmeasured("the clip has no verb")


def joint_error_mm(pair: Pair, every: int) -> np.ndarray:
    """(hand and frame,) mean distance of the 21 joints from those of the reference, millimetres, in its world."""
    each = []
    for side in pair.sides:
        frames = pair.frames(side, every)
        apart = pair.predicted.joints_m[side][frames] - pair.reference.joints_m[side][frames]
        each.append(np.linalg.norm(apart.astype(np.float64), axis=-1).mean(axis=-1))
    return 1000 * _joined(each)


def smoothness(pair: Pair, every: int) -> np.ndarray:
    """(hand,) mean acceleration of the joints in the wrist's frame, m/s^2, of hands seen in three frames in a row."""
    del every  # a derivative needs every frame
    found = []
    for side in pair.sides:
        joints = _seen(pair, side)
        if has_acceleration(joints, FPS):
            wrist = world_rotmats(pair.predicted.clip.hands[side])[:, 0]
            found.append(smoothness_m_s2(joints, wrist, FPS))
    return np.array(found)


def jitter_m_s3(pair: Pair, every: int) -> np.ndarray:
    """(hand and frame,) mean over the joints of the third difference of world positions, m/s^3."""
    del every  # a derivative needs every frame
    each = []
    for side in pair.sides:
        third = np.linalg.norm(np.diff(_seen(pair, side), n=3, axis=0), axis=-1).mean(axis=-1) * FPS**3
        each.append(third[np.isfinite(third)])
    return _joined(each)


def object_jitter_m_s3(pair: Pair, every: int) -> np.ndarray:
    """(frame,) third difference of the world position of the object's middle, m/s^3."""
    del every  # a derivative needs every frame
    third = np.diff(object_middle_m(pair.predicted.clip.object).astype(np.float64), n=3, axis=0)
    return np.linalg.norm(third, axis=-1) * FPS**3


def length_error_frames(pair: Pair, every: int) -> Values:
    """(1,) by how many frames the length a family chose is wrong, either way; none where the length was given."""
    del every
    wrong = abs(pair.predicted.clip.n_frames - pair.reference.clip.n_frames)
    return Unmeasured("the length was given") if pair.aligned else np.array([float(wrong)])


def length_error_share(pair: Pair, every: int) -> Values:
    """(1,) the same as a share of the true length."""
    wrong = length_error_frames(pair, every)
    return wrong if isinstance(wrong, Unmeasured) else wrong / pair.reference.clip.n_frames


def action_followed(pair: Pair, every: int) -> Values:
    """(1,) 1 where the object does what the verb says, else 0; none where nothing is known of the verb."""
    del every
    if pair.verb is None:
        return NO_VERB
    if pair.actions is None or pair.verb not in pair.actions.limits:
        return Unmeasured("no limits are known of the verb")
    followed = pair.actions.satisfies_limits(pair.verb, _action(pair))
    return NO_GRAVITY if followed is None else np.array([float(followed)])


def action_named(pair: Pair, every: int) -> Values:
    """(1,) 1 where the verb whose training clips move the object most alike is the one asked for, else 0."""
    del every
    if pair.verb is None:
        return NO_VERB
    if pair.actions is None or pair.verb not in pair.actions.centroids:
        return Unmeasured("no training clip has the verb")
    named = pair.actions.nearest_verb(_action(pair))
    return NO_GRAVITY if named is None else np.array([float(named == pair.verb)])


@lru_cache(maxsize=1)
def _action(pair: Pair) -> dict[str, float]:
    """What the object of the prediction does, in numbers."""
    clip = pair.predicted.clip
    touching = np.zeros((len(SIDES), clip.n_frames), bool)
    for side, near in made_entries(pair).items():
        touching[SIDES.index(side), near["frame"]] = True
    return action_numbers(clip.object, pair.reference.clip.gravity, touching)


def _seen(pair: Pair, side: Side) -> np.ndarray:
    """(frame, 21, 3) float64 predicted joints, NaN in frames without the hand."""
    return np.where(pair.valid(side)[:, None, None], pair.predicted.joints_m[side].astype(np.float64), np.nan)


def _joined(each: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *each])


def realism_si(pair: Pair, every: int) -> Values:
    """(scored frame,) 1 where friction forces at the contacts give the object's motion, in SI units."""
    return _passed(pair, "SI", every)


def realism_as_released(pair: Pair, every: int) -> Values:
    """(scored frame,) the same with the units of ManipNet's released sources."""
    return _passed(pair, "as released", every)


def floor_si(pair: Pair, every: int) -> Values:
    """(lifted frame,) the same in SI units with no hands: 1 only in free fall."""
    return _floor(pair, "SI", every)


def floor_as_released(pair: Pair, every: int) -> Values:
    """(lifted frame,) the same as released with no hands."""
    return _floor(pair, "as released", every)


def capsule_depth_mm(pair: Pair, every: int) -> Values:
    """(1,) mean depth over the hand capsules that overlap the object, in lifted frames, millimetres; none without."""
    found = _score(pair, "SI", every)
    if isinstance(found, Unmeasured):
        return found
    if np.isnan(found.colliding_m):
        return Unmeasured("no hand capsule overlaps the object in a lifted frame")
    return np.array([1000 * found.colliding_m])


def _passed(pair: Pair, variant: str, every: int) -> Values:
    found = _score(pair, variant, every)
    return found if isinstance(found, Unmeasured) else found.passed.astype(np.float64)


def _floor(pair: Pair, variant: str, every: int) -> Values:
    bare = _without_hands(pair)
    if isinstance(bare, Unmeasured):
        return bare
    return score(bare, VARIANTS[variant], _looked_at(bare.lifted, every)).passed.astype(np.float64)


@lru_cache(maxsize=1)
def _without_hands(pair: Pair) -> Scene | Unmeasured:
    scene = pair.scene
    return (
        scene if isinstance(scene, Unmeasured) else scene.with_capsules(scene.capsules.taken(slice(None), slice(0, 0)))
    )


@lru_cache(maxsize=2)
def _score(pair: Pair, variant: str, every: int) -> Realism | Unmeasured:
    scene = pair.scene
    if isinstance(scene, Unmeasured):
        return scene
    return score(scene, VARIANTS[variant], _looked_at(scene.lifted, every))


def _looked_at(lifted: np.ndarray, every: int) -> np.ndarray:
    """Every n-th lifted frame, as (frame,) bool. Derivatives are taken over all frames before any is left out."""
    chosen = np.zeros_like(lifted)
    chosen[np.flatnonzero(lifted)[::every]] = True
    return chosen
