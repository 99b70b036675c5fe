"""The stages annotate, contact and split, and reading them back, on a small store of clips made here."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hoidata.annotation.encoders import load_encoder
from hoidata.annotation.sentences import reference_sentences
from hoidata.annotation.settings import AnnotationSettings
from hoidata.annotation.stage import annotate_store
from hoidata.batches.dataset import HoiDataset
from hoidata.clips import SIDES, Clip
from hoidata.errors import BadInput, MissingResource
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.objects.model import ObjectModel, articulate
from hoidata.objects.sampling import sample_points
from hoidata.splits.stage import split_store
from hoidata.store.annotated import AnnotatedStore, load_annotated
from tests.builders.clips import clip_of, flat_hand, still_object
from tests.builders.objects import box_model, notebook
from tests.builders.stores import BY_SUBJECT, write_annotated

FRAMES = 6
BOX, NOTEBOOK = box_model((0.06, 0.06, 0.2)), notebook()


def clip(number: int, model: ObjectModel, left: bool, right: bool, **facts) -> Clip:
    """A hand that acts has its wrist 1 cm above the object's top at the origin; another is a metre away."""
    top = float(model.vertices_m[:, 2].max())
    heights = dict(zip(SIDES, (top + (0.01 if acts else 1.0) for acts in (left, right)), strict=True))
    hands = {side: flat_hand(np.tile([0, 0, height], (FRAMES, 1))) for side, height in heights.items()}
    hinge = np.linspace(0, 0.5, FRAMES, dtype=np.float32) if model.is_articulated else None
    return clip_of(f"toy/s{number}/{number}", still_object(model, FRAMES, hinge), hands, **facts)


def clips() -> list[Clip]:
    return [
        clip(1, BOX, True, False),
        clip(2, BOX, False, True, labelled_hand="right", verb="take out", object_words="milk"),
        clip(3, NOTEBOOK, True, True, labelled_hand="left", verb=None),
        clip(4, NOTEBOOK, False, False),
    ]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_annotated(tmp_path_factory.mktemp("toy"), clips())


@pytest.fixture(scope="module")
def annotated(root: Path) -> AnnotatedStore:
    return load_annotated(root)


def test_reference_forms_are_written_on_request(root: Path, tmp_path: Path, annotated: AnnotatedStore) -> None:
    for folder in ("clips", "contact", "splits"):
        (tmp_path / folder).symlink_to(root / folder)
    annotate_store(root / "clips", tmp_path / "annotation", encoder="hash", forms="reference")
    reloaded = load_annotated(tmp_path)
    words_by_clip = {"toy/s1/1": ("lift", "box", "left"), "toy/s2/2": ("take out", "milk", "right")}
    assert all(reloaded.sentences(key) == reference_sentences(*words) for key, words in words_by_clip.items())
    assert reloaded.annotation_info["forms"] == "reference"
    assert reloaded.ids() == annotated.ids()


def test_sentences_name_the_active_hand(annotated: AnnotatedStore) -> None:
    assert annotated.sentences("toy/s1/1")[2] == "The left hand lifts a box."
    assert annotated.sentences("toy/s2/2")[1] == "A carton of milk is taken out by the right hand."
    assert annotated.sentences("toy/s3/3")[0] == "Open a notebook with both hands."
    assert [annotated.hand_type(key) for key in annotated.ids()] == ["left", "right", "both"]


def test_a_clip_without_an_acting_hand_is_listed_with_its_reason_and_left_out(annotated: AnnotatedStore) -> None:
    assert "toy/s4/4" not in annotated.ids()
    assert "no joint within 2 cm" in annotated.hand_types.at["toy/s4/4", "reason"]
    with pytest.raises(KeyError, match="no active hand"):
        annotated.hand_type("toy/s4/4")
    assert annotated.annotation_info["counts"]["left_out"] == 1


def test_a_clip_without_a_word_for_its_object_does_not_stop_the_others(tmp_path: Path) -> None:
    annotated = load_annotated(write_annotated(tmp_path, [*clips()[:2], clip(5, BOX, True, False, object_words="")]))
    assert annotated.ids() == ["toy/s1/1", "toy/s2/2"]
    assert "object of a sentence" in annotated.hand_types.at["toy/s5/5", "reason"]


def test_the_labelled_hand_is_kept_beside_the_found_one(annotated: AnnotatedStore) -> None:
    agreement = annotated.hand_types["agreement"]
    assert agreement["toy/s2/2"] is True
    assert agreement["toy/s3/3"] is False
    assert agreement["toy/s1/1"] is None
    assert annotated.hand_types.at["toy/s1/1", "min_left_m"] == pytest.approx(0.01, abs=1e-3)


def test_the_labelled_hand_is_used_if_requested_and_tracked(tmp_path: Path) -> None:
    """Clip 3: both come near, the left is named. Clip 4: named, but none comes near. Clip 5: the left is never seen."""
    away = clip(4, NOTEBOOK, False, False, labelled_hand="left")
    unseen = clip(5, BOX, False, True, labelled_hand="both")
    left = replace(unseen.hands["left"], valid=np.zeros(FRAMES, bool))
    unseen = replace(unseen, hands={**unseen.hands, "left": left})
    rule = {"by": "subject", "train": "rest", "test": ["s3"]}
    annotated = load_annotated(
        write_annotated(tmp_path, [*clips()[:3], away, unseen], rule=rule, hand="annotated-else-proximity")
    )
    hand_types = annotated.hand_types[["hand_type", "source"]].fillna("none")
    assert hand_types["hand_type"].tolist() == ["left", "right", "left", "none", "right"]
    assert hand_types["source"].tolist() == ["proximity", "annotated", "annotated", "none", "proximity"]
    assert annotated.hand_types["agreement"].tolist() == [None, True, False, False, False]
    assert annotated.sentences("toy/s3/3")[0] == "Open a notebook with the left hand."
    (sample,) = HoiDataset(annotated, "test")
    assert sample.active_hands.tolist() == [True, False]
    np.testing.assert_array_equal(sample.contact[0], annotated.contact_of("toy/s3/3", "left"))
    assert not sample.contact[1].any()
    counts = annotated.annotation_info["counts"]
    assert (counts["labelled"], counts["agreeing"], counts["left"], counts["both"]) == (4, 1, 2, 0)


def test_a_rule_for_hands_that_is_none_is_refused() -> None:
    with pytest.raises(BadInput, match=r"annotate.hand: expected proximity or annotated-else-proximity, got 'label'"):
        AnnotationSettings(hand="label")  # type: ignore[arg-type]


def test_every_clip_with_words_has_its_part(annotated: AnnotatedStore) -> None:
    assert [annotated.ids(part) for part in ("train", "validation", "test")] == [
        ["toy/s1/1"], ["toy/s2/2"], ["toy/s3/3"],
    ]  # fmt: skip


def test_features_are_those_of_the_sentences(annotated: AnnotatedStore) -> None:
    encoder = load_encoder("hash")
    for key in annotated.ids():
        np.testing.assert_array_equal(annotated.text_embedding(key), encoder.encode(annotated.sentences(key)))
    assert annotated.encoder_identity == encoder.identity


def test_points_come_back_as_they_were_sampled(annotated: AnnotatedStore) -> None:
    for key in ("box", "notebook"):
        stored, sampled = annotated.points(key), sample_points(annotated.object_model(key))
        assert stored.method == sampled.method
        for name in ("points_m", "normals", "face", "barycentric", "part"):
            np.testing.assert_array_equal(getattr(stored, name), getattr(sampled, name))


def test_distances_and_contact_equal_brute_force_from_the_stored_clip(annotated: AnnotatedStore) -> None:
    for key in annotated.ids():
        track, points = annotated.clip(key).object, annotated.points(annotated.object_key(key))
        local = articulate(points.points_m, points.part, track.model.hinge, track.hinge_rad)
        world = track.world_from_object @ local
        union = np.zeros(1024, bool)
        for side in SIDES:
            joints = track_joints(annotated.clip(key).hands[side], load_embedded_hands()[side])
            distance = np.linalg.norm(world[:, :, None] - joints[:, None], axis=3)
            entries = annotated.distances(key, side)
            assert len(entries.frame) == (distance < 0.02).sum()
            truth = distance[entries.frame, entries.point, entries.joint]
            np.testing.assert_allclose(entries.distance_m, truth, atol=1e-6)
            touched = (distance < 0.02).any(axis=2)
            np.testing.assert_array_equal(annotated.touched_frames(key, side), touched.sum(axis=0))
            np.testing.assert_array_equal(annotated.contact_of(key, side), touched.any(axis=0))
            union |= touched.any(axis=0)
        np.testing.assert_array_equal(annotated.contact(key), union)


def test_both_hands_are_told_apart_in_the_distances(annotated: AnnotatedStore) -> None:
    both = annotated.distances("toy/s3/3")
    for number, side in enumerate(SIDES):
        side_entries = annotated.distances("toy/s3/3", side)
        assert set(side_entries.side.tolist()) == {number}
        np.testing.assert_array_equal(both.select(both.side == number).point, side_entries.point)
    assert (annotated.distances("toy/s1/1").side == 0).all()


def test_the_same_clips_give_the_same_bytes(root: Path, tmp_path: Path) -> None:
    again = write_annotated(tmp_path, clips())
    for folder in ("annotation", "contact", "splits"):
        names = sorted(path.name for path in (root / folder).iterdir())
        assert names == sorted(path.name for path in (again / folder).iterdir())
        for name in names:
            assert (root / folder / name).read_bytes() == (again / folder / name).read_bytes(), name


def test_an_empty_store_gives_an_empty_annotation(tmp_path: Path) -> None:
    annotated = load_annotated(write_annotated(tmp_path, []))
    assert annotated.ids() == []


def test_the_threshold_decides_who_acts(root: Path, tmp_path: Path) -> None:
    """Below 5 mm only the notebook's cover is left: it turns up into the hands."""
    annotate_store(root / "clips", tmp_path / "annotation", encoder="hash", threshold_m=0.005)
    text = pd.read_parquet(tmp_path / "annotation" / "text.parquet")
    assert set(text["clip_id"]) == {"toy/s3/3"}


def test_a_split_of_another_conversion_is_refused(root: Path, tmp_path: Path) -> None:
    other = write_annotated(tmp_path / "other", clips()[:2])
    for folder, source in (("clips", root), ("annotation", root), ("contact", root), ("splits", other)):
        (tmp_path / folder).symlink_to(source / folder)
    with pytest.raises(BadInput, match=r"splits: expected the 4 clips.*got 2.*run its stage again"):
        load_annotated(tmp_path)


def test_a_missing_stage_is_named(root: Path, tmp_path: Path) -> None:
    for folder, stage in (("clips", "annotate"), ("annotation", "contact"), ("contact", "split")):
        (tmp_path / folder).mkdir()
        with pytest.raises(MissingResource, match=f"stage '{stage}'"):
            load_annotated(tmp_path)


def test_a_clip_without_an_active_hand_gets_no_derived_verb(tmp_path: Path) -> None:
    root = write_annotated(tmp_path, [*clips(), clip(5, NOTEBOOK, False, False, verb=None)])
    hand_types = pd.read_parquet(root / "annotation" / "hand_type.parquet").set_index("clip_id")
    assert hand_types["verb_source"].fillna("none").tolist() == ["source", "source", "derived", "source", "none"]
    assert hand_types.loc["toy/s5/5", ["verb", "verb_evidence"]].isna().all()


def test_a_threshold_that_is_not_positive_is_refused(root: Path, tmp_path: Path) -> None:
    for wrong in (0.0, -0.02, float("nan")):
        with pytest.raises(BadInput, match="metres above 0"):
            annotate_store(root / "clips", tmp_path / "annotation", encoder="hash", threshold_m=wrong)


def test_a_clip_that_failed_quality_control_has_its_reason_and_no_sentence(root: Path, tmp_path: Path) -> None:
    (tmp_path / "clips").symlink_to(root / "clips")
    failed = {"toy/s1/1": "left out by quality control: a jump"}
    counts = annotate_store(tmp_path / "clips", tmp_path / "annotation", encoder="hash", excluded=failed)
    (tmp_path / "contact").symlink_to(root / "contact")
    split_store(tmp_path / "clips", tmp_path / "annotation", tmp_path / "splits", BY_SUBJECT)
    left = load_annotated(tmp_path)
    assert left.ids() == ["toy/s2/2", "toy/s3/3"]
    assert left.hand_types.at["toy/s1/1", "reason"] == failed["toy/s1/1"]
    assert left.splits["toy/s1/1"] is None
    assert counts["left_out"] == 2
