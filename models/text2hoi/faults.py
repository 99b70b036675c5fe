"""What a person who watches a generated motion would see to be wrong with it, and that alone, in words.

A number outside the bounds of a verb's training clips counts where the difference is large enough to be seen
(``hoidata.actions.action``). Hands that never reach the object, lie deep inside of it or leave it in the air, and an
object that stays where it is, are faults whatever the verb.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hoidata.actions.action import Actions
from hoidata.batches.requests import ObjectPoints
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.hands import HandPair
from hoidata.objects.surface_index import SurfaceIndex, surface_index
from hoidata.surface.contact import PlacedHand, deepest_m, placed_hand
from models.text2hoi.verb_check import VerbCheck

GAP_M = 0.01  # between skin and surface: a hand farther away is seen not to touch
DEEP_M = 0.02  # as thick as a finger, which is then inside as a whole
FLOATING_M = 0.02  # above where the object began: it is in the air
LEAST_FRAMES = 3  # a tenth of a second; what is shorter passes unseen
STILL = {"path_m": 0.01, "tilt_deg": 5.0, "turn_deg": 5.0, "hinge_max_deg": 5.0}  # less of each is no motion
MOVES = {"path_m": 0.05, "hinge_max_deg": 10.0}  # of the mean training clip of a verb that moves its object


def visible_faults(
    clip: Clip, points: ObjectPoints, hands: HandPair, check: VerbCheck | None, asked: str | None
) -> tuple[str, ...]:
    """Faults of a motion, each in words.

    points: sampled on the object. check: of the training clips, None where the networks keep none. asked: the verb that
    the motion is to show, None where it is not known.
    """
    index = surface_index(clip.object.model)
    there: list[Side] = [side for side in SIDES if clip.hands[side].valid.any()]
    placed: dict[Side, PlacedHand] = {side: placed_hand(clip, side, hands) for side in there}
    gaps: dict[Side, np.ndarray] = {side: _gap_m(hand, index) for side, hand in placed.items()}
    found = [*_contact_faults(clip, gaps), *_depth_faults(placed, index)]
    if check is not None:
        numbers = check.numbers(clip, points)
        moved_as, seen = check.moved_as(numbers), check.seen(asked, numbers)
        if asked is not None and _is_still(numbers) and _moves_its_object(check.actions, asked):
            found.append("the object does not move")
        elif seen:
            other = f", more like {moved_as!r}" if check.fails(asked, moved_as) else ""
            whose = f"{asked!r} in training" if asked else "the motions of training"
            found.append(f"unlike {whose}{other}: {', '.join(seen)}")
    return tuple(found)


def _gap_m(hand: PlacedHand, index: SurfaceIndex) -> np.ndarray:
    """(frame,) metres from the skin to the surface, infinite without the hand."""
    return hand.over_clip(index.distance_m(hand.vertices_m, hand.hinge_rad).min(axis=1), np.inf)


def _contact_faults(clip: Clip, gap_m: Mapping[Side, np.ndarray]) -> list[str]:
    away = {side: float(gap.min()) for side, gap in gap_m.items() if gap.min() > GAP_M}
    found = [f"the {side} hand never touches the object ({gap * 100:.1f} cm away)" for side, gap in away.items()]
    if len(away) < len(gap_m) and clip.gravity is not None:
        height = -(clip.object.translation_m.astype(np.float64) @ np.asarray(clip.gravity, np.float64))
        lifted = height - height[0] > FLOATING_M
        alone = int((lifted & (np.min([*gap_m.values()], axis=0) > GAP_M)).sum())
        found += [f"the object is in the air and no hand touches it in {alone} frames"] * (alone >= LEAST_FRAMES)
    return found


def _depth_faults(placed: Mapping[Side, PlacedHand], index: SurfaceIndex) -> list[str]:
    if not index.is_solid:
        return []
    found = []
    for side, hand in placed.items():
        depth = deepest_m(hand, index)
        if (frames := int((depth > DEEP_M).sum())) >= LEAST_FRAMES:
            deepest = float(np.nanmax(depth)) * 100
            found.append(f"the {side} hand is up to {deepest:.1f} cm inside the object in {frames} frames")
    return found


def _is_still(numbers: Mapping[str, float]) -> bool:
    return all(numbers[name] < most for name, most in STILL.items())


def _moves_its_object(actions: Actions, verb: str) -> bool:
    """Whether the mean training clip of a verb moves its object."""
    if verb not in actions.centroids:
        return False
    mean: dict[str, Any] = {
        name: float(own) * deviation + middle
        for own, (name, (middle, deviation)) in zip(actions.centroids[verb], actions.scale.items(), strict=True)
    }
    return any(mean.get(name, 0.0) > least for name, least in MOVES.items())
