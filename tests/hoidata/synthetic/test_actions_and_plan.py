from collections import Counter, defaultdict

import numpy as np
import pandas as pd
import pytest

from hoidata.datasets.h2o.adapter import ACTIONS as H2O_LABELS
from hoidata.synthetic.actions import ACTIONS, CASTS, H2O_ACTION_IDS, LONGEST_CLIP, MEAN_LENGTH, plan, subjects
from hoidata.synthetic.paths import MOTIONS, follow_path, minimum_jerk
from hoidata.synthetic.sequences import sample_length

DATASETS = ("h2o", "grab", "arctic")
ARCTIC_PAIRS = {
    "cut": {"scissors"},
    "operate": {"microwave"},
    "point": {"notebook"},
    "shake": {"ketchup"},
    "sprinkle": {"ketchup"},
    "type": {"laptop", "phone"},
}  # fmt: skip; every object is also grasped, lifted and placed, and opened and closed but for the scissors
# Pairs of real GRAB file names; every object is also lifted and passed, simple solids inspected and handed over.
GRAB_USES = {
    "eat": {"apple"}, "drink": {"mug", "wineglass", "bowl", "cup", "waterbottle"}, "toast": {"wineglass", "mug"},
    "pour": {"teapot", "cup", "waterbottle"}, "shake": {"waterbottle"}, "use": {"hammer", "knife"},
}  # fmt: skip
SOLIDS = ("cube", "sphere", "cylinder", "torus", "pyramid")


def test_only_pairs_of_the_real_label_tables_occur():
    numbers = {action: number for number, action in enumerate(H2O_LABELS) if number}
    assert numbers == H2O_ACTION_IDS
    assert all((action.verb, action.object_name) in numbers for action in ACTIONS["h2o"])
    for action in ACTIONS["arctic"]:
        moved = action.verb in ("open", "close") and action.object_name != "scissors"
        whole = action.verb in ("grasp", "lift", "place")
        assert moved or whole or action.object_name in ARCTIC_PAIRS[action.verb], action
    for action in ACTIONS["grab"]:
        allowed = action.verb in ("lift", "pass") or action.object_name in GRAB_USES.get(action.verb, ())
        solid = action.verb in ("inspect", "hand over") and action.object_name.startswith(SOLIDS)
        assert allowed or solid, action


def test_there_are_enough_verbs_and_each_dataset_uses_left_right_and_both():
    assert len({action.verb for actions in ACTIONS.values() for action in actions}) >= 10
    for actions in ACTIONS.values():
        assert {action.grasp.hand for action in actions} == {"left", "right", "both"}
        assert len({(action.verb, action.object_name) for action in actions}) == len(actions)


def test_the_object_alone_does_not_give_the_hand():
    for dataset in DATASETS:
        hands = defaultdict(set)
        for action in ACTIONS[dataset]:
            hands[action.object_name].add(action.grasp.hand)
        assert sum(len(kinds) > 1 for kinds in hands.values()) >= 2


@pytest.mark.parametrize("dataset", DATASETS)
def test_what_is_tested_was_also_trained_on(dataset):
    for size in ("full", "small"):
        cast = CASTS[dataset][size]
        trained = {entry.action for entry in plan(dataset, size) if entry.subject in cast.train}
        assert {entry.action for entry in plan(dataset, size)} == trained
        assert not set(cast.train) & ({*cast.validation, *cast.test})


def test_the_corpora_have_about_250_sequences_and_the_small_profile_24():
    assert 240 <= sum(len(plan(dataset, "full")) for dataset in DATASETS) <= 260
    assert sum(len(plan(dataset, "small")) for dataset in DATASETS) == 24


@pytest.mark.parametrize("dataset", DATASETS)
def test_every_subject_acts_and_no_two_entries_are_equal(dataset):
    entries = plan(dataset, "full")
    assert len(set(entries)) == len(entries)
    assert set(Counter(entry.subject for entry in entries)) == set(subjects(dataset, "full"))


@pytest.mark.parametrize("dataset", DATASETS)
def test_the_verb_explains_most_of_the_length(dataset):
    verbs = [ACTIONS[dataset][entry.action].verb for entry in plan(dataset, "full")] * 5
    rng = np.random.default_rng(0)
    lengths = pd.Series([sample_length(dataset, verb, rng) for verb in verbs])
    unexplained = (lengths - lengths.groupby(verbs).transform("mean")).var() / lengths.var()
    assert 0.05 < unexplained <= 0.5
    assert lengths.max() <= LONGEST_CLIP
    means = MEAN_LENGTH[dataset].values()
    assert min(means) <= 46
    assert max(means) >= 130


@pytest.mark.parametrize("name", sorted(MOTIONS))
def test_paths_start_and_end_on_the_table_without_jumps(name):
    motion = MOTIONS[name]
    frames = np.arange(0, 140, 0.25)
    path = follow_path(motion, frames, 30.0, 80.0, False, 1.0, 1.0)
    for end in (0, -1):
        assert path.shift_m[end, 2] == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(path.rotation_rad[end], 0, atol=1e-9)
    np.testing.assert_allclose(path.shift_m[0], 0, atol=1e-9)
    speed = np.linalg.norm(np.diff(path.shift_m, axis=0), axis=1) * 120
    assert speed.max() < 1.6
    assert np.abs(np.diff(speed)).max() < 0.25


def test_a_left_handed_path_is_the_mirror_image():
    frames = np.arange(0, 100, 1.0)
    right = follow_path(MOTIONS["pour"], frames, 5.0, 80.0, False, 1.1, 0.9)
    left = follow_path(MOTIONS["pour"], frames, 5.0, 80.0, True, 1.1, 0.9)
    np.testing.assert_allclose(left.shift_m, right.shift_m * [-1, 1, 1])
    np.testing.assert_allclose(left.rotation_rad, right.rotation_rad * [1, -1, -1])


def test_minimum_jerk_starts_and_ends_at_rest():
    fraction = np.linspace(0, 1, 1001)
    position = minimum_jerk(fraction)
    velocity = np.gradient(position, fraction)
    assert (position[0], position[-1]) == (0.0, 1.0)
    assert abs(velocity[0]) < 1e-4
    assert abs(velocity[-1]) < 1e-4
    assert (velocity >= -1e-9).all()
