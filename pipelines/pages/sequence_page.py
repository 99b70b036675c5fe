"""One recorded sequence with the clips cut from it: words, hands, hinge and height over the frames of the source."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from hoidata.clips.clip import SIDES, Clip
from hoidata.store.annotated import AnnotatedStore
from pipelines.pages.clip_page_timeline import OBJECT_COLOUR, SIDE_COLOURS
from pipelines.pages.curves import figure_svg
from pipelines.pages.player import write_page

_BANDS = ("#dfe7ee", "#f1e7da")  # neighbouring clips alternate
_INCHES_PER_FRAME, _HEIGHT_INCHES, _MIN_INCHES = 0.018, 4.4, 9.0


class _SequenceClip(NamedTuple):
    clip: Clip
    sentence: str  # or the reason why the clip has none
    verb: str
    hand_type: str


def write_sequence_page(path: str | Path, annotated: AnnotatedStore, sequence: str) -> Path:
    """Write the page of a sequence such as ``s01/box_use_01`` with at least one clip; equal inputs give equal bytes."""
    sequences = annotated.store.sequences["sequence"].to_dict()
    clips = [_described(annotated, str(clip_id)) for clip_id, name in sequences.items() if name == sequence]
    clips.sort(key=lambda item: int(item.clip.source_frames[0]))
    rows = []
    for item in clips:
        frames = f"{item.clip.source_frames[0]} to {item.clip.source_frames[-1]}"
        rows.append((item.clip.clip_id, frames, item.verb, item.hand_type, item.sentence))
    return write_page(
        path,
        "sequence_page.html",
        title=f"{annotated.store.info['dataset']}/{sequence}",
        synthetic=clips[0].clip.synthetic,
        timeline=Markup(_timeline(annotated, clips)),
        rows=rows,
        threshold_cm=annotated.contact_threshold_m * 100,
        has_players=False,
    )


def _described(annotated: AnnotatedStore, clip_id: str) -> _SequenceClip:
    row = annotated.hand_types.to_dict("index")[clip_id]
    has_words = clip_id in annotated.ids()
    sentence = annotated.sentences(clip_id)[0] if has_words else f"no sentence: {row['reason']}"
    return _SequenceClip(annotated.clip(clip_id), sentence, str(row["verb"] or "move"), str(row["hand_type"] or "none"))


def _timeline(annotated: AnnotatedStore, clips: list[_SequenceClip]) -> str:
    """Bands of clips with their words above; below them hinge angle, height and frames near each hand."""
    last = max(int(item.clip.source_frames[-1]) for item in clips)
    hinge = clips[0].clip.object.model.hinge
    has_hinge = hinge is not None
    unit, factor = ("slide, cm", 100.0) if hinge and hinge.is_prismatic else ("hinge, degrees", np.degrees(1.0))

    def draw(figure: Figure) -> None:
        rows = figure.subplots(3 if has_hinge else 2, 1, sharex=True, height_ratios=[2] * (1 + has_hinge) + [1])
        near = rows[-1]
        for number, item in enumerate(clips):
            frames = item.clip.source_frames
            for axes in rows:
                axes.axvspan(frames[0], frames[-1] + 1, color=_BANDS[number % 2], linewidth=0)
            rows[0].text(
                frames[0] + 2, 1.03, f"{item.verb}, {item.hand_type}", rotation=35, fontsize=7.5,
                transform=rows[0].get_xaxis_transform(),
            )  # fmt: skip
            if (hinge_rad := item.clip.object.hinge_rad) is not None:
                rows[-2].plot(frames, factor * hinge_rad, color=OBJECT_COLOUR, linewidth=1.4)
            rows[0].plot(frames, _height_cm(item.clip, clips[0].clip), color=OBJECT_COLOUR, linewidth=1.4)
            evidence = annotated.hand_evidence(item.clip.clip_id)
            for line, side in enumerate(SIDES):
                is_near, colour = evidence.near(side), SIDE_COLOURS[side]
                near.fill_between(frames, line, line + 0.8, where=is_near, color=colour, linewidth=0)
        rows[0].set_ylabel("height, cm")
        if has_hinge:
            rows[-2].set_ylabel(unit)
        near.set_yticks([0.4, 1.4], [f"{side} hand" for side in SIDES])
        near.set_xlabel("frame of the recording")
        near.set_xlim(0, last + 1)

    inches = max(_MIN_INCHES, _INCHES_PER_FRAME * last), _HEIGHT_INCHES
    return figure_svg(inches, clips[0].clip.sequence, draw, left=0.9, top=0.9)


def _height_cm(clip: Clip, first: Clip) -> np.ndarray:
    """(frame,) of the object's origin above its first position of the sequence; along z if gravity is unknown."""
    down = np.array([0.0, 0.0, -1.0]) if clip.gravity is None else np.asarray(clip.gravity)
    return -100 * (clip.object.translation_m - first.object.translation_m[0]) @ down
