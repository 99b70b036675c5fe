"""Can the contacts carry the motion? ManipNet's physical measures of one predicted motion, with what they give for
no hands at all (the floor). Without known gravity, or where the object is never lifted, there are no values. Each
function gives the values of one motion, or why there are none.
"""

from functools import lru_cache

import numpy as np

from hoidata.metrics.pair import Pair
from hoidata.metrics.unmeasured import Unmeasured, Values
from hoidata.physics.realism import VARIANTS, Realism, score
from hoidata.physics.scene import Scene


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
