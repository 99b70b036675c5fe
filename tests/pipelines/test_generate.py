"""What ``hoidata generate`` refuses before it generates, which models it takes, and what it says of a missing hinge."""

from collections.abc import Callable

import pytest
import trimesh
import yaml
from typer.testing import CliRunner

from hoidata.errors import BadInput, MissingResource
from hoidata.objects.user_mesh import read_user_object
from models.common.vocabulary import Vocabulary
from models.text2hoi.sampler import SamplingConfig
from pipelines.cli import app
from pipelines.generation import Asked, Models, _clips_with, _no_hinge, _of_project, chosen_model
from pipelines.stages.base import StagePaths
from tests.pipelines.conftest import PROJECT


@pytest.mark.parametrize("length", ["nan", "inf", "-inf", "1e308"])
def test_a_length_that_is_no_number_of_seconds(length: str, tmp_path) -> None:
    words = ["generate", "Lift a box.", "--object", "box", "--out", str(tmp_path / "out"), f"--length={length}"]
    found = CliRunner().invoke(app, words)
    assert isinstance(found.exception, BadInput)
    assert "--length: expected seconds" in str(found.exception)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["--seed=100000000000000000000", "--seed=-1", "--out={file}"])
def test_a_seed_no_array_holds_and_a_file_in_the_place_of_the_folder(option: str, tmp_path) -> None:
    file = tmp_path / "out"
    file.write_text("mine")
    words = ["generate", "Lift a box.", "--object", "box", "--out", str(tmp_path / "new"), option.format(file=file)]
    found = CliRunner().invoke(app, words)
    assert found.exit_code == 2
    assert file.read_text() == "mine"
    assert not (tmp_path / "new").exists()


IDLE = [
    (["--unit=cm"], "--unit"),
    (["--up=y", "--hinge=0,0,0 0,0,1"], "--up, --hinge"),
    (["--encoder=use"], "--encoder"),
    (["--models={folder}", "--model=grab"], "--model"),
    (["--models={folder}", "--profile=own"], "--profile"),
    (["--hand=left", "--hand-by=similarity"], "--hand-by"),
]


@pytest.mark.parametrize(("options", "named"), IDLE)
def test_an_option_that_would_change_nothing_is_refused(options, named, tmp_path) -> None:
    words = ["generate", "Lift a box.", "--object", "box", "--out", str(tmp_path / "out")]
    found = CliRunner().invoke(app, [*words, *(option.format(folder=tmp_path) for option in options)])
    assert isinstance(found.exception, BadInput)
    assert str(found.exception).startswith(f"{named}: expected")


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
def test_a_name_longer_than_a_file_may_have(words, tmp_path) -> None:
    found = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")])
    assert isinstance(found.exception, BadInput | MissingResource), found.output


def test_a_dataset_without_models_is_told_with_those_that_have_them(monkeypatch) -> None:
    monkeypatch.setattr(
        "pipelines.generation.why_not_trained", lambda paths: None if paths.dataset == "grab" else "not there"
    )
    with pytest.raises(MissingResource, match=r"embedded-nope: not there; models are there of grab$"):
        chosen_model(Asked("Lift a box.", "box", "embedded", ("h2o", "grab"), model="nope"), "lift", "box")
    with pytest.raises(MissingResource, match=r"embedded-h2o: not there$"):
        chosen_model(Asked("Lift a box.", "box", "embedded", ("h2o",)), "lift", "box")


@pytest.fixture
def three_datasets(monkeypatch) -> tuple[str, ...]:
    """Three trained datasets, by their clips of verb and noun, and by the objects they have."""
    counts = {
        "h2o": {("take out", "bottle", "left"): 9, ("open", "milk", "left"): 2},
        "grab": {("pour", "mug", "left"): 2, ("lift", "box", "right"): 1},
        "arctic": {("pour", "kettle", "right"): 3, ("open", "box", "right"): 4},
    }
    objects = {"h2o": {"bottle", "milk"}, "grab": {"mug"}, "arctic": {"kettle"}}
    monkeypatch.setattr("pipelines.generation.why_not_trained", lambda paths: None)
    monkeypatch.setattr("pipelines.generation._vocabulary", lambda path: Vocabulary(counts[path.name]))
    monkeypatch.setattr("pipelines.generation._has_object", lambda paths, name: name in objects[paths.dataset])
    return tuple(counts)


@pytest.mark.parametrize(
    ("verb", "thing", "name", "dataset"),
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
    verb: str | None, thing: str | None, name: str, dataset: str, three_datasets
) -> None:
    asked = Asked("", name, "embedded", three_datasets)
    paths, why = chosen_model(asked, verb, thing)
    assert paths.dataset == dataset
    assert ("clips of" in why) == (verb in ("pour", "open", "take out"))
    holder = next(
        (run for run in three_datasets if name in {"h2o": ("bottle", "milk"), "grab": ("mug",)}.get(run, ())), ""
    )
    expected = StagePaths("embedded", holder or ("arctic" if name == "kettle" else dataset))
    assert _clips_with(asked, paths) == expected.clips


@pytest.fixture
def models_of(tmp_path, monkeypatch) -> Callable[..., Models]:
    """What a project with such a params.yaml generates with; its hands and encoder are their names."""

    def found(profile: str, values: dict) -> Models:
        (tmp_path / "params.yaml").write_text(yaml.safe_dump(values))
        monkeypatch.setattr("pipelines.generation.chosen_model", lambda *_: (StagePaths(profile, "grab"), ""))
        return _of_project(Asked("Lift a box.", "box", profile=profile), "lift", "box")[0]

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pipelines.generation.load_hands", lambda profile: profile)
    monkeypatch.setattr("pipelines.generation.load_encoder", lambda name: name)
    return found


PARAMS = yaml.safe_load((PROJECT / "params.yaml").read_text())


def test_encoder_points_and_sampling_are_those_of_the_profile_that_is_asked_for(models_of) -> None:
    """But for half precision, which is slow on a CPU."""
    own = {
        "annotate": {"encoder": "hash"},
        "contact": {"points": 512},
        "sample": {"text2hoi": {"max_attempts": 1, "precision": "float16"}},
    }
    values = {**PARAMS, "profile": "embedded", "profiles": {"own": own}}
    found = [models_of(profile, values) for profile in ("embedded", "own")]
    assert [(one.hands, one.encoder, one.points) for one in found] == [("embedded", "use", 1024), ("own", "hash", 512)]
    assert [one.sampling.max_attempts for one in found] == [5, 1]
    assert {one.sampling.precision for one in found} == {"float32"}


@pytest.mark.parametrize("sample", [{"sample": None}, {}])
def test_a_section_sample_that_says_nothing(sample, models_of) -> None:
    values = {name: value for name, value in PARAMS.items() if name not in ("sample", "profiles")}
    assert models_of("embedded", values | sample).sampling == SamplingConfig()


HINGE = "0,0.05,0.021 -1,0,0"


@pytest.fixture
def box(tmp_path):
    """A box and its lid, which has a knob: three shells, two named nodes."""
    bottom, lid = trimesh.creation.box((0.1, 0.1, 0.04)), trimesh.creation.box((0.1, 0.1, 0.01))
    knob = trimesh.creation.icosphere(1, 0.01).apply_translation([0, 0, 0.06])
    lid = trimesh.util.concatenate([lid.apply_translation([0, 0, 0.03]), knob])
    path = tmp_path / "box.glb"
    trimesh.Scene({"bottom": bottom, "lid": lid}).export(path)
    return path


def notes(verb, path, hinge=""):
    return _no_hinge(verb, path, read_user_object(path, up="z", hinge=hinge).model)


@pytest.mark.parametrize("verb", ["open", "close"])
def test_a_mesh_of_two_pieces_without_a_hinge_says_so_and_names_the_option(box, verb):
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
    assert _no_hinge("open", "box", read_user_object(box, up="z").model)[0].endswith("choose one that has")


def test_nothing_is_said_of_a_mesh_with_its_hinge_or_of_a_verb_that_turns_none(box):
    assert not notes("open", box, HINGE)
    assert not notes("lift", box)
    assert not notes(None, box)
