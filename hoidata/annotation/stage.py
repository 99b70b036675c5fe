"""Stage annotate: hand type, sentences and text features of every clip.

The folder it writes is described in ``hoidata.store.annotated``.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa

from hoidata.annotation.derived import derive_verb
from hoidata.annotation.encoders import TextEncoder, load_encoder
from hoidata.annotation.sentences import FORMS, english_sentences, reference_sentences
from hoidata.annotation.settings import AnnotationSettings
from hoidata.clips import SIDES, Clip, HandType, Side
from hoidata.contact.maps import find_active_hands
from hoidata.contact.proximity import ProximityIndex
from hoidata.contact.settings import ContactSettings
from hoidata.contact.stage import sample_objects
from hoidata.errors import BadInput
from hoidata.files import atomic_folder, canonical_json
from hoidata.files.arrays import write_npz
from hoidata.files.written import write_table
from hoidata.hands import HandPair
from hoidata.store.hand_evidence import HandEvidence, write_hand_distances
from hoidata.store.store import Store, open_store

VerbSource = Literal["source", "derived"]
HandSource = Literal["proximity", "annotated"]
_TEXT = pa.string()
TEXT_TABLE = pa.schema([("clip_id", _TEXT), ("form", _TEXT), ("sentence", _TEXT), ("text_row", pa.int32())])
HAND_TYPE_TABLE = pa.schema([
    ("clip_id", _TEXT), ("hand_type", _TEXT), ("source", _TEXT), ("min_left_m", pa.float64()),
    ("min_right_m", pa.float64()), ("labelled_hand", _TEXT), ("agreement", pa.bool_()), ("reason", _TEXT),
    ("verb", _TEXT), ("verb_source", _TEXT), ("verb_evidence", _TEXT),
])  # fmt: skip


class _Verb(NamedTuple):
    """The verb of a clip."""

    base: str | None  # None: the sentences say "move"
    source: VerbSource | None
    evidence: str | None = None


class _Hand(NamedTuple):
    """The hand type of a clip; None, without a source, if no hand is close to the object."""

    active: HandType | None
    source: HandSource | None


@dataclass(frozen=True)
class _Annotated:
    """The annotation of one clip."""

    clip_id: str
    labelled_hand: HandType | None
    hand: _Hand
    evidence: HandEvidence
    sentences: tuple[str, ...] | None
    reason: str | None  # why the clip is excluded, without sentences
    verb: _Verb


def annotate_store(
    clips_folder: str | Path,
    out_folder: str | Path,
    settings: AnnotationSettings | None = None,
    *,
    contact: ContactSettings | None = None,
    hands: HandPair | None = None,
    excluded: Mapping[str, str] | None = None,
    **changes: Any,
) -> dict[str, int]:
    """Annotate each clip of the store; the folder appears whole or not at all.

    A hand is active if one of its joints is closer than the threshold to a sampled point of the object. With
    ``settings.hand``, the annotator's label decides instead. Clips without an active hand, or without a word for
    their object, have a reason and no sentence.

    Args:
        clips_folder: the store.
        out_folder: folder to write.
        settings: settings of the stage.
        contact: settings of the stage contact, for the sampled points and the default threshold.
        hands: as in ``open_store``.
        excluded: reasons of clips that get no sentence, by clip id.
        changes: fields that replace those of ``settings``.

    Returns the counts of info.json.
    """
    settings, contact = replace(settings or AnnotationSettings(), **changes), contact or ContactSettings()
    threshold_m = contact.threshold_m if settings.threshold_m is None else settings.threshold_m
    encoder = load_encoder(settings.encoder)
    store = open_store(clips_folder, hands)
    annotated = _annotate_clips(store, threshold_m, contact.points, excluded or {}, settings)
    sentences = list(dict.fromkeys(text for item in annotated for text in item.sentences or ()))
    counts = _counts(annotated, sentences)
    info = {"encoder": encoder.identity, "threshold_m": threshold_m, "points": contact.points}
    info |= {"forms": settings.forms, "counts": counts}
    with atomic_folder(out_folder) as partial:
        write_table(partial / "hand_type.parquet", [_hand_row(item) for item in annotated], HAND_TYPE_TABLE)
        write_hand_distances(partial / "hand_distance.npz", [item.evidence for item in annotated])
        write_table(partial / "text.parquet", _text_rows(annotated, sentences), TEXT_TABLE)
        _write_embeddings(partial / "embeddings.npz", encoder, sentences)
        (partial / "info.json").write_text(canonical_json(info) + "\n", encoding="utf-8")
    return counts


def _annotate_clips(
    store: Store, threshold_m: float, points: int, excluded: Mapping[str, str], settings: AnnotationSettings
) -> list[_Annotated]:
    indices = {name: ProximityIndex(cloud) for name, cloud in sample_objects(store, points).items()}
    annotated = []
    for clip_id in store.ids:
        clip = store.clip(clip_id)
        joints: dict[Side, np.ndarray] = {side: store.joints(clip_id, side) for side in SIDES}
        evidence = find_active_hands(clip, joints, indices[clip.object.model.name], threshold_m)
        hand, verb = _hand(clip, evidence, settings), _verb(clip, evidence, settings, store.info)
        sentences, reason = None, excluded.get(clip_id)
        if reason is None:
            sentences, reason = _sentences(verb.base, clip.object_words, hand.active, evidence, settings)
        annotated.append(_Annotated(clip_id, clip.labelled_hand, hand, evidence, sentences, reason, verb))
    return annotated


def _hand(clip: Clip, evidence: HandEvidence, settings: AnnotationSettings) -> _Hand:
    """Return the labelled hand, if the settings prefer it and it is tracked, else the hands close to the object."""
    labelled, close = clip.labelled_hand, evidence.hand_type
    if close is None or labelled is None or settings.hand == "proximity":
        return _Hand(close, close and "proximity")
    tracked = all(clip.hands[side].valid.any() for side in SIDES if labelled in (side, "both"))
    return _Hand(labelled, "annotated") if tracked else _Hand(close, "proximity")


def _verb(clip: Clip, evidence: HandEvidence, settings: AnnotationSettings, info: Mapping[str, Any]) -> _Verb:
    """Return the clip's verb, else the verb derived from the motion, if enabled and a hand is active."""
    if clip.verb is not None:
        return _Verb(clip.verb, "derived" if info.get("derives_verbs") else "source")
    if not settings.derive_verbs or evidence.hand_type is None:
        return _Verb(None, None)
    derived = derive_verb(clip, evidence)
    return _Verb(derived.verb, "derived", derived.evidence)


def _sentences(
    verb: str | None, object_words: str, hand: HandType | None, evidence: HandEvidence, settings: AnnotationSettings
) -> tuple[tuple[str, ...] | None, str | None]:
    """Return the sentences, or None and the reason."""
    if hand is None:
        return None, _no_hand(evidence)
    write = english_sentences if settings.forms == "paper" else reference_sentences
    try:
        return write(verb, object_words, hand), None
    except BadInput as error:
        return None, str(error)


def _hand_row(item: _Annotated) -> dict:
    closest = {side: item.evidence.closest_m(side) for side in SIDES}
    close, labelled = item.evidence.hand_type, item.labelled_hand
    return {
        "clip_id": item.clip_id,
        "hand_type": item.hand.active,
        "source": item.hand.source,
        **{f"min_{side}_m": distance if np.isfinite(distance) else None for side, distance in closest.items()},
        "labelled_hand": labelled,
        "agreement": None if labelled is None else labelled == close,
        "reason": item.reason,
        "verb": item.verb.base,
        "verb_source": item.verb.source,
        "verb_evidence": item.verb.evidence,
    }


def _no_hand(evidence: HandEvidence) -> str:
    nearest = min(evidence.closest_m(side) for side in SIDES)
    if not np.isfinite(nearest):
        return "no hand is valid in any frame"
    return f"no joint within {evidence.threshold_m * 100:g} cm of the object; nearest {nearest * 100:.1f} cm"


def _text_rows(annotated: Sequence[_Annotated], sentences: Sequence[str]) -> list[dict]:
    row_of = {sentence: number for number, sentence in enumerate(sentences)}
    return [
        {"clip_id": item.clip_id, "form": form, "sentence": sentence, "text_row": row_of[sentence]}
        for item in annotated
        if item.sentences
        for form, sentence in zip(FORMS, item.sentences, strict=True)
    ]


def _write_embeddings(path: Path, encoder: TextEncoder, sentences: Sequence[str]) -> None:
    identity = np.frombuffer(canonical_json(encoder.identity).encode(), np.uint8)
    text = np.array(sentences, dtype=np.str_) if sentences else np.zeros(0, "<U1")
    write_npz(path, {"features": encoder.encode(sentences), "sentences": text, "identity": identity})


def _counts(annotated: Sequence[_Annotated], sentences: Sequence[str]) -> dict[str, int]:
    hands = Counter(item.hand.active for item in annotated)
    labelled = [item for item in annotated if item.labelled_hand]
    return {
        "clips": len(annotated),
        "annotated": sum(item.sentences is not None for item in annotated),
        "left_out": sum(item.sentences is None for item in annotated),
        **{hand: hands[hand] for hand in ("left", "right", "both")},
        "sentences": len(sentences),
        "labelled": len(labelled),
        "agreeing": sum(item.labelled_hand == item.evidence.hand_type for item in labelled),
        "derived_verbs": sum(item.verb.source == "derived" for item in annotated),
    }
