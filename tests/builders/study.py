"""A few clips of the corpus ``study``, made in seconds: one object, grasps searched as there, no clip drawn again."""

from collections.abc import Sequence

import numpy as np

from hoidata.clips import SIDES, Clip
from hoidata.hands import load_embedded_hands
from hoidata.synthetic.study import PoolTask, Scenario, draw_hold, find_grasps, make_study_sequence, people_of
from hoidata.synthetic.study_objects import STUDY_OBJECTS
from tests.builders.clips import clip_of

# Clips of each verb and hand by each subject of the small corpora: to train on, to validate, to test.
AMOUNTS = {"arctic": {"s01": 6, "s05": 2, "s10": 3}, "grab": {"s1": 6, "s9": 2, "s10": 3}}


def study_rule(dataset: str) -> dict[str, object]:
    """The split of these clips, by subject."""
    train, validation, test = ([subject] for subject in AMOUNTS[dataset])
    return {"by": "subject", "train": train, "validation": validation, "test": test}


def study_clips(dataset: str, row: int, verbs: Sequence[str]) -> list[Clip]:
    """Verbs of one object by its first region, with one hand. Only the subject, the pace and chance differ."""
    thing, pair, rng = STUDY_OBJECTS[dataset][row], load_embedded_hands(), np.random.default_rng(0)
    people, clips = people_of(dataset, 0, "study-small"), []
    regions = {verb: thing.regions(verb, 1)[0] for verb in verbs}
    grasps = {
        region.name: find_grasps(PoolTask(dataset, 0, "study-small", row, region.name)) for region in regions.values()
    }
    for subject, amount in AMOUNTS[dataset].items():
        for verb, region in regions.items():
            for number in range(2 * amount):
                own = grasps[region.name][subject]
                hold = draw_hold(verb, rng)
                grips = own[number // 2 % len(own)]
                scenario = Scenario(dataset, thing, verb, region, grips, people[subject], subject, number % 2 == 1)
                truth = make_study_sequence(scenario, hold, pair, rng)
                seen = truth.take(truth.clip_frames)
                name = f"{dataset}/{subject}/{thing.spec.name}_{verb}_{number}"
                facts = {"verb": verb, "object_words": thing.spec.words}
                clips.append(clip_of(name, seen.object, {side: seen.hands[side] for side in SIDES}, **facts))
    return clips
