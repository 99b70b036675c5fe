"""``hoidata generate``: refused input, the choice of models, and the note on a missing hinge."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh
import yaml
from typer.testing import CliRunner

from hoidata.annotation.vocabulary import Vocabulary
from hoidata.annotation.wording import Wording
from hoidata.errors import BadInput, MissingResource
from hoidata.objects.user_mesh import read_user_object
from models.common.checkpoints import FILE_NAME
from models.text2hoi.generation import MotionOptions
from models.text2hoi.sampler import SamplingConfig
from pipelines import generation
from pipelines.cli import app
from pipelines.command_inputs import object_name
from pipelines.generation import (
    GenerationRequest,
    Models,
    _dataset_with_object,
    _further_verb_notes,
    _missing_hinge_notes,
    _networks,
    _project_models,
    chosen_model,
    why_not_trained,
)
from pipelines.stages.base import StagePaths
from tests.pipelines.conftest import PROJECT


@pytest.mark.parametrize("length", ["nan", "inf", "-inf", "1e308"])
def test_a_length_that_is_not_a_number_of_seconds_is_refused(length: str, tmp_path) -> None:
    words = ["generate", "Lift a box.", "--object", "box", "--out", str(tmp_path / "out"), f"--length={length}"]
    result = CliRunner().invoke(app, words)
    assert isinstance(result.exception, BadInput)
    assert "--length: expected seconds" in str(result.exception)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["--seed=100000000000000000000", "--seed=-1", "--out={file}"])
def test_a_seed_out_of_range_and_a_file_as_output_folder_are_refused(option: str, tmp_path) -> None:
    file = tmp_path / "out"
    file.write_text("mine")
    words = ["generate", "Lift a box.", "--object", "box", "--out", str(tmp_path / "new"), option.format(file=file)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert file.read_text() == "mine"
    assert not (tmp_path / "new").exists()


INEFFECTIVE = [
    (["--unit=cm"], "--unit"),
    (["--up=y", "--hinge=0,0,0 0,0,1"], "--up, --hinge"),
    (["--encoder=use"], "--encoder"),
    (["--models={folder}", "--model=grab"], "--model"),
    (["--models={folder}", "--profile=own"], "--profile"),
    (["--hand=left", "--hand-by=similarity"], "--hand-by"),
]


@pytest.mark.parametrize(("options", "named"), INEFFECTIVE)
def test_an_option_without_effect_is_refused(options, named, tmp_path) -> None:
    words = ["generate", "Lift a box.", "--object", "box", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, [*words, *(option.format(folder=tmp_path) for option in options)])
    assert isinstance(result.exception, BadInput)
    assert str(result.exception).startswith(f"{named}: expected")


LONG = "b" * 300


@pytest.mark.parametrize(
    "words",
    [
        ["generate", "Lift a box.", "--object", LONG],
        ["animate", LONG],
        ["hands", LONG],
    ],
    ids=["generate", "animate", "hands"],
)
def test_a_name_longer_than_a_file_name_may_be_is_refused(words, tmp_path) -> None:
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")])
    assert isinstance(result.exception, BadInput | MissingResource), result.output


def test_a_dataset_without_models_is_refused_with_a_list_of_those_that_have_them(monkeypatch) -> None:
    monkeypatch.setattr(
        "pipelines.generation.why_not_trained",
        lambda paths, networks: None if paths.dataset == "grab" else "not there",
    )
    with pytest.raises(MissingResource, match=r"embedded-nope: not there; these datasets have models: grab$"):
        chosen_model(GenerationRequest("Lift a box.", "box", "embedded", ("h2o", "grab"), model="nope"), "lift", "box")
    with pytest.raises(MissingResource, match=r"embedded-h2o: not there$"):
        chosen_model(GenerationRequest("Lift a box.", "box", "embedded", ("h2o",)), "lift", "box")


@pytest.fixture
def three_datasets(monkeypatch) -> tuple[str, ...]:
    """Three trained datasets with their vocabularies and the names of their objects."""
    counts = {
        "h2o": {("take out", "bottle", "left"): 9, ("open", "milk", "left"): 2},
        "grab": {("pour", "mug", "left"): 2, ("lift", "box", "right"): 1},
        "arctic": {("pour", "kettle", "right"): 3, ("open", "box", "right"): 4},
    }
    objects = {"h2o": {"bottle", "milk"}, "grab": {"mug"}, "arctic": {"kettle"}}
    monkeypatch.setattr("pipelines.generation.why_not_trained", lambda paths, networks: None)
    monkeypatch.setattr("pipelines.generation._vocabulary", lambda path: Vocabulary(counts[path.name]))
    monkeypatch.setattr("pipelines.generation._has_object", lambda paths, name: name in objects[paths.dataset])
    return tuple(counts)


@pytest.mark.parametrize(
    ("verb", "noun", "name", "dataset"),
    [
        ("pour", "bottle", "file.stl", "arctic"),  # no dataset pours from a bottle, and arctic pours most
        ("pour", "mug", "file.stl", "grab"),
        ("pour", "milk bottle", "bottle", "arctic"),  # of two that pour neither has the object
        ("pour", None, "mug", "grab"),
        ("pour", "kettle", "mug", "grab"),
        ("open", "box", "milk", "h2o"),
        ("open", None, "file.stl", "arctic"),
        (None, "milk", "file.stl", "h2o"),
        ("take out", "box", "kettle", "h2o"),
        ("juggle", None, "kettle", "arctic"),
    ],
)
def test_the_verb_chooses_the_models_then_the_named_object_then_the_noun(
    verb: str | None, noun: str | None, name: str, dataset: str, three_datasets
) -> None:
    request = GenerationRequest("", name, "embedded", three_datasets)
    paths, reason = chosen_model(request, verb, noun)
    assert paths.dataset == dataset
    assert ("clips of" in reason) == (verb in ("pour", "open", "take out"))
    holder = next(
        (
            dataset_name
            for dataset_name in three_datasets
            if name in {"h2o": ("bottle", "milk"), "grab": ("mug",)}.get(dataset_name, ())
        ),
        "",
    )
    expected = StagePaths("embedded", holder or ("arctic" if name == "kettle" else dataset))
    assert _dataset_with_object(request, paths) == expected


def test_a_second_action_that_only_other_models_know_is_named(three_datasets) -> None:
    request = GenerationRequest("Open the box, take out the bottle and pour.", "box", "embedded", three_datasets)
    (note,) = _further_verb_notes(request, Wording(request.text, "open", "box"))
    assert note == "a motion shows one action: this one shows 'open', not 'take out', 'pour'; generate each alone"
    assert not _further_verb_notes(replace(request, model="grab"), Wording("Pour and open.", "pour", None))


@pytest.fixture
def models_of(tmp_path, monkeypatch) -> Callable[..., Models]:
    """The models that a project with a given params.yaml uses; hands and encoder are replaced by their names."""

    def load(profile: str, values: dict) -> Models:
        (tmp_path / "params.yaml").write_text(yaml.safe_dump(values))
        monkeypatch.setattr("pipelines.generation.chosen_model", lambda *_: (StagePaths(profile, "grab"), ""))
        return _project_models(GenerationRequest("Lift a box.", "box", profile=profile), "lift", "box")[0]

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pipelines.generation.load_hands", lambda profile: profile)
    monkeypatch.setattr("pipelines.generation.load_encoder", lambda name: name)
    return load


@pytest.mark.parametrize(
    ("name", "ups"), [("mug", None), ("kettle", "ups of arctic"), ("file.stl", None)], ids=["own", "other", "file"]
)
def test_what_is_up_for_an_object_of_another_dataset_comes_from_that_dataset(
    name: str, ups: str | None, three_datasets, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "params.yaml").write_text((PROJECT / "params.yaml").read_text())
    monkeypatch.setattr("pipelines.generation.load_encoder", lambda name: name)
    monkeypatch.setattr("pipelines.generation._object_ups", lambda paths: f"ups of {paths.dataset}")
    models, _ = _project_models(GenerationRequest("", name, "embedded", three_datasets, model="grab"), "pour", None)
    assert models.object_ups == ups


PARAMS = yaml.safe_load((PROJECT / "params.yaml").read_text())


def test_encoder_points_and_sampling_are_those_of_the_requested_profile(models_of) -> None:
    overlay = {
        "annotate": {"encoder": "hash"},
        "contact": {"points": 512},
        "sample": {"text2hoi": {"attempts": 3, "refine": "contact"}},
    }
    values = {**PARAMS, "profile": "embedded", "profiles": {"own": overlay}}
    models = [models_of(profile, values) for profile in ("embedded", "own")]
    assert [(entry.hands, entry.encoder, entry.points) for entry in models] == [
        ("embedded", "use", 1024),
        ("own", "hash", 512),
    ]
    assert [(entry.sampling.attempts, entry.sampling.refine) for entry in models] == [(1, "network"), (3, "contact")]


@pytest.mark.parametrize("sample", [{"sample": None}, {}])
def test_an_empty_section_sample_gives_the_defaults(sample, models_of) -> None:
    values = {name: value for name, value in PARAMS.items() if name not in ("sample", "profiles")}
    assert models_of("embedded", values | sample).sampling == SamplingConfig()


HINGE = "0,0.05,0.021 -1,0,0"


@pytest.fixture
def box(tmp_path):
    """The path of a mesh of a box and its lid with a knob: three shells, two named nodes."""
    bottom, lid = trimesh.creation.box((0.1, 0.1, 0.04)), trimesh.creation.box((0.1, 0.1, 0.01))
    knob = trimesh.creation.icosphere(1, 0.01).apply_translation([0, 0, 0.06])
    lid = trimesh.util.concatenate([lid.apply_translation([0, 0, 0.03]), knob])
    path = tmp_path / "box.glb"
    trimesh.Scene({"bottom": bottom, "lid": lid}).export(path)
    return path


def notes(verb, path, hinge=""):
    return _missing_hinge_notes(verb, path, read_user_object(path, up="z", hinge=hinge).model)


@pytest.mark.parametrize("verb", ["open", "close", "open and close"])
def test_the_note_on_a_mesh_of_two_pieces_without_a_hinge_names_the_option(box, verb):
    (note,) = notes(verb, box)
    assert note.startswith(
        f"{verb!r} turns a hinge, but the object has none: the mesh has two pieces ('bottom' and 'lid')"
    )
    assert '--hinge "px,py,pz dx,dy,dz"' in note


def test_pieces_without_names_are_not_named(tmp_path):
    boxes = [trimesh.creation.box((0.1, 0.1, 0.04)).apply_translation([0, 0, height]) for height in (0, 0.06)]
    trimesh.util.concatenate(boxes).export(tmp_path / "box.ply")
    assert "the mesh has two pieces; add --hinge" in notes("open", tmp_path / "box.ply")[0]


def test_a_mesh_of_one_piece_needs_another_mesh(tmp_path):
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "cube.ply")
    assert "it needs a mesh of two objects or nodes" in notes("open", tmp_path / "cube.ply")[0]


def test_a_rigid_object_of_a_dataset_needs_another_object(box):
    assert _missing_hinge_notes("open", "box", read_user_object(box, up="z").model)[0].endswith("choose one that has")


def test_a_mesh_with_a_hinge_and_a_verb_that_turns_none_give_no_note(box):
    assert not notes("open", box, HINGE)
    assert not notes("lift", box)
    assert not notes(None, box)


def test_a_request_needs_only_the_networks_that_it_uses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "params.yaml").write_text((PROJECT / "params.yaml").read_text())
    request = GenerationRequest("Lift a box.", "box", "embedded", ("grab",))
    given_length = replace(request, options=MotionOptions(frames=9))
    needed = {
        "length": (request, ["contact", "diffusion", "length", "refiner"]),
        "no length": (given_length, ["contact", "diffusion", "refiner"]),
        "contact refinement": (replace(request, sampling={"refine": "contact"}), ["contact", "diffusion", "length"]),
        "neither": (replace(given_length, sampling={"refine": "none"}), ["contact", "diffusion"]),
    }
    assert {name: _networks(request) for name, (request, _) in needed.items()} == {
        name: networks for name, (_, networks) in needed.items()
    }
    paths = StagePaths("embedded", "grab")
    for name in ("contact", "diffusion"):
        (paths.checkpoints / name).mkdir(parents=True)
        (paths.checkpoints / name / FILE_NAME).touch()
    assert "length" in (why_not_trained(paths, needed["length"][1]) or "")
    assert "refiner" in (why_not_trained(paths, needed["no length"][1]) or "")
    assert why_not_trained(paths, needed["neither"][1]) is None


def test_networks_of_different_presets_are_named(monkeypatch):
    names = ["contact", "length", "diffusion", "refiner"]

    def info(path: Path) -> dict:
        name = path.parent.name
        preset = presets.get(name, "ours")
        params = dict.fromkeys((f"train.{preset}.{name}", "train.seed", f"train.small.{name}"))
        return {"provenance": {"stage": "train", "stages": {"train": {"params": params}}}}

    monkeypatch.setattr(generation, "read_info", info)
    presets = {}
    assert generation._preset_notes(Path(), names) == []
    presets = {"refiner": "paper"}
    (note,) = generation._preset_notes(Path(), names)
    assert "contact ours small, length ours small, diffusion ours small, refiner paper small" in note


@pytest.mark.parametrize(
    ("typed", "name"),
    [
        ("waterbottle", "waterbottle"),
        ("bottle", "waterbottle"),
        ("Water bottle", "waterbottle"),
        ("cube", "cube"),
        ("medium", "medium"),
        ("cup", "cup"),
        ("teacup", "teacup"),
        ("", ""),
        ("-", "-"),
    ],
)
def test_an_object_is_found_by_the_end_of_its_name_if_it_is_the_only_one(typed: str, name: str) -> None:
    names = ["bluecube", "redcube", "cubemedium", "spheremedium", "waterbottle", "cup", "eggcup"]
    assert object_name(typed, names) == name
