"""The distances of the hand test are kept: other thresholds give what a run of the whole stage with them would give."""

import pickle
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hoidata.annotation.stage import annotate_store
from hoidata.clips import SIDES, Clip, Side
from hoidata.contact.maps import find_active_hands
from hoidata.contact.proximity import ProximityIndex
from hoidata.errors import BadInput, MissingResource
from hoidata.files.arrays import read_npz, write_npz
from hoidata.objects.sampling import sample_points
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.store.hand_evidence import HandDistances, HandEvidence
from tests.builders.clips import clip_of, flat_hand, still_object
from tests.builders.objects import box_model
from tests.builders.stores import write_annotated

BOX = box_model((0.06, 0.06, 0.2))
HEIGHTS_M = {"toy/s1/1": (0.012, 0.5), "toy/s2/2": (0.5, 0.015), "toy/s3/3": (0.033, 0.018), "toy/s4/4": (0.3, 0.4)}
THRESHOLDS_M = (0.001, 0.0125, 0.02, 0.03, 0.06, 0.45, 2.0)


def clip(name: str, heights_m: tuple[float, float], frames: int) -> Clip:
    """Each hand comes down to its height above a box and goes up again; the right hand is lost in the last frame."""
    dip, hands = np.abs(np.linspace(-0.05, 0.05, frames)), {}
    for side, height in zip(SIDES, heights_m, strict=True):
        wrist = np.stack([0 * dip, 0 * dip, 0.1 + height + dip], axis=1)
        hands[side] = flat_hand(wrist, np.arange(frames) < frames - (side == "right"))
    return clip_of(name, still_object(BOX, frames), hands)


def made() -> list[Clip]:
    return [clip(name, heights, 5 + number) for number, (name, heights) in enumerate(HEIGHTS_M.items())]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_annotated(tmp_path_factory.mktemp("toy"), made())


@pytest.fixture(scope="module")
def annotated(root: Path) -> AnnotatedStore:
    return load_annotated(root)


def measured(annotated: AnnotatedStore, clip_id: str) -> HandEvidence:
    clip = annotated.clip(clip_id)
    joints: dict[Side, np.ndarray] = {side: annotated.joints(clip_id, side) for side in SIDES}
    return find_active_hands(clip, joints, ProximityIndex(sample_points(clip.object.model)))


def test_the_kept_distances_are_the_measured_ones_of_the_same_clip(annotated: AnnotatedStore) -> None:
    for clip_id in HEIGHTS_M:
        stored, fresh = annotated.hand_evidence(clip_id), measured(annotated, clip_id)
        assert stored.hand_type == fresh.hand_type
        for side in SIDES:
            assert stored.distance_m[side].dtype == np.float32
            np.testing.assert_array_equal(stored.distance_m[side], fresh.distance_m[side].astype(np.float32))
            assert stored.closest_m(side) == fresh.closest_m(side)
        assert np.isinf(stored.distance_m["right"][-1])


def test_another_threshold_gives_what_a_run_of_the_stage_with_it_gives(
    annotated: AnnotatedStore, root: Path, tmp_path: Path
) -> None:
    types = set()
    for threshold_m in THRESHOLDS_M:
        annotate_store(root / "clips", tmp_path / f"{threshold_m}", encoder="hash", threshold_m=threshold_m)
        table = pd.read_parquet(tmp_path / f"{threshold_m}" / "hand_type.parquet")
        stored_types = table["hand_type"].astype(object).where(table["hand_type"].notna(), None)
        whole_run = dict(zip(table["clip_id"], stored_types, strict=True))
        judged = {clip_id: annotated.hand_evidence(clip_id, threshold_m).hand_type for clip_id in HEIGHTS_M}
        assert judged == whole_run
        types |= set(whole_run.values())
    assert types == {None, "left", "right", "both"}


def test_a_threshold_just_above_and_at_the_smallest_distance(annotated: AnnotatedStore) -> None:
    """A hand acts strictly below the threshold, judged by the exact minimum and not by its float32 rounding."""
    smallest = annotated.hand_evidence("toy/s1/1").closest_m("left")
    assert annotated.hand_evidence("toy/s1/1", smallest).hand_type is None
    assert annotated.hand_evidence("toy/s1/1", np.nextafter(smallest, 1)).hand_type == "left"


def test_a_frame_at_the_threshold_is_not_near() -> None:
    distance: dict[Side, np.ndarray] = {"left": np.array([0.02, np.nextafter(0.02, 0)]), "right": np.full(2, np.inf)}
    assert HandEvidence(distance, 0.02).near("left").tolist() == [False, True]


def test_frames_are_judged_one_by_one(annotated: AnnotatedStore) -> None:
    """The right hand is 6.5, 4.5, 2.5, 2.5, 4.5 cm above the box and then lost."""
    evidence = annotated.hand_evidence("toy/s2/2", 0.05)
    assert evidence.near("right").tolist() == [False, True, True, True, True, False]
    closer = annotated.hand_evidence("toy/s2/2", 0.03)
    assert closer.near("right").tolist() == [False, False, True, True, False, False]
    assert not evidence.near("left").any()


def test_a_worker_maps_the_distances_anew_and_is_not_sent_them(root: Path) -> None:
    opened = load_annotated(root)
    size = len(pickle.dumps(opened))
    before = opened.hand_evidence("toy/s3/3")
    sent = pickle.dumps(opened)
    assert len(sent) == size
    np.testing.assert_array_equal(
        pickle.loads(sent).hand_evidence("toy/s3/3").distance_m["left"], before.distance_m["left"]
    )


def test_an_annotation_without_distances_names_its_stage(root: Path, tmp_path: Path) -> None:
    with pytest.raises(MissingResource, match="'annotate'"):
        HandDistances(tmp_path / "hand_distance.npz", 4)
    with pytest.raises(BadInput, match=r"distances of 3 clips.*of 4"):
        HandDistances(root / "annotation" / "hand_distance.npz", 3)
    arrays = read_npz(root / "annotation" / "hand_distance.npz")
    write_npz(tmp_path / "other.npz", {name: array for name, array in arrays.items() if name != "right_m"})
    with pytest.raises(BadInput, match=r"arrays first_frame, left_m, right_m.*run the stage annotate again"):
        HandDistances(tmp_path / "other.npz", 4)
    write_npz(tmp_path / "short.npz", {**arrays, "left_m": arrays["left_m"][:-1]})
    with pytest.raises(BadInput, match="run the stage annotate again"):
        HandDistances(tmp_path / "short.npz", 4)
