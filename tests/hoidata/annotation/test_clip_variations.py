"""Variations of a dataset's clips: the clip's own choice, guarded, with adverbs only where the speed was measured."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hoidata.annotation.clip_variations import (
    VariationSettings,
    Wording,
    clip_variations,
    hand_speed_m_s,
    manners,
)
from hoidata.annotation.encoders import load_encoder
from hoidata.annotation.reference_mode import reference_sentences
from hoidata.annotation.sentences import FORMS, four_sentences
from hoidata.annotation.stage import annotate_store
from hoidata.annotation.variations import SentenceMaker
from hoidata.clips import Clip, HandTrack, Side
from hoidata.store.annotated import load_annotated
from tests.builders.clips import clip_of, flat_hand, still_object
from tests.builders.objects import box_model
from tests.builders.stores import write_annotated

FRAMES = 12
WORDS = [("lift", "box", "left"), ("open", "laptop", "both"), ("take out", "milk", "right"), (None, "teapot", "both")]


def wordings(speeds: list[float | None] | None = None) -> list[Wording]:
    speeds = speeds or [None] * 40
    said = [WORDS[number % len(WORDS)] for number in range(len(speeds))]
    return [
        Wording(f"toy/{number}", *words, speed) for number, (words, speed) in enumerate(zip(said, speeds, strict=True))
    ]


def test_a_clip_gets_as_many_as_asked_for_distinct_and_none_it_has_already() -> None:
    taken = four_sentences("lift", "box", "left")
    clips = [Wording("toy/a", "lift", "box", "left", None, taken), *wordings()]
    found = clip_variations(clips, VariationSettings(7))
    assert {len(set(sentences)) for sentences in found.sentences.values()} == {7}
    assert not set(found.sentences["toy/a"]) & set(taken)
    assert found.facts()["kept"] == 7 * len(clips)
    assert clip_variations(clips, VariationSettings(0)).sentences == {}


def test_a_clips_choice_does_not_depend_on_the_clips_beside_it_or_on_how_many_are_asked_for() -> None:
    clips = wordings()
    few, many = clip_variations(clips, VariationSettings(3)), clip_variations(clips[::-1], VariationSettings(9))
    for clip in clips:
        assert many.sentences[clip.clip_id][:3] == few.sentences[clip.clip_id]
    same_words = [few.sentences[f"toy/{number}"] for number in range(0, 40, 4)]
    assert len(set(same_words)) == len(same_words)


@pytest.mark.slow
def test_every_variation_reads_back_and_what_does_not_is_counted_by_what_was_lost() -> None:
    verbs, things = ("stamp", "brush", "watch", "lift"), ("stamp", "toothbrush", "watch", "hand")
    clips = [Wording(f"{verb} {thing}", verb, thing, "left") for verb in verbs for thing in things]
    found = clip_variations(clips, VariationSettings(1000))
    maker = SentenceMaker(verbs, things)
    for clip in clips:
        assert clip.verb is not None
        said = found.sentences[clip.clip_id]
        assert all(maker.lost(text, clip.verb, clip.object_words, "left") is None for text in said)
    made = sum(len(maker.unguarded(str(clip.verb), clip.object_words, "left")) for clip in clips)
    facts = found.facts()
    assert facts["dropped"]["verb"] > 0
    assert facts["kept"] + sum(facts["dropped"].values()) == made


@pytest.mark.parametrize(
    ("things", "hand", "lost"),
    [
        (("right hand", "cup"), "left", "hand"),
        (("right hand", "cup"), "both", "object"),
        (("box", "the box"), "left", "object"),
    ],
)
def test_a_sentence_that_names_another_hand_or_object_is_dropped_from_a_clip_too(things, hand, lost) -> None:
    """What is called "right hand" is taken for the hand that acts, and "the box" beside a "box" for the other one."""
    clips = [Wording(thing, "lift", thing, hand) for thing in things]
    found, maker = clip_variations(clips, VariationSettings(1000)), SentenceMaker(["lift"], things)
    for clip in clips:
        said = found.sentences[clip.clip_id]
        assert all(maker.lost(text, "lift", clip.object_words, hand) is None for text in said)
    assert found.facts()["dropped"][lost] > 0


def test_slow_and_quick_are_the_outer_fifths_where_they_stand_out() -> None:
    """Forty clips of one verb at 1 to 40 cm/s: a fifth below and a fifth above; all within 10 %: none."""
    spread = [Wording(f"{n}", "lift", "box", "left", n / 100) for n in range(1, 41)]
    found = manners(spread)
    assert sorted(int(key) for key, manner in found.items() if manner == "slowly") == list(range(1, 9))
    assert sorted(int(key) for key, manner in found.items() if manner == "quickly") == list(range(33, 41))
    assert manners([Wording(f"{n}", "lift", "box", "left", 1 + n / 400) for n in range(40)]) == {}
    assert manners(spread[:9]) == {}
    # A hand that does not move at all counts as one.
    found = manners([Wording(f"{n}", "lift", "box", "left", n / 100) for n in range(40)])
    assert sorted(int(key) for key, manner in found.items() if manner == "slowly") == list(range(8))
    assert manners([Wording(f"{n}", "lift", "box", "left", None) for n in range(40)]) == {}


def test_speeds_are_compared_among_clips_of_the_same_verb() -> None:
    """Pouring is slow beside throwing, but not slow for pouring."""
    pour = [Wording(f"pour {n}", "pour", "cup", "left", 0.1 + n / 1000) for n in range(20)]
    throw = [Wording(f"throw {n}", "throw", "cup", "left", 2 + n / 1000) for n in range(20)]
    assert manners(pour + throw) == {}
    few = [Wording("eat", "eat", "apple", "left", 0.001)]
    assert manners(pour + throw + few) == {"eat": "slowly"}


def test_adverbs_stand_only_in_clips_that_earned_them_and_can_be_turned_off() -> None:
    clips = wordings([0.1 + 0.02 * number for number in range(40)])
    earned = manners(clips)
    found = clip_variations(clips, VariationSettings(30))
    for clip in clips:
        said = set(re.findall("slowly|quickly", " ".join(found.sentences[clip.clip_id]).lower()))
        assert said == ({earned[clip.clip_id]} if clip.clip_id in earned else set())
    assert earned
    silent = clip_variations(clips, VariationSettings(30, adverbs=False))
    assert not any(re.search("slowly|quickly", text.lower()) for texts in silent.sentences.values() for text in texts)
    assert found.facts()["slowly"] == sum(manner == "slowly" for manner in earned.values())


def test_hand_speed_is_the_mean_over_valid_tenths_of_a_second() -> None:
    frames = np.arange(30)
    moving = np.stack([0.02 * frames, 0 * frames, 0 * frames], -1)[:, None].repeat(21, 1)
    everywhere = np.ones(30, bool)
    assert hand_speed_m_s({"left": moving}, {"left": everywhere}) == pytest.approx(0.02 * 30)
    both = {"left": moving, "right": np.zeros_like(moving)}
    assert hand_speed_m_s(both, dict.fromkeys(both, everywhere)) == pytest.approx(0.3)
    broken = moving.copy()
    broken[10] += 5
    assert hand_speed_m_s({"left": broken}, {"left": frames != 10}) == pytest.approx(0.6)
    assert hand_speed_m_s({"left": moving}, {"left": ~everywhere}) is None


def clip(number: int, **facts) -> Clip:
    """The left hand lies on a small box and moves a little, the faster the higher the number; the right is far away
    and moves the faster the lower the number.
    """
    share = np.linspace(0, 1, FRAMES)[:, None]
    left, right = share * [0.001 * number, 0, 0] + [0, 0, 0.04], share * [0.003 * (15 - number), 0, 0] + [0, 0, 2]
    track = still_object(box_model((0.06, 0.06, 0.06)), FRAMES)
    hands: dict[Side, HandTrack] = {"left": flat_hand(left), "right": flat_hand(right)}
    return clip_of(f"toy/s{number % 4}/{number:02d}", track, hands, **facts)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = [clip(number) for number in range(1, 15)] + [clip(15, object_words="")]
    return write_annotated(tmp_path_factory.mktemp("plain"), made)


def annotated_as(plain: Path, root: Path, **settings):
    for folder in ("clips", "contact", "splits"):
        (root / folder).symlink_to(plain / folder)
    annotate_store(plain / "clips", root / "annotation", encoder="hash", **settings)
    return load_annotated(root)


def test_variations_follow_the_four_forms_and_leave_them_as_they_are(plain: Path, tmp_path: Path) -> None:
    before = load_annotated(plain)
    after = annotated_as(plain, tmp_path, variations=VariationSettings(5))
    encoder = load_encoder("hash")
    assert before.ids() == after.ids()
    assert len(before.ids()) == 14
    for key in before.ids():
        assert after.sentences(key) == before.sentences(key)
        assert after.text_embedding(key).tobytes() == before.text_embedding(key).tobytes()
        assert (before.variations(key), before.variation_features(key).shape) == ((), (0, 512))
        assert len(after.variations(key)) == 5
        np.testing.assert_array_equal(after.variation_features(key), encoder.encode(after.variations(key)))
    forms = pd.read_parquet(tmp_path / "annotation" / "text.parquet").groupby("clip_id")["form"].agg(list)
    assert set(map(tuple, forms)) == {(*FORMS, *["variation"] * 5)}
    rows = [pd.read_parquet(root / "annotation" / "text.parquet") for root in (plain, tmp_path)]
    assert rows[0]["text_row"].tolist() == rows[1].loc[rows[1]["form"] != "variation", "text_row"].tolist()
    facts = after.annotation_info["variations"]
    assert (facts["per_clip"], facts["kept"]) == (5, 5 * 14)
    assert 1 <= facts["slowly"] <= 3
    assert 1 <= facts["quickly"] <= 3
    assert before.annotation_info["variations"]["kept"] == 0


def test_only_the_hand_that_acts_makes_a_clip_slow_or_quick(plain: Path, tmp_path: Path) -> None:
    after = annotated_as(plain, tmp_path, variations=VariationSettings(60))
    said = {key: " ".join(after.variations(key)).lower() for key in after.ids()}
    assert {int(key[-2:]) for key, text in said.items() if "slowly" in text} == {1, 2, 3}
    assert {int(key[-2:]) for key, text in said.items() if "quickly" in text} == {12, 13, 14}


def test_reference_forms_are_written_where_asked_for(plain: Path, tmp_path: Path) -> None:
    after = annotated_as(plain, tmp_path, forms="reference")
    assert all(after.sentences(key) == reference_sentences("lift", "box", "left") for key in after.ids())
    assert after.annotation_info["forms"] == "reference"
    assert after.ids() == load_annotated(plain).ids()


@pytest.mark.parametrize("state", ["cold", "warm", "damaged", "one bit flipped"])
def test_the_stages_bytes_are_the_same_whatever_the_feature_cache_holds(
    plain: Path, tmp_path: Path, state: str
) -> None:
    cache = tmp_path / "features"
    if state != "cold":
        annotate_store(plain / "clips", tmp_path / "first", encoder="hash", features=cache)
    for path in cache.rglob("*.npz"):
        data = path.read_bytes()
        if state == "damaged":
            path.write_bytes(data[: len(data) // 2])
        elif state == "one bit flipped":
            path.write_bytes(data[:1500] + bytes([data[1500] ^ 1]) + data[1501:])
    annotate_store(plain / "clips", tmp_path / "annotation", encoder="hash", features=cache)
    for path in (plain / "annotation").iterdir():
        assert (tmp_path / "annotation" / path.name).read_bytes() == path.read_bytes(), path.name
