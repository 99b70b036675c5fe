"""The verdict on one motion: six checks with their number and threshold, in words.

The hands touch the object, carry it, and do not pierce it. The object stands upright in the first frame, does not sink
into what it stands on, and its motion shows the verb. A check that cannot be measured states the reason.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.actions.action import Actions, Limits
from hoidata.batches.requests import ObjectPoints
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.geometry.intervals import runs
from hoidata.hands import HandPair, track_joints
from hoidata.metrics.unmeasured import NO_GRAVITY, Unmeasured
from hoidata.metrics.verb_ranges import SLIP, VerbRanges, up_in_object
from hoidata.objects.rays import EITHER, first_hits
from hoidata.objects.surface_index import PartSurface, SurfaceIndex, surface_index
from hoidata.physics.realism import LARGEST_PENETRATION_M
from hoidata.surface.contact import HandInObjectFrame, deepest_m, hand_in_object_frame

GAP_M = 0.01  # between skin and surface: a larger gap is visible
THROUGH_DEG = 120.0  # between the normals where a finger or palm enters and leaves: not over an edge
TRAVEL_M = 0.02  # an object this far above its start is in the air; one that goes this far without a hand is seen to
MIN_FRAMES = 3  # a tenth of a second; a shorter fault is not visible
STILL_M = 0.01  # an object of which no point moves farther does not move
TILT_DEG = 20.0  # an object that leans more does not stand upright
ALIKE = 0.03  # of the size: an object is the same shape in two rotations if its surfaces differ by less
MOVES = {"path_m": 0.05, "hinge_max_deg": 10.0}  # of the mean training clip of a verb that moves its object
REVERSALS = "reversals_per_s"
MAX_VERTICES = 500  # of the object that are compared
# Joints of each finger: wrist, knuckle, and the two after it. The line of a palm goes from the wrist to the knuckles.
FINGERS = np.array([[0, 3 * finger + 1, 3 * finger + 2, 3 * finger + 3] for finger in range(5)])
TIPS = np.array([16, 17, 18, 19, 20])  # of the same fingers: index, middle, pinky, ring, thumb
UNKNOWN_UP = Unmeasured("it is not known which side of the object is up")
GIVEN_MOTION = Unmeasured("the object's motion was given, without a verb")


@dataclass(frozen=True)
class Check:
    """One check of a motion."""

    name: str
    passed: bool | None  # None if not measured
    words: str  # the number and the threshold, or why nothing was measured

    @property
    def result(self) -> str:
        """The result in a word."""
        return {True: "ok", False: "FAILS", None: "not measured"}[self.passed]


@dataclass(frozen=True)
class RequestedVerb:
    """The verb that a motion must show."""

    verb: str
    ranges: VerbRanges  # of the training clips
    numbers: Mapping[str, float]  # ``VerbRanges.numbers`` of the motion


def requested_verb(
    verb: str | None, trained_verbs: Collection[str], ranges: VerbRanges | None, clip: Clip, points: ObjectPoints
) -> RequestedVerb | Unmeasured:
    """The verb that a motion must show, or why it cannot be checked.

    Args:
        trained_verbs: those of the training clips.
        ranges: of the training clips; None if the checkpoint has none.
    """
    if ranges is None:
        return Unmeasured("the checkpoint has no ranges of its training clips")
    if verb is None or verb not in trained_verbs:
        return Unmeasured("the sentence has no verb of the training clips")
    return RequestedVerb(verb, ranges, ranges.numbers(clip, points))


def verdict(
    clip: Clip,
    hands: HandPair,
    up: np.ndarray | Unmeasured = UNKNOWN_UP,
    requested: RequestedVerb | Unmeasured = GIVEN_MOTION,
    sides: Sequence[Side] = SIDES,
) -> tuple[Check, ...]:
    """Check a motion.

    Args:
        up: (3,) direction of the object that is up when it stands upright, object frame.
        requested: the verb; or why the motion has none.
        sides: hands that must touch the object and must not pierce it, if they are valid in a frame.
    """
    index = surface_index(clip.object.model)
    active: list[Side] = [side for side in SIDES if clip.hands[side].valid.any()]
    placed: dict[Side, HandInObjectFrame] = {side: hand_in_object_frame(clip, side, hands) for side in active}
    gap_m: dict[Side, np.ndarray] = {side: _gap_m(hand, index) for side, hand in placed.items()}
    return (
        _touches({side: gap for side, gap in gap_m.items() if side in sides}),
        _carries(clip, gap_m),
        _does_not_pierce(clip, hands, {side: hand for side, hand in placed.items() if side in sides}, index),
        _stands_upright(clip, up),
        _does_not_sink(clip, gap_m),
        _does_the_verb(clip, requested),
    )


def summary(checks: Sequence[Check]) -> str:
    """The result in one line, such as ``2 of 5 checks fail: touches, carries``."""
    failed = [check.name for check in checks if check.passed is False]
    measured = sum(check.passed is not None for check in checks)
    if failed:
        return f"{len(failed)} of {measured} checks fail: {', '.join(failed)}"
    return f"all {measured} checks pass" + f", {len(checks) - measured} not measured" * (measured < len(checks))


def fewest_failed(verdicts: Sequence[Sequence[Check]], count: int | None) -> list[int]:
    """Indices of the ``count`` motions that fail the fewest checks, the best first; all in order if None."""
    numbers = list(range(len(verdicts)))
    if count is None:
        return numbers
    return sorted(numbers, key=lambda number: sum(check.passed is False for check in verdicts[number]))[:count]


def verdict_lines(number: int, checks: Sequence[Check]) -> list[str]:
    """The verdict on one sample, for the terminal."""
    return [f"sample {number + 1}: {summary(checks)}", *(f"  {one.result}: {one.name}: {one.words}" for one in checks)]


def _gap_m(hand: HandInObjectFrame, index: SurfaceIndex) -> np.ndarray:
    """(frame,) metres from the skin to the surface, infinite without the hand."""
    return hand.expand_to_clip(index.distance_m(hand.vertices_m, hand.hinge_rad).min(axis=1), np.inf)


def _touches(gap_m: Mapping[Side, np.ndarray]) -> Check:
    if not gap_m:
        return Check("touches", None, "no hand is active")
    nearest = {side: float(gap.min()) for side, gap in gap_m.items()}
    words = ", ".join(f"{side} hand {100 * gap:.1f} cm from the object at its nearest" for side, gap in nearest.items())
    return Check("touches", max(nearest.values()) <= GAP_M, f"{words} (at most {100 * GAP_M:.0f} cm)")


def _carries(clip: Clip, gap_m: Mapping[Side, np.ndarray]) -> Check:
    """Without a hand at it the object neither travels nor is in the air; a tremble in place is not visible."""
    paths_m = _vertex_paths_m(clip)
    in_air = np.zeros(clip.n_frames, bool)
    if clip.gravity is not None:
        in_air = (paths_m - paths_m[0]).mean(axis=1) @ -np.asarray(clip.gravity, np.float64) > TRAVEL_M
    if not in_air.any() and _travel_m(paths_m) <= TRAVEL_M:
        return Check("carries", None, "the object neither moves nor is in the air")
    alone = np.min([*gap_m.values(), np.full(clip.n_frames, np.inf)], axis=0) > GAP_M
    travel_m = max((_travel_m(paths_m[first : stop + 1]) for first, stop in runs(alone)), default=0.0)
    frames = int((alone & in_air).sum())
    words = f"without a hand within {100 * GAP_M:.0f} cm the object moves {100 * travel_m:.1f} cm"
    words += f" (at most {100 * TRAVEL_M:.0f} cm)"
    if clip.gravity is not None:
        words += f"; frames in the air: {frames} (at most {MIN_FRAMES - 1})"
    floats_at_end = bool(alone[-1] and in_air[-1])
    words += ", and the last frame" * floats_at_end
    return Check("carries", travel_m <= TRAVEL_M and frames < MIN_FRAMES and not floats_at_end, words)


def _travel_m(paths_m: np.ndarray) -> float:
    """The farthest that a vertex of (frame, vertex, 3) gets from its first position, metres."""
    return float(np.linalg.norm(paths_m - paths_m[0], axis=2).max())


def _does_not_pierce(
    clip: Clip, hands: HandPair, placed: Mapping[Side, HandInObjectFrame], index: SurfaceIndex
) -> Check:
    if not placed:
        return Check("does not pierce", None, "no hand is active")
    texts, worst = list[str](), 0
    for side, hand in placed.items():
        through = _pierced(clip, side, hands, hand, index)
        n_fingers = int(through.any(axis=0).sum())
        texts.append(f"{side} hand: {n_fingers} of 5 lines from wrist to fingertip through the object")
        deep = np.zeros(clip.n_frames, bool)
        if index.is_solid:
            depth_m = np.nan_to_num(deepest_m(hand, index))
            deep = depth_m > LARGEST_PENETRATION_M
            texts[-1] += f", {100 * depth_m.max():.1f} cm deep"
        frames = int((deep | through.any(axis=1)).sum())
        texts[-1] += f", too deep in {frames} frames"
        worst = max(worst, frames)
    limit = f"a line through, or deeper than {100 * LARGEST_PENETRATION_M:.1f} cm, in at most {MIN_FRAMES - 1} frames"
    without = "" if index.is_solid else "; depth is not measured, because the mesh encloses no solid"
    return Check("does not pierce", worst < MIN_FRAMES, f"{'; '.join(texts)} ({limit}){without}")


def _pierced(clip: Clip, side: Side, hands: HandPair, hand: HandInObjectFrame, index: SurfaceIndex) -> np.ndarray:
    """(frame, finger) bool: the centre line from wrist to tip enters the surface and leaves it on the other side."""
    track, frames = clip.object, hand.frames
    joints_m = track.world_from_object.inverse() @ track_joints(clip.hands[side], hands[side]).astype(np.float64)
    joints_m = joints_m[frames]
    line_m = np.concatenate([joints_m[:, FINGERS], joints_m[:, TIPS][:, :, None]], axis=2)  # (frame, finger, 5, 3)
    pierced = np.zeros(line_m.shape[:2], bool)
    for part, surface in index.filled.items():
        part_from_object = track.model.object_from_part(part, hand.hinge_rad).inverse()
        in_part_m = (part_from_object @ line_m.reshape(len(frames), -1, 3)).reshape(line_m.shape)
        pierced |= _passes_through(surface, in_part_m)
    return hand.expand_to_clip(pierced, False)


def _passes_through(surface: PartSurface, line_m: np.ndarray) -> np.ndarray:
    """(frame, finger) bool of polylines (frame, finger, point, 3): two crossings have opposite normals."""
    from_tip_m = line_m[:, :, ::-1]
    first = [_first_crossing(surface, line) for line in (line_m, from_tip_m)]
    (entry_m, hit), (exit_m, _) = first
    passes = hit & (np.linalg.norm(entry_m - exit_m, axis=-1) > 1e-6)
    through = np.zeros(len(passes), bool)
    normals = [surface.nearest(np.ascontiguousarray(points[passes])).normal for points in (entry_m, exit_m)]
    through[passes] = (normals[0] * normals[1]).sum(axis=1) < np.cos(np.radians(THROUGH_DEG))
    return through.reshape(line_m.shape[:2])


def _first_crossing(surface: PartSurface, line_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (polyline, 3) of the first crossing of polylines (frame, finger, point, 3), and whether there is one."""
    lines = line_m.reshape(-1, *line_m.shape[2:])
    position_m, hit = np.zeros((len(lines), 3)), np.zeros(len(lines), bool)
    for start_m, end_m in zip(lines.swapaxes(0, 1)[:-1], lines.swapaxes(0, 1)[1:], strict=True):
        length_m = np.linalg.norm(end_m - start_m, axis=1)
        direction, distance_m = (end_m - start_m) / length_m[:, None], np.full(len(lines), np.inf)
        facing = np.full(len(lines), EITHER)
        first_hits(surface.tree, np.ascontiguousarray(start_m), direction, length_m, facing, distance_m)
        new = np.isfinite(distance_m) & ~hit
        position_m[new] = start_m[new] + distance_m[new, None] * direction[new]
        hit |= new
    return position_m, hit


def _stands_upright(clip: Clip, up: np.ndarray | Unmeasured) -> Check:
    name = "stands upright"
    if clip.gravity is None:
        return Check(name, None, NO_GRAVITY.reason)
    if isinstance(up, Unmeasured):
        return Check(name, None, up.reason)
    actual = up_in_object(clip.object, clip.gravity)
    tilt_deg = float(np.degrees(np.arccos(np.clip(actual @ up, -1, 1))))
    words = f"{tilt_deg:.0f} degrees from upright in the first frame (at most {TILT_DEG:.0f})"
    if tilt_deg > TILT_DEG and _looks_alike(clip, up, actual):
        return Check(name, True, f"{words}, where it looks the same as upright")
    return Check(name, tilt_deg <= TILT_DEG, words)


def _does_not_sink(clip: Clip, gap_m: Mapping[Side, np.ndarray]) -> Check:
    """An object that no hand holds at first stands on something, which it enters no deeper than hands may enter it."""
    name = "does not sink"
    if clip.gravity is None:
        return Check(name, None, NO_GRAVITY.reason)
    if any(gap[0] <= GAP_M for gap in gap_m.values()):
        return Check(name, None, "a hand is at the object in the first frame, so it need not stand on anything")
    lowest_m = (_vertex_paths_m(clip) @ -np.asarray(clip.gravity, np.float64)).min(axis=1)
    below_m = lowest_m[0] - lowest_m
    frames = int((below_m > LARGEST_PENETRATION_M).sum())
    words = f"{100 * below_m.max():.1f} cm below where it stood at most, deeper than "
    words += f"{100 * LARGEST_PENETRATION_M:.1f} cm in {frames} frames (at most {MIN_FRAMES - 1})"
    return Check(name, frames < MIN_FRAMES, words)


def _looks_alike(clip: Clip, up: np.ndarray, actual: np.ndarray) -> bool:
    """Whether the object has the same shape when its direction ``actual`` is up instead of ``up``: a ball, a cube."""
    model = clip.object.model
    if model.is_articulated:
        return False
    middle_m = (model.vertices_m.min(axis=0) + model.vertices_m.max(axis=0)) / 2
    rotation = Rotation.align_vectors(up[None], actual[None])[0].as_matrix()
    vertices_m = model.vertices_m[:: max(1, len(model.vertices_m) // MAX_VERTICES)] - middle_m
    distance_m = surface_index(model).distance_m((vertices_m @ rotation.T + middle_m)[None], None)
    return bool(distance_m.max() < ALIKE * np.ptp(model.vertices_m, axis=0).max())


def _does_the_verb(clip: Clip, requested: RequestedVerb | Unmeasured) -> Check:
    name = "does the verb"
    if isinstance(requested, Unmeasured):
        return Check(name, None, requested.reason)
    verb, actions, numbers = requested.verb, requested.ranges.actions, requested.numbers
    farthest_m = _travel_m(_vertex_paths_m(clip))
    if farthest_m < STILL_M and _moves_its_object(actions, verb):
        words = f"{verb!r} moves its object, but no point of it moves farther than {100 * farthest_m:.1f} cm"
        return Check(name, False, f"{words} (at least {100 * STILL_M:.0f} cm)")
    if not actions.usual.get(verb):
        return Check(name, None, f"training had too few clips of {verb!r} for usual ranges")
    if visible := actions.visibly_unusual(verb, _without_quality(actions.usual[verb], numbers)):
        moved_as = actions.nearest_verb(numbers)
        other = f", more like {moved_as!r}" if requested.ranges.is_other(verb, moved_as) else ""
        return Check(name, False, f"unlike {verb!r} in training{other}: {', '.join(visible)}")
    n_measures = len(actions.usual[verb])
    return Check(name, True, f"{n_measures} measures of motion are in or near their range of the training clips")


def _without_quality(usual: Limits, numbers: Mapping[str, float]) -> dict[str, float]:
    """Measures of the verb: hands that slip and an object that trembles still do it, unless it shakes too little."""
    most_reversals = usual.get(REVERSALS, (0.0, np.inf))[1]
    return {**numbers, SLIP: 0.0, REVERSALS: min(numbers[REVERSALS], most_reversals)}


def _moves_its_object(actions: Actions, verb: str) -> bool:
    """Whether the mean training clip of a verb moves its object."""
    if verb not in actions.centroids:
        return False
    measures: dict[str, Any] = {
        name: float(value) * deviation + mean
        for value, (name, (mean, deviation)) in zip(actions.centroids[verb], actions.scale.items(), strict=True)
    }
    return any(measures.get(name, 0.0) > threshold for name, threshold in MOVES.items())


def _vertex_paths_m(clip: Clip) -> np.ndarray:
    """(frame, vertex, 3) world positions of some of the object's vertices, metres."""
    model = clip.object.model
    step = max(1, len(model.vertices_m) // MAX_VERTICES)
    return clip.object.points_in_world(model.vertices_m[::step], model.part[::step])
