"""The named splits: what the papers and the datasets' makers say, written down a second time by hand."""

import hashlib
from collections import Counter

import orjson
import pandas as pd
import pytest

from hoidata.dataset_folders import BUILT_IN, built_in_names, dataset_facts
from hoidata.datasets.h2o.adapter import ACTIONS
from hoidata.errors import BadInput
from hoidata.splits.definitions import OF_ANY_DATASET, choose, definitions_for, published
from hoidata.splits.rules import assign_split

H2O = tuple(f"subject{number}" for number in (1, 2, 3, 4))
# Verb and object pairs of ARCTIC's descriptions (Text2HOI's word lists): any object but for the verbs named here.
ARCTIC_OBJECTS = {"box", "capsulemachine", "ketchup", "laptop", "microwave", "mixer", "notebook", "phone", "scissors",
                  "waffleiron"}  # fmt: skip
ARCTIC_PAIRS = {
    **dict.fromkeys(("grasp", "lift", "place"), ARCTIC_OBJECTS),
    **dict.fromkeys(("open", "close"), ARCTIC_OBJECTS - {"scissors"}),
    "cut": {"scissors"},
    "operate": {"microwave"},
    "point": {"notebook"},
    "shake": {"ketchup"},
    "sprinkle": {"ketchup"},
    "type": {"laptop", "phone"},
}
# Verbs of the held-out objects in GRAB's file names (bowl_drink_1, cup_pour_1, train_play_1, ...), with some objects.
GRAB_CUBES, GRAB_CYLINDERS = (
    {f"{shape}{size}" for size in ("large", "medium", "small")} for shape in ("cube", "cylinder")
)
GRAB_PAIRS = {
    **{verb: {*GRAB_CUBES, *GRAB_CYLINDERS, "bowl", "duck", "train", "cup", "stanfordbunny", "mug", "waterbottle"}
       for verb in ("lift", "pass")},
    "inspect": {*GRAB_CUBES, *GRAB_CYLINDERS, "duck", "stanfordbunny", "spherelarge", "toruslarge"},
    "drink": {"bowl", "cup", "mug", "wineglass"},
    "pour": {"cup", "teapot", "waterbottle"},
    "play": {"train", "flute", "gamecontroller"},
}  # fmt: skip


def parts(dataset: str, name: str, sequences) -> dict[str, str | None]:
    """Part of each of a dataset's sequences, whose names start with the subject (H2O, ARCTIC) or give the object."""
    rows = [
        {
            "clip_id": sequence,
            "sequence": sequence,
            "subject": sequence.split("/")[0],
            "object": sequence.split("/")[1].split("_")[0],
            "other_objects": [],
            "first_source_frame": 0,
        }
        for sequence in sequences
    ]
    table = pd.DataFrame(rows).set_index("clip_id", drop=False)
    return dict(assign_split(table, definitions_for(dataset)[name].rule).items())


def held_out(dataset: str, name: str) -> tuple[tuple[str, ...], ...]:
    rule = definitions_for(dataset)[name].rule
    return rule.names("validation"), rule.names("test")


def test_text2hois_test_subjects_and_our_validation_subjects():
    assert held_out("h2o", "text2hoi") == (("subject2",), ("subject3",))
    assert held_out("grab", "text2hoi") == (("s9",), ("s10",))
    assert held_out("arctic", "text2hoi") == (("s05",), ("s10",))
    assert parts("h2o", "text2hoi", ["subject4/h1/0"]) == {"subject4/h1/0": None}
    assert parts("arctic", "text2hoi", ["s03/box_use_01"]) == {"s03/box_use_01": None}


def test_h2os_official_split_counts_sequences_segments_and_frames_as_its_lists_do():
    listed = published("h2o")
    assigned = parts("h2o", "official", listed.sequences)
    assert Counter(assigned.values()) == {"train": 114, "validation": 24, "test": 46}
    segments, frames = Counter(), Counter()
    for sequence, n_segments, n_frames in zip(listed.sequences, listed.segments, listed.frames, strict=True):
        segments[assigned[sequence]] += n_segments
        frames[assigned[sequence]] += n_frames
    assert segments == {"train": 569, "validation": 122, "test": 242}
    assert frames == {"train": 68929, "validation": 14676, "test": 30724}


@pytest.mark.parametrize("dataset", built_in_names())
def test_what_the_makers_publish_is_a_list_or_a_reason_why_there_is_none(dataset):
    """An empty list would say that a dataset has no sequences."""
    values = orjson.loads((BUILT_IN / dataset / "published.json").read_bytes())
    assert all(values.values())
    assert "sequences" in values or "no list of sequences is" in values["source"]
    rules = {name: definition.rule.as_json() for name, definition in definitions_for(dataset).items()}
    assert [name for name, rule in rules.items() if rule.get("train") == [] or rule.get("test") == []] == []


def test_an_empty_list_of_sequences_is_refused(tmp_path, monkeypatch):
    (tmp_path / "attic").mkdir()
    (tmp_path / "attic/facts.toml").write_bytes((BUILT_IN / "grab/facts.toml").read_bytes())
    (tmp_path / "attic/adapter.py").write_text("")
    (tmp_path / "attic/published.json").write_text('{"source": "nobody knows", "sequences": []}')
    monkeypatch.setenv("HOIDATA_DATASETS", str(tmp_path / "attic"))
    with pytest.raises(BadInput, match="remove the key, and give the reason in `source`"):
        published("attic")


def test_grabs_official_split_is_by_object():
    validation, test = held_out("grab", "official")
    assert set(test) == {"mug", "wineglass", "camera", "binoculars", "fryingpan", "toothpaste"}
    assert set(validation) == {"apple", "toothbrush", "elephant", "hand"}
    assert parts("grab", "official", ["s1/banana_eat_1"]) == {"s1/banana_eat_1": "train"}


@pytest.mark.parametrize("protocol", ["p1", "p2"])
def test_arctics_protocols_hold_out_s05_and_the_withheld_s03(protocol):
    assigned = parts("arctic", protocol, published("arctic").sequences)
    assert Counter(assigned.values()) == {"train": 267, "validation": 34, "test": 38}
    assert {name.split("/")[0] for name, part in assigned.items() if part == "validation"} == {"s05"}
    assert {name.split("/")[0] for name, part in assigned.items() if part == "test"} == {"s03"}


def test_bimart_tests_on_one_grab_and_three_use_sequences_of_each_of_eleven_objects():
    """BimArt, section 4: 257 training and 44 test sequences, four per object, one with grasping and relocation."""
    assigned = parts("arctic", "bimart", published("arctic").usable)
    assert Counter(assigned.values()) == {"train": 257, "test": 44}
    kinds = Counter(tuple(name.split("/")[1].split("_")[:2]) for name, part in assigned.items() if part == "test")
    objects = {name.split("/")[1].split("_")[0] for name in published("arctic").sequences}
    assert kinds == {(name, kind): count for name in objects for kind, count in (("grab", 1), ("use", 3))}
    assert len(objects) == 11


def test_bimarts_committed_list_follows_its_rule():
    def order(name: str) -> str:
        return hashlib.sha256(name.encode()).hexdigest()

    in_order = sorted(published("arctic").usable, key=order)
    chosen = set()
    for object_name in {name.split("/")[1].split("_")[0] for name in in_order}:
        chosen |= set([name for name in in_order if f"/{object_name}_grab_" in name][:1])
        chosen |= set([name for name in in_order if f"/{object_name}_use_" in name][:3])
    assert set(definitions_for("arctic")["bimart"].rule.test) == chosen


def test_bimart_as_released_tests_on_the_first_and_the_last_three_names_of_every_object():
    names = sorted(published("arctic").usable)
    assigned = parts("arctic", "bimart-released", names)
    assert Counter(assigned.values()) == {"train": 257, "test": 44}
    test_names = {name for name, part in assigned.items() if part == "test"}
    objects = {name.split("/")[1].split("_")[0] for name in names}
    by_object = [[name for name in names if f"/{item}_" in name] for item in objects]
    assert test_names == {name for members in by_object for name in (members[0], *members[-3:])}
    assert Counter(name[:3] for name in test_names) == {"s10": 21, "s01": 11, "s09": 11, "s08": 1}
    assert len(test_names & set(definitions_for("arctic")["bimart"].rule.test)) == 5


def test_bimart_with_a_validation_part_tests_on_the_same_and_validates_on_two_of_each_object():
    plain, validated = (definitions_for("arctic")[name].rule for name in ("bimart", "bimart-validated"))
    assert set(validated.test) == set(plain.test)
    assert set(validated.train) | set(validated.validation) == set(plain.train)
    assert Counter(name.split("/")[1].split("_")[0] for name in validated.validation) == dict.fromkeys(
        ARCTIC_OBJECTS | {"espressomachine"}, 2
    )


@pytest.mark.parametrize("dataset", ["h2o", "grab", "arctic", "manipnet"])
def test_held_out_objects_are_apart_from_training_and_each_part_has_some(dataset):
    validation, test = held_out(dataset, "unseen-object")
    assert validation
    assert test
    assert definitions_for(dataset)["unseen-object"].rule.train == "rest"
    assert "object" in definitions_for(dataset)["unseen-object"].promises


def test_every_verb_of_a_held_out_object_is_also_done_with_a_training_object():
    pairs = {"h2o": {}, "arctic": ARCTIC_PAIRS, "grab": GRAB_PAIRS}
    for verb, noun in ACTIONS[1:]:
        pairs["h2o"].setdefault(verb, set()).add(noun)
    for dataset, objects_of in pairs.items():
        unseen = {name for part in held_out(dataset, "unseen-object") for name in part}
        assert all(objects - unseen for objects in objects_of.values()), dataset
        assert unseen <= set.union(*objects_of.values()), dataset


@pytest.mark.parametrize("dataset", built_in_names())
def test_every_definition_says_its_source_its_version_and_its_promises(dataset):
    assigned = definitions_for(dataset)
    assert assigned
    for definition in assigned.values():
        assert definition.version >= 1
        assert len(definition.source) > 40
        if definition.rule.by in ("subject", "object"):
            assert definition.rule.by in definition.promises
            assert definition.rule.validation
            assert definition.rule.test
        if definition.rule.by in ("sequence", "prefix", "drawn", "drawn-per-object"):
            assert "sequence" in definition.promises


def test_a_split_that_several_datasets_have_is_from_the_same_source():
    for name in ("text2hoi", "unseen-object", "unseen-subject"):
        assigned = {
            (rules[name].version, rules[name].source) for d in built_in_names() if name in (rules := definitions_for(d))
        }
        assert len(assigned) == 1


def test_a_dataset_says_its_own_split_and_params_override_it():
    usual = {"h2o": "text2hoi", "grab": "text2hoi", "arctic": "text2hoi", "manipnet": "rounds"} | dict.fromkeys(
        ("taco", "hoi4d", "hot3d", "oakink2"), "drawn"
    )
    assert {name: choose(name, None).name for name in built_in_names()} == usual
    assert choose("grab", "official").name == "official"
    assert dataset_facts("mydata") is None


def test_a_split_with_nothing_said_of_its_source_is_refused(tmp_path, monkeypatch):
    folder = tmp_path / "kitchen"
    (folder / "splits").mkdir(parents=True)
    (folder / "adapter.py").touch()
    monkeypatch.setenv("HOIDATA_DATASETS", str(folder))
    for text in ('{"by": "time"}', "[]", "{"):
        (folder / "splits/ours.json").write_text(text)
        with pytest.raises(BadInput, match=r"kitchen/splits/ours.json"):
            definitions_for("kitchen")


def test_manipnet_has_the_splits_in_time_and_no_split_by_its_only_subject():
    assert set(definitions_for("manipnet")) == {"rounds", "time", "unseen-object", *OF_ANY_DATASET}


def test_an_unknown_name_lists_the_splits_of_that_dataset():
    with pytest.raises(
        BadInput,
        match=r"one of: bimart, bimart-released, bimart-validated, composition, .*drawn-per-object, p1, .*subject, got",
    ):
        choose("arctic", "rounds")
    for choice, got in (("text2hoi", "'text2hoi'"), (None, "nothing")):
        with pytest.raises(BadInput, match=f"one of: composition, drawn-object, drawn-per-object, got {got}"):
            choose("mydata", choice)


def test_a_rule_of_the_users_own_needs_no_name():
    values = {"by": "subject", "train": "rest", "test": ["p7"]}
    custom = choose("grab", values)
    assert custom.rule.as_json() == {**values, "validation": []}
    assert custom.promises == ("subject", "sequence", "file")
    assert choose("h2o", {"by": "rounds", "promises": ["subject"]}).promises == ("subject",)


def test_no_promise_is_made_that_cannot_be_checked():
    """Which raw files of an unknown dataset hold motion, and which are meshes that all may share, is not known."""
    values = {"by": "subject", "train": "rest", "test": ["p7"]}
    assert choose("mydata", values).promises == ("subject", "sequence")
    with pytest.raises(BadInput, match="promises that can be checked, got file"):
        choose("mydata", values | {"promises": ["file"]})


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        ({"by": "subject", "tset": ["s1"]}, "keys among: by, train, validation, test, .*got tset"),
        ({"train": "rest"}, "no `by`"),
        ({"by": "time", "test_share": "much"}, "shares and least_clips as numbers"),
        ({"by": "composition", "least_clips": "some"}, "shares and least_clips as numbers"),
        ({"by": "subject", "train": "rest", "promises": ["object", "luck"]}, "a list of: subject, object"),
        ({"by": "subject", "train": "rest", "promises": "object"}, "a list of: subject, object"),
        ({"by": "subject", "train": "rest", "test": "s1"}, "a list of names"),
    ],
)
def test_a_wrong_rule_says_what_it_may_hold(rule, message):
    with pytest.raises(BadInput, match=message):
        choose("grab", rule)
