"""The corpus ``study``: its plan, the symmetry its left hands rest on, and a small one as a whole."""

import tomllib
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pytest

import hoidata.actions
from hoidata.clips.clip import SIDES
from hoidata.files import sha256_file
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.synthetic.catalogue import model_of
from hoidata.synthetic.corpus import write_corpus
from hoidata.synthetic.paths import follow_path
from hoidata.synthetic.soundness import vertex_distances_m
from hoidata.synthetic.study_plan import HANDOVER, STUDY_OBJECTS, VERBS, choices, shares, study_plan, verbs_of
from tests.builders.objects import igl_signed_m
from tests.builders.study import check_soundness

pytestmark = pytest.mark.long

DATASETS = tuple(STUDY_OBJECTS)
TEST, VALIDATION = {"s10"}, {"s9", "s05"}
REGIONS = [
    (dataset, index, region.name)
    for dataset, objects in STUDY_OBJECTS.items()
    for index, item in enumerate(objects)
    for region in item.all_regions
]


def _plans():
    return [(dataset, entry) for dataset in DATASETS for entry in study_plan(dataset, "study")]


def test_there_are_enough_verbs_objects_and_clips_of_disjoint_subjects():
    assert len(VERBS) >= 10
    objects = [item for objects in STUDY_OBJECTS.values() for item in objects]
    assert len({item.spec.name for item in objects}) == len(objects) >= 12
    assert sum(item.spec.lid is not None for item in objects) >= 4
    parts = Counter(
        "test" if entry.subject in TEST else "validation" if entry.subject in VALIDATION else "train"
        for _, entry in _plans()
    )
    assert parts["train"] >= 600
    assert parts["validation"] >= 100
    assert parts["test"] >= 256
    for dataset in DATASETS:
        done = Counter(entry.subject for entry in study_plan(dataset, "study"))
        assert done == shares(dataset, "study")


def test_neither_object_nor_hand_tells_the_verb_and_all_three_do_not_tell_the_region():
    verbs, regions, hands = defaultdict(Counter), defaultdict(set), defaultdict(set)
    for dataset, entry in _plans():
        key = (dataset, entry.object_index, entry.hand)
        if entry.subject in TEST:
            verbs[key][entry.verb] += 1
        elif entry.subject not in VALIDATION:
            regions[*key, entry.verb].add(entry.region)
            hands[dataset, entry.object_index, entry.verb].add(entry.hand)
    usual = sum(max(counts.values()) for counts in verbs.values())
    assert usual <= 0.5 * sum(sum(counts.values()) for counts in verbs.values())
    assert all(len(counts) >= 3 for counts in verbs.values())
    assert np.mean([len(values) >= 2 for values in regions.values()]) > 0.95
    assert all(len(values) == 3 for (_, _, verb), values in hands.items() if verb != HANDOVER)


def test_what_is_tested_was_also_trained_on_and_no_two_clips_have_one_name():
    for dataset in DATASETS:
        entries = study_plan(dataset, "study")
        trained = {(e.object_index, e.verb, e.hand) for e in entries if e.subject not in TEST | VALIDATION}
        assert {(e.object_index, e.verb, e.hand) for e in entries} == trained
        names = [(entry.subject, entry.object_index, entry.verb, entry.number) for entry in entries]
        assert len(set(names)) == len(names)


@pytest.mark.parametrize(("dataset", "index", "region"), REGIONS)
def test_each_object_equals_its_mirror_image(dataset, index, region):
    item = STUDY_OBJECTS[dataset][index]
    symmetry = item.mirror(next(candidate for candidate in item.all_regions if candidate.name == region))
    assert np.linalg.det(symmetry) == pytest.approx(-1)
    model = model_of(item.spec)
    for part in model.parts:
        part_vertices = model.vertices_m[model.part == part]
        away = igl_signed_m(model.vertices_m, model.faces_of(part), part_vertices @ symmetry.T)
        assert np.abs(away).max() < 5e-4
    if model.hinge is not None:  # a lid opened in the mirror is a lid opened as far
        np.testing.assert_allclose(-symmetry @ model.hinge.axis, model.hinge.axis, atol=1e-9)


def test_regions_of_an_object_have_names_of_their_own():
    for objects in STUDY_OBJECTS.values():
        for item in objects:
            names = [region.name for region in item.all_regions]
            assert len(set(names)) == len(names), item.spec.name


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_paths_start_and_end_on_the_table_and_stay_calm(verb):
    frames = np.arange(0, 140, 0.25)
    for hand in ("right", "both"):
        path = follow_path(VERBS[verb].motion_of(hand), frames, 30.0, 0.75 * VERBS[verb].length, False, 1.12, 1.12)
        for end in (0, -1):
            assert path.shift_m[end, 2] == pytest.approx(0.0, abs=1e-9)
        assert np.linalg.norm(np.diff(path.shift_m, axis=0), axis=1).max() * 120 < 2.2


@pytest.mark.parametrize(("verb", "reverse"), [("screw", "unscrew"), ("open", "close")])
def test_what_a_verb_does_is_its_reverse_backwards_from_where_that_ends(verb, reverse):
    paths = [follow_path(VERBS[name].motion, np.linspace(0, 60, 121), 10, 40, False, 1, 1) for name in (verb, reverse)]
    for one, other in zip(*paths, strict=True):
        np.testing.assert_allclose(one[::-1] - one[-1], other - other[0], atol=0.02)
        assert np.array_equal(one, other) == (np.ptp(one) == 0)


def test_every_verb_has_limits_for_what_its_object_does():
    limits = tomllib.loads((Path(hoidata.actions.__file__).parent / "actions.toml").read_text())
    assert set(limits) == set(VERBS)
    for pairs in limits.values():
        assert all(low < high for name, (low, high) in pairs.items() if name != "hand_changes")


@pytest.fixture(scope="module")
def corpora(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    return {
        dataset: (folder / dataset, write_corpus(dataset, folder / dataset, 1, "study-small", jobs=1))
        for dataset in DATASETS
    }


def _digests(root) -> dict[str, str]:
    return {str(path.relative_to(root)): sha256_file(path) for path in sorted(root.rglob("*")) if path.is_file()}


def test_a_study_corpus_is_the_same_bytes_for_any_number_of_jobs(corpora, tmp_path):
    write_corpus("arctic", tmp_path / "together", 1, "study-small", jobs=2)
    assert _digests(corpora["arctic"][0]) == _digests(tmp_path / "together")


@pytest.mark.parametrize("dataset", DATASETS)
def test_a_study_corpus_is_sound_and_shifted_hands_are_not(dataset, corpora):
    truths = corpora[dataset][1]
    assert [truth.hand_type for truth in truths] == [entry.hand for entry in study_plan(dataset, "study-small")]
    assert len(truths) == sum(shares(dataset, "study-small").values())
    check_soundness(truths)


@pytest.mark.parametrize("dataset", DATASETS)
def test_clips_begin_before_contact_and_end_after_it_with_fingers_that_close(dataset, corpora):
    pair = load_embedded_hands()
    for truth in corpora[dataset][1]:
        clip = truth.take(truth.clip_frames)
        for side in clip.active_sides:
            away = vertex_distances_m(clip.object, track_joints(clip.hands[side], pair[side]))
            assert away[0].min() > 0.02
            assert away[-1].min() > 0.02
            pose = rotvec_to_rotmat(clip.hands[side].hand_pose.reshape(-1, 15, 3))
            turned = np.einsum("fjab,jab->fj", pose, pose[len(pose) // 2])
            assert np.rad2deg(np.arccos(np.clip((turned - 1) / 2, -1, 1))).max() >= 20


def test_a_handover_goes_from_one_region_to_another_and_the_object_stands_the_same_for_both():
    handed = [item for item in STUDY_OBJECTS["grab"] if HANDOVER in verbs_of(item, "both")]
    assert len(handed) >= 6
    for item in handed:
        ways = choices(item, HANDOVER, "both")
        assert len(ways) >= 2
        assert all(giving.name != taking.name for giving, taking in ways)


def test_an_idle_hand_may_be_near_but_never_so_near_that_it_counts(corpora):
    pair = load_embedded_hands()
    for _, sequences in corpora.values():
        for truth in sequences:
            for side in set(SIDES) - set(truth.active_sides):
                joints = track_joints(truth.hands[side], pair[side])
                assert vertex_distances_m(truth.object, joints).min() > 0.025
