"""Stage annotate: hand type, sentences and text features of every clip.

The folder it writes is described in ``hoidata.store.annotated``.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
import pyarrow as pa

from hoidata.annotation.clip_variations import (
    ClipVariations,
    VariationSettings,
    Wording,
    clip_variations,
    hand_speed_m_s,
)
from hoidata.annotation.derived import derive_verb
from hoidata.annotation.encoders import TextEncoder, load_encoder
from hoidata.annotation.feature_cache import DiskCachedEncoder
from hoidata.annotation.hand_distances import write_hand_distances
from hoidata.annotation.reference_mode import reference_sentences
from hoidata.annotation.sentences import FORMS, FourSentences, four_sentences
from hoidata.clips import SIDES, Clip, HandType, Side
from hoidata.contact import CONTACT_THRESHOLD_M, HandEvidence, ProximityIndex, acting_hands
from hoidata.contact.stage import sample_objects
from hoidata.errors import BadInput
from hoidata.files import atomic_folder, canonical_json
from hoidata.files.arrays import write_npz
from hoidata.files.tables import write_table
from hoidata.hands import HandPair
from hoidata.objects.sampling import POINT_COUNT
from hoidata.store.annotated import VARIATION
from hoidata.store.store import Store, open_store

Forms = Literal["paper", "reference"]
VerbSource = Literal["source", "derived"]
HAND_TYPE_SOURCE = "proximity"
_TEXT = pa.string()
TEXT_TABLE = pa.schema([("clip_id", _TEXT), ("form", _TEXT), ("sentence", _TEXT), ("text_row", pa.int32())])
HAND_TYPE_TABLE = pa.schema(
    [
        ("clip_id", _TEXT),
        ("hand_type", _TEXT),
        ("source", _TEXT),
        ("min_left_m", pa.float64()),
        ("min_right_m", pa.float64()),
        ("labelled_hand", _TEXT),
        ("agreement", pa.bool_()),
        ("reason", _TEXT),
        ("verb", _TEXT),
        ("verb_source", _TEXT),
        ("verb_evidence", _TEXT),
    ]
)


class _Verb(NamedTuple):
    """base: None for a clip without a verb, whose sentences say "move". source: where it is from, None without one."""

    base: str | None
    source: VerbSource | None
    evidence: str | None = None


@dataclass(frozen=True)
class _Annotated:
    """One clip's result; without sentences, ``reason`` says why the clip is left out."""

    clip_id: str
    labelled_hand: HandType | None
    evidence: HandEvidence
    sentences: FourSentences | None
    reason: str | None
    verb: _Verb
    wording: Wording | None = None


def annotate_store(
    clips_folder: str | Path,
    out_folder: str | Path,
    *,
    encoder: str | TextEncoder = "use",
    threshold_m: float = CONTACT_THRESHOLD_M,
    points: int = POINT_COUNT,
    hands: HandPair | None = None,
    left_out: Mapping[str, str] | None = None,
    forms: Forms = "paper",
    variations: VariationSettings | None = None,
    features: str | Path | None = None,
    derive_verbs: bool = True,
) -> dict[str, int]:
    """Annotate every clip of the store; the folder appears whole or not at all.

    encoder: a name for ``load_encoder``, or the encoder itself. features: a folder that keeps text features between
    runs (``DiskCachedEncoder``); it changes no output.
    threshold_m: a hand acts when one of its joints comes closer to one of ``points`` sampled points.
    hands: as in ``open_store``. Clips without an acting hand, or without a word for their object, are listed with that
    reason and get no sentence. left_out: the same for further clips: reasons by clip id, as quality control found them.
    forms: the paper's four sentences as we write them, or as the reference does. variations: how many guarded
    sentences follow those of each clip, by default none. Raises BadInput for other forms, and for a threshold that
    is no length.
    derive_verbs: a clip whose source names no verb gets the one its motion shows (``derive_verb``), marked as derived
    with what it rests on; else its sentences say "move".
    Returns counts: clips, annotated, left_out; by hand type left, right, both; sentences (distinct), labelled,
    agreeing, derived_verbs.
    """
    if forms not in get_args(Forms):
        raise BadInput("forms of the sentences", " or ".join(get_args(Forms)), repr(forms), "choose one of them")
    if not threshold_m > 0:
        raise BadInput("threshold_m", "metres above 0", repr(threshold_m), "give a length such as 0.02")
    store = open_store(clips_folder, hands)
    encoder = load_encoder(encoder) if isinstance(encoder, str) else encoder
    encoder = encoder if features is None else DiskCachedEncoder(encoder, features)
    variations = variations or VariationSettings()
    measured = variations.per_clip > 0 and variations.adverbs
    found = _annotate_clips(store, threshold_m, points, left_out or {}, _Writer(forms, measured, derive_verbs))
    named = [item for item in found if item.wording]
    varied = clip_variations([item.wording for item in named if item.wording], variations)
    sentences = _distinct(named, varied)
    counts = _counts(found, sentences)
    info = {
        "encoder": encoder.identity,
        "threshold_m": threshold_m,
        "points": points,
        "forms": forms,
        "variations": {**asdict(variations), **varied.facts()},
        "counts": counts,
    }
    with atomic_folder(out_folder) as partial:
        write_table(partial / "hand_type.parquet", [_hand_row(item) for item in found], HAND_TYPE_TABLE)
        write_hand_distances(partial / "hand_distance.npz", [item.evidence for item in found])
        write_table(partial / "text.parquet", _text_rows(named, varied, sentences), TEXT_TABLE)
        _write_embeddings(partial / "embeddings.npz", encoder, sentences)
        (partial / "info.json").write_text(canonical_json(info) + "\n", encoding="utf-8")
    return counts


@dataclass(frozen=True)
class _Writer:
    """How clips are put into words. measured: whether speeds are wanted. derive: verbs from motion where none is."""

    forms: Forms
    measured: bool
    derive: bool

    def verb(self, clip: Clip, evidence: HandEvidence) -> _Verb:
        """The clip's own verb, else the one its motion shows, if wanted and if a hand acts."""
        if clip.verb is not None:
            return _Verb(clip.verb, "source")
        if not self.derive or evidence.hand_type is None:
            return _Verb(None, None)
        derived = derive_verb(clip, evidence)
        return _Verb(derived.verb, "derived", derived.evidence)

    def sentences(self, clip: Clip, evidence: HandEvidence) -> tuple[FourSentences | None, str | None]:
        """The clip's sentences, or None and the reason."""
        if evidence.hand_type is None:
            return None, _no_hand(evidence)
        write = four_sentences if self.forms == "paper" else reference_sentences
        try:
            return write(clip.verb, clip.object_words, evidence.hand_type), None
        except BadInput as error:
            return None, str(error)

    def wording(
        self, clip: Clip, hand: HandType | None, taken: FourSentences | None, joints: Mapping[Side, np.ndarray]
    ) -> Wording | None:
        """What variations of the clip's sentences may say; None for a clip without sentences."""
        if hand is None or taken is None:
            return None
        acting: list[Side] = [side for side in SIDES if hand in (side, "both")]
        valid = {side: clip.hands[side].valid for side in acting}
        speed = hand_speed_m_s({side: joints[side] for side in acting}, valid) if self.measured else None
        return Wording(clip.clip_id, clip.verb, clip.object_words, hand, speed, taken)


def _annotate_clips(
    store: Store, threshold_m: float, points: int, left_out: Mapping[str, str], writer: _Writer
) -> list[_Annotated]:
    indices = {name: ProximityIndex(cloud) for name, cloud in sample_objects(store, points).items()}
    found = []
    for clip_id in store.ids:
        clip = store.clip(clip_id)
        joints: dict[Side, np.ndarray] = {side: store.joints(clip_id, side) for side in SIDES}
        evidence = acting_hands(clip, joints, indices[clip.object.model.name], threshold_m)
        verb = writer.verb(clip, evidence)
        clip = replace(clip, verb=verb.base)
        words = (None, left_out[clip_id]) if clip_id in left_out else writer.sentences(clip, evidence)
        wording = writer.wording(clip, evidence.hand_type, words[0], joints)
        found.append(_Annotated(clip_id, clip.labelled_hand, evidence, *words, verb, wording))
    return found


def _hand_row(item: _Annotated) -> dict:
    closest = {side: item.evidence.closest_m(side) for side in SIDES}
    found, labelled = item.evidence.hand_type, item.labelled_hand
    return {
        "clip_id": item.clip_id,
        "hand_type": found,
        "source": HAND_TYPE_SOURCE if found else None,
        **{f"min_{side}_m": distance if np.isfinite(distance) else None for side, distance in closest.items()},
        "labelled_hand": labelled,
        "agreement": None if labelled is None else labelled == found,
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


def _distinct(named: Sequence[_Annotated], varied: ClipVariations) -> list[str]:
    """Every sentence once; those of the four forms first, whatever variations there are."""
    formal = (text for item in named for text in item.sentences or ())
    return list(dict.fromkeys([*formal, *(text for texts in varied.sentences.values() for text in texts)]))


def _text_rows(named: Sequence[_Annotated], varied: ClipVariations, sentences: Sequence[str]) -> list[dict]:
    row_of = {sentence: row for row, sentence in enumerate(sentences)}
    return [
        {"clip_id": item.clip_id, "form": form, "sentence": sentence, "text_row": row_of[sentence]}
        for item in named
        for form, sentence in [
            *zip(FORMS, item.sentences or (), strict=True),
            *((VARIATION, sentence) for sentence in varied.sentences.get(item.clip_id, ())),
        ]
    ]


def _write_embeddings(path: Path, encoder: TextEncoder, sentences: Sequence[str]) -> None:
    identity = np.frombuffer(canonical_json(encoder.identity).encode(), np.uint8)
    text = np.array(sentences, dtype=np.str_) if sentences else np.zeros(0, "<U1")
    write_npz(path, {"features": encoder.encode(sentences), "sentences": text, "identity": identity})


def _counts(found: Sequence[_Annotated], sentences: Sequence[str]) -> dict[str, int]:
    hands = Counter(item.evidence.hand_type for item in found)
    labelled = [item for item in found if item.labelled_hand]
    return {
        "clips": len(found),
        "annotated": sum(item.sentences is not None for item in found),
        "left_out": sum(item.sentences is None for item in found),
        **{hand: hands[hand] for hand in ("left", "right", "both")},
        "sentences": len(sentences),
        "labelled": len(labelled),
        "agreeing": sum(item.labelled_hand == item.evidence.hand_type for item in labelled),
        "derived_verbs": sum(item.verb.source == "derived" for item in found),
    }
