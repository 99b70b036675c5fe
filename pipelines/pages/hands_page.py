"""Writes hands generated for an object motion: motion.npz, motion.glb and a page that plays all samples."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Side
from hoidata.files.atomic import canonical_json
from hoidata.geometry.intervals import runs
from hoidata.hands import HandPair
from hoidata.metrics.unmeasured import NO_INSIDE
from hoidata.metrics.verdict import Check, summary
from hoidata.object_paths.path import PathStep
from models.bimart.hands import TOUCH_M, ContactMeasures, SampledHands
from pipelines.pages import motion_files
from pipelines.pages.glb import HAND_COLOURS
from pipelines.pages.motion_files import MotionFiles, simplified_for_page
from pipelines.pages.player import Player, contact_player, css_colour, motion_player
from pipelines.pages.surface import ContactPaint

FACES_OF_STILLS = 8_000
MAPS_OVER_TIME = 5  # frames, evenly spaced, whose target contact maps are on the page
FADES_M = 0.02  # where paint ends

# Every array of motion.npz. Axes: S = 2 sides (left, right), F frames, P object points.
ARRAYS = motion_files.GENERATED_ARRAYS | {
    "before_joints_m": "(S, F, 21, 3) the joints before refinement",
    "touching": "(S, F) whether a vertex of the hand is within 5 mm of the surface",
    "contact_distance_m": "(S, F, P) float16 distance of each point to the nearest vertex of the hand",
    "target_distance_m": "(S, F, P) float16 the same distance as the contact model requests it; infinite: no such hand",
}


# Bars over the time of the motion: name, colour, and per bar its start and width in percent and its label.
Strip = tuple[str, str, list[tuple[float, float, str]]]


def write_hands(
    out_dir: str | Path,
    motions: Sequence[SampledHands],
    hands: HandPair,
    steps: Sequence[PathStep],
    made_from: Mapping[str, str],
    facts: Sequence[tuple[str, str]],
    verdicts: Sequence[Sequence[Check]],
    notes: Sequence[str] = (),
) -> list[Path]:
    """Write the files of ``write_motions``; returns their paths. ``made_from``: digests of the networks by file."""
    first, files = motions[0], []
    for motion in motions:
        arrays, paint = hands_arrays(motion, hands, made_from), _paint(motion, motion.reached_m.min(axis=(0, 1)))
        files.append(MotionFiles(motion.clip, arrays, paint, checkpoints=made_from, number=motion.number))
    names = [f"sample {motion.number + 1}" for motion in motions]
    length = f"{first.clip.n_frames} frames, {first.clip.n_frames / FPS:.2f} s at {FPS} fps"
    digests = ", ".join(f"{Path(path).parent.name} {digest[:12]}" for path, digest in made_from.items())
    return motion_files.write_motions(
        Path(out_dir),
        "hands.html",
        files,
        hands,
        ARRAYS,
        "the least distance of the hands",
        title=f"Hands for {first.clip.object_words}",
        notes=list(notes),
        verdicts=[(name, summary(one), one) for name, one in zip(names, verdicts, strict=True)],
        touch_mm=round(1000 * TOUCH_M),
        fades_cm=round(100 * FADES_M),
        motions=[_shown(motion, hands, steps) for motion in motions],
        facts=[*facts, ("length", length), ("hand model", hands.name), ("sha256", digests)],
    )


def hands_arrays(motion: SampledHands, hands: HandPair, made_from: Mapping[str, str]) -> dict[str, np.ndarray]:
    """The arrays of motion.npz (``ARRAYS``)."""
    touching = motion.standing.touching
    nothing = np.zeros(motion.clip.n_frames, bool)
    return {
        "checkpoints": np.array(canonical_json(dict(made_from))),
        "seed": np.array(motion.seed),
        **motion_files.motion_arrays(motion.clip, hands),
        **motion_files.mesh_arrays(motion.clip.object.model),
        "before_joints_m": motion_files.clip_joints_m(motion.before, hands),
        "touching": np.stack([touching.get(side, nothing) for side in SIDES]),
        "contact_points_m": motion.points.points_m,
        "contact_part": motion.points.part,
        "contact_distance_m": motion.reached_m.astype(np.float16),
        "target_distance_m": motion.target_m,
    }


def _shown(motion: SampledHands, hands: HandPair, steps: Sequence[PathStep]) -> dict[str, Any]:
    """The content of the page for one motion."""
    caption = f"sample {motion.number + 1}"
    title = f"{caption}: hands for {motion.clip.object_words}"
    paint, words = _paint(motion, motion.reached_m.min(axis=(0, 1))), f"a hand comes within {100 * FADES_M:.0f} cm"
    return {
        "caption": caption,
        "player": motion_player(simplified_for_page(motion.clip), hands, title, caption, paint, words),
        "before": motion_player(simplified_for_page(motion.before), hands, f"{title}, before refinement", caption),
        "strips": _strips(motion, steps),
        "maps": [_map(motion, side, title) for side in motion.standing.touching],
        "measures": _measures(motion.unrefined_measures, motion.standing),
    }


def _map(motion: SampledHands, side: Side, title: str) -> tuple[Player, Player, str, list[Player]]:
    """Players of the target and the generated contact map of one hand, their agreement in words, and target maps."""
    side_index = SIDES.index(side)
    target_m, reached_m = motion.target_m[side_index].min(axis=0), motion.reached_m[side_index].min(axis=0)
    still = simplified_for_page(motion.clip, FACES_OF_STILLS)
    paints = {"target": _paint(motion, target_m), "generated": _paint(motion, reached_m)}
    first, second = (
        contact_player(still, paint, f"{title}, {side} hand, {name}", f"{side} hand, {name}", name, paints["generated"])
        for name, paint in paints.items()
    )
    over_time, side_title = [], f"{title}, {side} hand"
    for frame in np.linspace(0, motion.clip.n_frames - 1, MAPS_OVER_TIME).round().astype(int).tolist():
        paint, words = _paint(motion, motion.target_m[side_index, frame]), f"{frame / FPS:.2f} s"
        posed = still.take(slice(frame, frame + 1))
        over_time.append(contact_player(posed, paint, f"{side_title}, {words}", words, "target", paints["target"]))
    near = target_m < FADES_M
    if not near.any():
        return first, second, f"{side} hand: no target contact", over_time
    error_cm = 100 * np.abs(target_m - reached_m)[near].mean()
    percent = 100 * (reached_m[near] < FADES_M).mean()
    words = f"{near.sum()} target points within {100 * FADES_M:.0f} cm, {percent:.0f} % reached"
    return first, second, f"{side} hand: {words}; distances differ by {error_cm:.1f} cm on average", over_time


def _paint(motion: SampledHands, distance_m: np.ndarray) -> ContactPaint:
    """1 where a hand touches, fading to 0 at a distance of 2 cm; distance_m: (point,)."""
    value = np.clip((FADES_M - distance_m) / (FADES_M - TOUCH_M), 0, 1)
    return ContactPaint(motion.points.points_m, motion.points.part, value)


def _strips(motion: SampledHands, steps: Sequence[PathStep]) -> list[Strip]:
    frames = motion.clip.n_frames
    end_s = (frames - 1) / FPS
    strips = [
        (f"{side} hand touches", css_colour(HAND_COLOURS[side]), _runs(touching))
        for side, touching in motion.standing.touching.items()
    ]
    if motion.standing.deepest_m is not None:
        strips.append(("deeper than 5 mm", "#b5371f", _runs(motion.standing.deepest_m > 0.005)))
    bars = [(100 * step.start_s / end_s, 100 * (step.end_s - step.start_s) / end_s, step.words) for step in steps]
    return [("object", "#d6d4cc", bars), *strips] if bars else strips


def _runs(mask: np.ndarray) -> list[tuple[float, float, str]]:
    """Start and width in percent, and the time in words, of each interval in which ``mask`` (frame,) is true."""
    return [
        (100 * start / len(mask), 100 * (stop - start) / len(mask), f"{start / FPS:.2f} to {stop / FPS:.2f} s")
        for start, stop in runs(mask)
    ]


def _measures(before: ContactMeasures, after: ContactMeasures) -> list[tuple[str, ...]]:
    """(name, before, after) of contact, depth and acceleration."""
    both, measures = (before, after), list[tuple[str, ...]]()
    for side in after.touching:
        shares = (f"{100 * contact.touching[side].mean():.0f} % of frames" for contact in both)
        measures.append((f"{side} hand touches", *shares))
    depths = [contact.deepest_m for contact in both]
    for name, words in (
        ("deepest vertex", lambda depth_m: f"{1000 * depth_m.max():.1f} mm"),
        ("frames deeper than 1 cm", lambda depth_m: f"{100 * (depth_m > 0.01).mean():.0f} %"),
    ):
        measures.append((name, *(f"not measured: {NO_INSIDE.reason}" if d is None else words(d) for d in depths)))
    measures.append(("mean acceleration", *(f"{contact.acceleration_m_s2:.2f} m/s²" for contact in both)))
    return measures
