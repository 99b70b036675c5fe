"""The page of one clip: self-contained HTML with the motion, contact, curves, sentences, evidence and provenance."""

import base64
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.hands import HandPair
from hoidata.objects.sampling import SampledPoints
from hoidata.store.annotated import AnnotatedStore
from hoidata.surface.measure import REACH_M, STEP_M, packed_map
from pipelines.pages import clip_page_facts as content
from pipelines.pages.clip_page_timeline import BOTH_COLOUR, SIDE_COLOURS, clip_charts, draw_timeline
from pipelines.pages.examples import true_contact
from pipelines.pages.player import Player, contact_player, motion_player, write_page
from pipelines.pages.surface import ContactPaint

# From near to far, as in BimArt (Fig. 9): red where the hand is close, blue at 20 cm.
DISTANCE_COLOURS = ("#b5241c", "#efb35b", "#f3efdd", "#7fb0d0", "#2a5f96")
PAINT_COLOURS = {**SIDE_COLOURS, "both": BOTH_COLOUR}


def page_name(clip_id: str) -> str:
    """File name of a clip's page: ``grab/s1/mug_drink_1`` becomes ``grab_s1_mug_drink_1.html``."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", clip_id) + ".html"


def write_clip_page(path: str | Path, annotated: AnnotatedStore, clip_id: str, hands: HandPair) -> Path:
    """Write the page of one clip; equal inputs give equal bytes.

    Raises MissingResource without the output of quality control next to the dataset; the message names its stage.
    """
    clip = annotated.clip(clip_id)
    quality = content.clip_quality(annotated.root / "quality", clip_id)
    series = content.measure_clip(annotated, clip, hands)
    points = annotated.points(annotated.object_key(clip_id))
    sides: list[Side] = [side for side in SIDES if clip.hands[side].valid.any()]
    has_sentences = clip_id in annotated.ids()
    without = f"{annotated.verb(clip_id) or 'move'}: {clip.object_words}"
    title = annotated.sentences(clip_id)[0] if has_sentences else without
    return write_page(
        path,
        "clip_page.html",
        title=title,
        synthetic=clip.synthetic,
        clip_id=clip_id,
        player=replace(motion_player(clip, hands, title, contact=true_contact(annotated, clip_id)), contact_label=""),
        paint=paint_values(clip, points, series.touched, {side: series.surface[side].map_m for side in sides}),
        paint_colours=PAINT_COLOURS,
        distance_colours=DISTANCE_COLOURS,
        reach_cm=REACH_M * 100,
        threshold_cm=annotated.contact_threshold_m * 100,
        timeline=draw_timeline(clip_charts(series, sides, len(points)), clip_id),
        no_depth=series.depth_m is None,
        maps=_still_maps(clip, series, points),
        sentences=content.sentence_rows(annotated, clip_id),
        left_out="" if has_sentences else str(annotated.hand_types.at[clip_id, "reason"]),
        hands=content.hand_decision(annotated, clip, series),
        quality=quality,
        splits=content.split_rows(annotated, clip_id),
        facts=content.clip_facts(annotated, clip, hands),
        files=[(source.path, f"{source.size:,}", source.sha256) for source in clip.sources],
        has_players=True,
        script=(Path(__file__).parent / "clip_page.js").read_text(encoding="utf-8"),
    )


def paint_values(
    clip: Clip, points: SampledPoints, touched: Mapping[Side, np.ndarray], maps: Mapping[Side, np.ndarray]
) -> dict:
    """The data from which clip_page.js paints the contact map of any frame, as a JSON object.

    Args:
        touched: per side (frame, point) bool.
        maps: per side BimArt's distance map (frame, point), metres.

    Returns:
        - parts: per object part, the name of its node in the GLB, its sampled points in mesh coordinates in 0.1 mm (the
          mesh of the moving part starts at the hinge), and their indices among all points
        - left, right: touched points per frame, packed bits in base64, first point in the highest bit
        - stride, frames, points: bytes per frame, and the sizes of these arrays
        - distances: per side, the packed distance map in base64; farthest: the largest packed distance
    """
    model = clip.object.model
    parts = []
    for part in model.parts:
        numbers = np.flatnonzero(points.part == part)
        origin = model.hinge.origin_m if part == 1 and model.hinge is not None else np.zeros(3)
        local = np.round((points.points_m[numbers] - origin) * 1e4).astype(int)
        mesh = f"{model.name} {'base' if part == 0 else 'part'} mesh"
        parts.append({"mesh": mesh, "numbers": numbers.tolist(), "tenth_mm": local.reshape(-1).tolist()})
    bits = {side: np.packbits(touched[side], axis=1) for side in SIDES}
    distances = {side: _base64(packed_map(map_m)) for side, map_m in maps.items()}
    return {
        **{"parts": parts, "stride": int(bits["left"].shape[1]), "frames": clip.n_frames, "points": len(points)},
        **{"farthest": round(REACH_M / STEP_M), "distances": distances},
        **{side: _base64(packed) for side, packed in bits.items()},
    }


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")


def _still_maps(clip: Clip, series: content.ClipSeries, points: SampledPoints) -> list[Player]:
    """Per touching hand, a player of the object, coloured by the fraction of the hand's contact frames per point."""
    players = []
    for side in SIDES:
        touching = int(series.touched[side].any(axis=1).sum())
        if not touching:
            continue
        fraction = series.touched[side].sum(axis=0) / touching
        paint, n_points = ContactPaint(points.points_m, points.part, fraction), int((fraction > 0).sum())
        caption = f"{side} hand, {n_points:,} points, in contact in {touching} of {clip.n_frames} frames"
        players.append(contact_player(clip, paint, caption, caption, "fraction of these frames, 0 to 1"))
    return players
