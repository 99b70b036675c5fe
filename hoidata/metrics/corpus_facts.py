"""What a corpus can tell: how much of its test part the inputs give away, and how much its clips differ.

Figures of annotated datasets, several of them pooled, for each part of their chosen splits. Nothing is made or
trained: a corpus in which verb and contact follow from object and hand cannot tell a model from a table.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.contact.maps import f1_score
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.metrics.pair import acting_sides
from hoidata.splits.rules import PARTS
from hoidata.store.annotated import AnnotatedStore, load_annotated

FINGERS_DEG = 20.0
IDLE_NEAR_M = 0.10
MANY_VERBS = 3
SAME_REGION = 0.3  # intersection over union
COLUMNS = (*PARTS, "all")


@dataclass(frozen=True)
class CorpusClip:
    """One clip with sentences, as far as the figures look at it.

    part: of the chosen split, None where it is left out. subject, object: with the number of their folder. hand: the
    hand type. text: (D,) feature of the imperative. touched: (point,) bool, by an active hand in any frame.
    free: whether no hand touches the object in the first frame, and in the last. fingers_deg: the largest angle any
    finger joint of an active hand turns by between two frames. idle_m: nearest the other hand comes, infinite where
    there is none or it is never seen. near_hand_differs: the annotator named another hand than those that come near,
    None where none is named.
    """

    clip_id: str
    part: str | None
    subject: Hashable
    verb: str
    object: Hashable
    hinged: bool
    hand: str
    text: np.ndarray
    touched: np.ndarray
    free: tuple[bool, bool]
    fingers_deg: float
    idle_m: float
    near_hand_differs: bool | None

    @property
    def prompt(self) -> Hashable:
        return self.verb, self.object, self.hand


Clips = Sequence[CorpusClip]


@dataclass(frozen=True)
class Figure:
    """One figure of some clips, in words. of: the clips of a part, and those of all parts; None where it says nothing.

    held_out: it compares with training, and says something of validation and test alone.
    """

    name: str
    words: str
    of: Callable[[Clips, Clips], float | None]
    held_out: bool = False

    def value(self, part: str, clips: Clips, every: Clips) -> float | None:
        return None if self.held_out and part not in ("validation", "test") else self.of(clips, every)


def corpus_facts(folders: Sequence[str | Path]) -> dict[str, Any]:
    """Every figure of ``FIGURES``, for each part and for all clips, of some annotated datasets, pooled.

    folders: as ``load_annotated`` opens them. Gives ``folders`` and ``figures``: per name its words, and its value by
    column, None where a figure says nothing of that column.
    """
    every = [clip for number, folder in enumerate(folders) for clip in read_clips(load_annotated(folder), number)]
    parts = {part: [clip for clip in every if part in (clip.part, "all")] for part in COLUMNS}
    figures = {
        figure.name: {
            "words": figure.words,
            **{part: figure.value(part, clips, every) for part, clips in parts.items()},
        }
        for figure in FIGURES
    }
    return {"folders": [str(folder) for folder in folders], "figures": figures}


def read_clips(annotated: AnnotatedStore, folder: int = 0) -> list[CorpusClip]:
    """The clips of a dataset that have sentences. folder: tells its objects from those of others."""
    return [_read_clip(annotated, clip_id, folder) for clip_id in annotated.ids()]


def _read_clip(annotated: AnnotatedStore, clip_id: str, folder: int) -> CorpusClip:
    clip, row = annotated.store.clip(clip_id, motion_only=True), annotated.hand_types.loc[clip_id]
    hand = annotated.hand_type(clip_id)
    active = acting_sides(hand)
    evidence = annotated.hand_evidence(clip_id, annotated.contact_threshold_m)
    near = np.any([evidence.near(side) for side in SIDES], axis=0)
    return CorpusClip(
        clip_id=clip_id,
        part=annotated.splits[clip_id],
        subject=(folder, clip.subject),
        verb=row["verb"] if isinstance(row["verb"], str) else "no verb",
        object=(folder, annotated.object_key(clip_id)),
        hinged=clip.object.hinge_rad is not None,
        hand=hand,
        text=annotated.text_embedding(clip_id)[0],
        touched=np.any([annotated.contact_of(clip_id, side) for side in active], axis=0),
        free=(not near[0], not near[-1]),
        fingers_deg=fingers_turned_deg(clip, active),
        idle_m=min((evidence.closest_m(side) for side in SIDES if side not in active), default=np.inf),
        near_hand_differs=None if clip.labelled_hand is None else not row["agreement"],
    )


def fingers_turned_deg(clip: Clip, sides: Iterable[Side]) -> float:
    """The largest angle between two frames' rotations of one finger joint of these hands, degrees."""
    cosine = 1.0
    for side in sides:
        track = clip.hands[side]
        pose = track.hand_pose[track.valid].astype(np.float64).reshape(-1, 15, 3)
        for joint in rotvec_to_rotmat(pose).reshape(-1, 15, 9).swapaxes(0, 1):
            cosine = min(cosine, ((joint @ joint.T).min(initial=3.0) - 1) / 2)
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))


def _distinct(of: Callable[[CorpusClip], Hashable]) -> Callable[[Clips, Clips], float]:
    return lambda clips, _: len({of(clip) for clip in clips})


def _share(holds: Callable[[CorpusClip], bool | None]) -> Callable[[Clips, Clips], float | None]:
    """Share of the clips of which it can be said (not None) that it holds."""
    return lambda clips, _: _mean([found for clip in clips if (found := holds(clip)) is not None])


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _shared_subjects(clips: Clips, every: Clips) -> float:
    parts: dict[Hashable, set[str]] = defaultdict(set)
    for clip in every:
        parts[clip.subject] |= {clip.part} if clip.part else set()
    return len({clip.subject for clip in clips if len(parts[clip.subject]) > 1})


def _median_fingers(clips: Clips, every: Clips) -> float | None:
    return float(np.median([clip.fingers_deg for clip in clips])) if clips else None


Condition = Callable[[CorpusClip], Hashable]
NOTHING: Condition = lambda clip: ()  # noqa: E731
OF_OBJECT: Condition = lambda clip: clip.object  # noqa: E731
OF_HAND: Condition = lambda clip: clip.hand  # noqa: E731
OF_BOTH: Condition = lambda clip: (clip.object, clip.hand)  # noqa: E731
GIVEN: Mapping[str, tuple[str, Sequence[Condition]]] = {
    "nothing": ("nothing", (NOTHING,)),
    "object": ("the object", (OF_OBJECT, NOTHING)),
    "hand": ("the hand type", (OF_HAND, NOTHING)),
    "object_hand": ("object and hand type", (OF_BOTH, OF_OBJECT, NOTHING)),
}


def _majority(clips: Clips, every: Clips, conditions: Sequence[Condition], top: int) -> float | None:
    """Share of clips whose verb is among the ``top`` most frequent of training under the same condition.

    conditions: what is known; then what decides where training has not seen that, or two verbs as often.
    """
    train = [clip for clip in every if clip.part == "train"]
    counts = [Counter((condition(clip), clip.verb) for clip in train) for condition in conditions]
    verbs = sorted({clip.verb for clip in train})

    def right(clip: CorpusClip) -> bool:
        known = [condition(clip) for condition in conditions]
        ranked = sorted(verbs, key=lambda verb: [-count[key, verb] for count, key in zip(counts, known, strict=True)])
        return clip.verb in ranked[:top]

    return _mean([right(clip) for clip in clips])


def _lookup_f1(clips: Clips, every: Clips, pooled: bool) -> float | None:
    """Mean F1 of the contact map of the training clips of the same prompt against the clip's own.

    Several such clips count by the mean of their F1; or pooled, by the points half of them touch. Without one, the
    clip of the same object with the nearest sentence (cosine) is taken; without a clip of the object the map is empty:
    points of two objects do not correspond.
    """
    train: dict[Hashable, list[CorpusClip]] = defaultdict(list)
    for clip in every:
        if clip.part == "train":
            train[clip.prompt].append(clip)
            train[clip.object].append(clip)

    def found(clip: CorpusClip) -> list[np.ndarray]:
        same = train.get(clip.prompt)
        others = same or sorted(train.get(clip.object, ()), key=lambda other: -_cosine(clip.text, other.text))[:1]
        maps = [other.touched for other in others]
        return [np.mean(maps, axis=0) >= 0.5] if pooled and maps else maps

    return _mean([_mean([f1_score(made, clip.touched) for made in found(clip)]) or 0.0 for clip in clips])


def _same_prompt(clips: Clips, every: Clips) -> float | None:
    trained = {clip.prompt for clip in every if clip.part == "train"}
    return _mean([clip.prompt in trained for clip in clips])


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12))


def _verbs_of(clips: Clips, condition: Condition) -> list[int]:
    """How many verbs each value of a condition occurs with."""
    pairs = {(condition(clip), clip.verb) for clip in clips}
    return list(Counter(value for value, _ in pairs).values())


def _many_verbs(clips: Clips, every: Clips, condition: Condition) -> float | None:
    return _mean([count >= MANY_VERBS for count in _verbs_of(clips, condition)])


def _mean_verbs(clips: Clips, every: Clips) -> float | None:
    return _mean(_verbs_of(clips, OF_OBJECT))


def _regions_of_prompts(clips: Clips) -> list[int]:
    """Regions of every prompt with two clips or more."""
    maps: dict[Hashable, list[np.ndarray]] = defaultdict(list)
    for clip in clips:
        maps[clip.prompt].append(clip.touched)
    return [regions(np.stack(touched)) for touched in maps.values() if len(touched) > 1]


def regions(touched: np.ndarray) -> int:
    """How many regions contact maps (clip, point) fall into: one holds whatever a chain of similar maps joins.

    Two maps are similar from an intersection over union of ``SAME_REGION`` on; empty ones are.
    """
    maps = touched.astype(np.float64)
    both, size = maps @ maps.T, maps.sum(axis=1)
    either = size[:, None] + size[None] - both
    return int(connected_components(both >= SAME_REGION * either, directed=False)[0])


FIGURES = (
    Figure("clips", "clips", lambda clips, _: len(clips)),
    Figure("verbs", "verbs", _distinct(lambda clip: clip.verb)),
    Figure("objects", "objects", _distinct(OF_OBJECT)),
    Figure("hinged_objects", "of them with a hinge", lambda clips, _: len({c.object for c in clips if c.hinged})),
    Figure("subjects", "subjects", _distinct(lambda clip: clip.subject)),
    Figure("shared_subjects", "of them in more than one part", _shared_subjects),
    *(
        Figure(
            f"majority_{name}_top{top}",
            f"verb among the {top} most frequent in training, given {words}" if top > 1
            else f"verb right by the most frequent in training, given {words}",
            partial(_majority, conditions=conditions, top=top),
            held_out=True,
        )
        for name, (words, conditions) in GIVEN.items() for top in (1, 3)
    ),
    Figure("same_prompt", "a training clip has the same verb, object and hand type", _same_prompt, held_out=True),
    Figure("lookup_contact_f1", "contact F1 of a training clip of the same prompt",
           partial(_lookup_f1, pooled=False), held_out=True),
    Figure("lookup_contact_f1_pooled", "contact F1 of what half of the training clips of the same prompt touch",
           partial(_lookup_f1, pooled=True), held_out=True),
    Figure("free_first", "no hand touches the object in the first frame", _share(lambda clip: clip.free[0])),
    Figure("free_last", "no hand touches the object in the last frame", _share(lambda clip: clip.free[1])),
    Figure("free_both", "neither in the first nor in the last", _share(lambda clip: all(clip.free))),
    Figure("fingers_median_deg", "median degrees that a clip's fingers turn by", _median_fingers),
    Figure("fingers_moved", f"they turn by {FINGERS_DEG:g} degrees or more",
           _share(lambda clip: clip.fingers_deg >= FINGERS_DEG)),
    Figure("verbs_per_object", "verbs of an object, mean", _mean_verbs),
    Figure("objects_many_verbs", f"objects with {MANY_VERBS} verbs or more", partial(_many_verbs, condition=OF_OBJECT)),
    Figure("object_hands_many_verbs", f"pairs of object and hand type with {MANY_VERBS} verbs or more",
           partial(_many_verbs, condition=OF_BOTH)),
    Figure("idle_near", f"an idle hand comes within {IDLE_NEAR_M * 100:g} cm of the object",
           _share(lambda clip: clip.idle_m < IDLE_NEAR_M)),
    Figure("prompts_of_two_clips", "prompts (verb, object, hand type) with two clips or more",
           lambda clips, _: len(_regions_of_prompts(clips))),
    Figure("prompts_two_regions", "such prompts that touch two regions of the object or more",
           lambda clips, _: _mean([count > 1 for count in _regions_of_prompts(clips)])),
    Figure("annotated_hand_differs", "the annotator names another hand than those that come near",
           _share(lambda clip: clip.near_hand_differs)),
)  # fmt: skip
