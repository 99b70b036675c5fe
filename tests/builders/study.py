"""A few clips of the corpus ``study``, generated in seconds: one object, no rejection sampling."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hoidata.clips import SIDES, Clip
from hoidata.hands import load_embedded_hands
from hoidata.physics.contact_forces import RESIDUAL_LIMIT
from hoidata.synthetic.soundness import force_residuals, is_sound, surface_distances
from hoidata.synthetic.study import (
    PoolTask,
    Scenario,
    find_grasps,
    make_study_sequence,
    people_of,
    sample_contact_frames,
)
from hoidata.synthetic.study_plan import STUDY_OBJECTS
from hoidata.synthetic.truth import TruthSequence
from tests.builders.clips import clip_of

# Clips of each verb and hand by each subject of the small corpora: training, validation, test.
AMOUNTS = {"arctic": {"s01": 6, "s05": 2, "s10": 3}, "grab": {"s1": 6, "s9": 2, "s10": 3}}


def study_rule(dataset: str) -> dict[str, object]:
    """Return the split of these clips, by subject."""
    train, validation, test = ([subject] for subject in AMOUNTS[dataset])
    return {"by": "subject", "train": train, "validation": validation, "test": test}


def study_clips(dataset: str, object_index: int, verbs: Sequence[str]) -> list[Clip]:
    """Generate clips of one object with one hand, at its first region."""
    study_object, pair, rng = STUDY_OBJECTS[dataset][object_index], load_embedded_hands(), np.random.default_rng(0)
    people, clips = people_of(dataset, 0, "study-small"), []
    regions = {verb: study_object.regions(verb, 1)[0] for verb in verbs}
    grasps = {
        region.name: find_grasps(
            PoolTask(dataset=dataset, seed=0, size="study-small", object_index=object_index, region=region.name)
        )
        for region in regions.values()
    }
    for subject, n_clips in AMOUNTS[dataset].items():
        for verb, region in regions.items():
            for number in range(2 * n_clips):
                region_grasps = grasps[region.name][subject]
                contact_frames = sample_contact_frames(verb, rng)
                grips = region_grasps[number // 2 % len(region_grasps)]
                scenario = Scenario(
                    dataset=dataset,
                    study_object=study_object,
                    verb=verb,
                    region=region,
                    grips=grips,
                    person=people[subject],
                    source_key=subject,
                    left=number % 2 == 1,
                )
                truth = make_study_sequence(scenario, contact_frames, pair, 1.0, rng)
                clip = truth.take(truth.clip_frames)
                name = f"{dataset}/{subject}/{study_object.spec.name}_{verb}_{number}"
                facts = {"verb": verb, "object_words": study_object.spec.words}
                clips.append(clip_of(name, clip.object, {side: clip.hands[side] for side in SIDES}, **facts))
    return clips


def shifted(truth: TruthSequence, shift_m: np.ndarray) -> TruthSequence:
    return replace(
        truth, hands={side: replace(hand, wrist_m=hand.wrist_m + shift_m) for side, hand in truth.hands.items()}
    )


def check_soundness(truths: Sequence[TruthSequence]) -> None:
    """Contact forces explain the motion of lifted objects; they do not after the hands are shifted, or far away."""
    pair, explained = load_embedded_hands(), []
    directions = np.random.default_rng(7).normal(size=(len(truths), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for truth, direction in zip(truths, directions, strict=True):
        assert is_sound(truth, pair)
        sampled = truth.at_30_fps()
        nearest_m = np.min([near.distance_m.min(1) for near in surface_distances(sampled, pair).values()], axis=0)
        assert nearest_m.min() > -0.01
        assert nearest_m[sampled.lifted].max(initial=0.0) < 0.02
        assert not is_sound(shifted(truth, np.array([0.0, 0.0, 0.2])), pair)
        for shift_m in (np.zeros(3), 0.01 * direction, np.array([0.0, 0.0, 0.3])):
            moved = shifted(truth, shift_m).at_30_fps()
            residuals = force_residuals(moved, surface_distances(moved, pair), pair)
            explained.append((len(residuals), (residuals < RESIDUAL_LIMIT).sum()))
    n_frames, n_explained = np.array(explained).reshape(len(truths), 3, 2).sum(axis=0).T
    assert n_frames[0] > 100
    assert n_explained[0] == n_frames[0]
    assert n_explained[1] < 0.8 * n_frames[0]
    assert n_explained[2] <= 0.02 * n_frames[0]
