"""Training and generation on the toy dataset, and the contents of their files."""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from safetensors import safe_open
from torch import nn

from hoidata.actions.action import Actions
from hoidata.annotation.encoders import load_encoder
from hoidata.batches.dataset import ClipBatch, HoiDataset
from hoidata.clips.clip import ObjectTrack
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.metrics.verb_ranges import VerbRanges
from hoidata.object_paths.mesh_frame import Z, turned
from hoidata.objects.model import ObjectModel
from hoidata.objects.user_mesh import read_user_object
from hoidata.store.annotated import AnnotatedStore
from models.common.checkpoints import _config, load_checkpoint, save_checkpoint
from models.common.corpus import Corpus, batches
from models.common.repeatable import make_repeatable
from models.common.sampling import SamplerConfig
from models.common.training import TrainingConfig, fit, learning_rate_factor, train_network
from models.registry import load_network
from models.text2hoi.diffusion import MotionGenerator
from models.text2hoi.generation import GeneratedMotion, Generator, MotionOptions
from models.text2hoi.sampler import SamplingConfig
from pipelines.command_inputs import stored_object
from pipelines.generation import GenerationRequest, Models, _object_ups, generate_files
from pipelines.stages.base import StagePaths
from tests.builders.urdf import write_laptop
from tests.models.toy import PARAMS, train


def test_a_checkpoint_has_one_metadata_key_with_facts_about_its_training(trained: Path) -> None:
    for name in PARAMS:
        with safe_open(trained / name / "model.safetensors", framework="pt") as stored:
            assert list(stored.metadata()) == ["hoidata"]
            info = json.loads(stored.metadata()["hoidata"])
        facts = info["facts"]
        assert facts["clips"] == {"train": ["toy/s1/0", "toy/s1/1", "toy/s1/2"], "validation": ["toy/s2/3", "toy/s2/4"]}
        assert facts["datasets"] == {"toy": 3}
        assert facts["synthetic"] is True
        assert facts["hand_digest"] == load_embedded_hands().digest
        assert facts["encoder"] == load_encoder("hash").identity
        assert info["provenance"] == {"model": name}


def test_saving_what_was_loaded_gives_the_same_bytes_every_time(trained: Path, tmp_path: Path) -> None:
    original = (trained / "diffusion" / "model.safetensors").read_bytes()
    for number in range(3):
        loaded = load_checkpoint(trained / "diffusion", load_network("diffusion"))
        info = {key: value for key, value in loaded.info.items() if key not in ("format", "model", "config")}
        again = save_checkpoint(tmp_path / str(number), "diffusion", loaded.network, loaded.normaliser, info)
        assert again.read_bytes() == original


def test_the_log_has_training_and_validation_losses(trained: Path) -> None:
    header, *lines = (trained / "diffusion" / "log.csv").read_text().splitlines()
    expected = "step,validation,train_total,train_simple,train_distance_map,train_relative_orientation"
    assert header == expected
    assert [line.split(",")[0] for line in lines] == ["1", "2"]


def test_a_wrong_or_missing_checkpoint_is_named(trained: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no file"):
        load_checkpoint(tmp_path, load_network("contact"))
    with pytest.raises(BadInput, match="one of length"):
        load_checkpoint(trained / "length", load_network("contact"))
    broken = tmp_path / "model.safetensors"
    broken.write_bytes(b"not a checkpoint")
    with pytest.raises(BadInput, match="a checkpoint of hoidata"):
        load_checkpoint(tmp_path, load_network("contact"))


def test_a_trained_network_stores_the_verbs_of_its_training_clips(trained: Path) -> None:
    for name in ("length", "diffusion"):
        network = load_checkpoint(trained / name, load_network(name)).network
        assert network.config.verbs == ("lift", "open", "pass")


def test_a_checkpoint_with_an_unknown_setting_must_be_trained_again(trained: Path, tmp_path: Path) -> None:
    stored = load_checkpoint(trained / "contact", load_network("contact"))
    stored.info["config"]["network_of_old"] = True
    with pytest.raises(BadInput, match=r"network_of_old.*again with this version"):
        _config(load_network("contact"), stored.info, tmp_path)


def test_unknown_settings_are_refused_with_the_known_ones(annotated_root: Path, tmp_path: Path) -> None:
    length, diffusion = load_network("length"), load_network("diffusion")
    with pytest.raises(BadInput, match="learning_rate"):
        train_network(length, annotated_root, tmp_path, {"training": {"stepz": 3}})
    with pytest.raises(BadInput, match="network"):
        train_network(length, annotated_root, tmp_path, {"optimizer": {}})
    with pytest.raises(BadInput, match="contact"):
        load_network("ponytail")
    with pytest.raises(BadInput, match="none of contact"):
        train_network(diffusion, annotated_root, tmp_path, {})


def test_without_clips_the_reason_is_written(trained: Path, tmp_path: Path) -> None:
    root, out = tmp_path / "data", tmp_path / "out"
    (root / "clips").mkdir(parents=True)
    (root / "clips" / "empty.json").write_text('{"reason":"grab is not present"}')
    for name in ("contact", "diffusion"):
        assert json.loads(train(name, root, out).read_text()) == {"reason": "grab is not present"}


def user_box() -> ObjectModel:
    mesh = trimesh.creation.box((0.05, 0.08, 0.1))
    return ObjectModel("my box", mesh.vertices, mesh.faces, np.zeros(8, np.uint8))


def motion(trained: Path, text: str, seed: int) -> GeneratedMotion:
    return generator(trained).generate(text, user_box(), MotionOptions(seed))[0]


def generator(trained: Path) -> Generator:
    return Generator.load(trained, load_embedded_hands(), load_encoder("hash"))


@pytest.fixture
def request_for(trained: Path, tmp_path: Path) -> Callable[..., GenerationRequest]:
    """A function that returns a request for a sentence: 8 frames with a box from a mesh file."""
    trimesh.creation.box((0.05, 0.08, 0.1)).export(tmp_path / "box.stl")
    models = Models(trained, load_embedded_hands(), load_encoder("hash"))
    usual = GenerationRequest("", tmp_path / "box.stl", models=models, options=MotionOptions(frames=8))
    return lambda text, **changes: replace(usual, text=text, **changes)


def bytes_of(motion: GeneratedMotion) -> bytes:
    arrays = [motion.contact, motion.clip.object.rotvec, motion.clip.object.translation_m]
    for track in motion.clip.hands.values():
        arrays += [track.wrist_m, track.global_orient, track.hand_pose, track.betas, track.valid]
    return b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)


@pytest.mark.slow
def test_generation_is_reproducible_and_uses_only_the_requested_hands(trained: Path) -> None:
    generated = motion(trained, "Lift a box with the right hand.", 3)
    assert bytes_of(generated) == bytes_of(motion(trained, "Lift a box with the right hand.", 3))
    assert bytes_of(generated) != bytes_of(motion(trained, "Lift a box with the right hand.", 4))
    assert generated.clip.hands["right"].valid.all()
    assert not generated.clip.hands["left"].valid.any()
    assert generated.clip.dataset == "generated"
    assert generated.clip.synthetic
    assert generated.evidence["hand"]["source"] == "rule"


@pytest.mark.slow
def test_a_sample_does_not_depend_on_their_number_and_lengths_are_sampled(trained: Path) -> None:
    model, text = generator(trained), "Lift a box with the right hand."
    many = model.generate(text, user_box(), MotionOptions(samples=6))
    assert bytes_of(many[0]) == bytes_of(model.generate(text, user_box())[0])
    assert len({bytes_of(generated) for generated in many}) == 6
    assert len({generated.clip.n_frames for generated in many}) > 1
    assert {
        generated.clip.n_frames for generated in model.generate(text, user_box(), MotionOptions(samples=2, frames=20))
    } == {20}


def test_options_take_precedence_over_the_sentence(trained: Path) -> None:
    generated = generator(trained).generate(
        "Lift a box with the right hand.", user_box(), MotionOptions(hand="left", frames=9)
    )[0]
    assert generated.clip.hands["left"].valid.all()
    assert not generated.clip.hands["right"].valid.any()
    with pytest.raises(BadInput, match="8 to 150 frames"):
        generator(trained).generate("Lift a box.", user_box(), MotionOptions(frames=151))


def test_generation_uses_the_models_settings_except_for_given_options(
    request_for, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options, load, sample, denoisers = dict[str, Any](), Generator.load, MotionGenerator.sample, []
    monkeypatch.setattr(
        MotionGenerator, "sample", lambda self, *inputs: denoisers.append(inputs[1]) or sample(self, *inputs)
    )
    monkeypatch.setattr(Generator, "load", lambda *arguments, **more: options.update(more) or load(*arguments, **more))
    sampling = SamplingConfig(SamplerConfig("dpm++", 3))
    models = Models(trained, load_embedded_hands(), load_encoder("hash"), sampling=sampling, points=256)
    generate_files(request_for("Lift a box.", models=models, sampler={"steps": 2}), tmp_path / "out")
    assert options == {"sampling": sampling, "points": 256}
    assert denoisers == [SamplerConfig("dpm++", 2)]
    generated = load(trained, models.hands, models.encoder, **options).generate(
        "Lift a box.", user_box(), MotionOptions(frames=8)
    )[0]
    assert generated.contact.shape == (256,)


def test_a_mesh_file_whose_name_is_no_text_is_read_and_its_name_stays_legible(request_for, tmp_path: Path) -> None:
    mesh = Path(os.fsdecode(os.fsencode(tmp_path) + b"/b\xffx.stl"))
    (tmp_path / "box.stl").rename(mesh)
    generate_files(request_for("Lift a box.", object=mesh), tmp_path / "out")
    assert (tmp_path / "out/index.html").is_file()
    assert read_user_object(mesh).model.name == "b\\udcffx"


@pytest.mark.parametrize(
    ("refine", "frames", "used"),
    [
        ("contact", None, {"contact", "diffusion", "length"}),
        ("none", 8, {"contact", "diffusion"}),
        ("network", 8, {"contact", "diffusion", "refiner"}),
    ],
)
def test_a_motion_lists_exactly_the_networks_that_generated_it(
    request_for, trained: Path, tmp_path: Path, refine: str, frames: int | None, used: set[str]
) -> None:
    options = MotionOptions(frames=frames)
    generate_files(request_for("Lift a box.", options=options, sampling={"refine": refine}), tmp_path / "out")
    named = json.loads(str(np.load(tmp_path / "out" / "motion.npz")["checkpoints"]))
    files = {name: trained / name / "model.safetensors" for name in PARAMS}
    digests = {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in files.items()}
    assert named == {str(files[name]): digests[name] for name in used}
    page = (tmp_path / "out" / "index.html").read_text()
    assert {name for name, digest in digests.items() if f"{name} {digest[:12]}" in page} == used


def test_unseen_words_are_reported(trained: Path) -> None:
    generated = generator(trained).generate(
        "Juggle three oranges with both hands.", user_box(), MotionOptions(frames=8)
    )[0]
    assert "the verb 'juggle' was never in training" in generated.evidence["unseen"][0]
    assert generated.evidence["verb"] is None


def test_training_verbs_are_parsed(trained: Path) -> None:
    sentences = {"lift": "Lift a box with the left hand.", "pass": "Pass a box with the right hand."}
    for verb, text in sentences.items():
        generated = generator(trained).generate(text, user_box(), MotionOptions(frames=8))[0]
        assert generated.evidence["verb"] == verb


def test_a_second_action_of_a_sentence_is_reported_as_missing(request_for, tmp_path: Path) -> None:
    request = request_for("Lift a box and pass it with the left hand.")
    note = "a motion shows one action: this one shows 'lift', not 'pass'; generate each alone"
    assert note in generate_files(request, tmp_path / "out").notes


def test_an_unknown_word_is_refused_unless_forced(request_for, tmp_path: Path) -> None:
    def notes(text: str, force: bool = False) -> list[str]:
        return generate_files(request_for(text, force=force), tmp_path / "out").notes

    for text in ("Throw the ball with the left hand.", "Juggle a box with both hands."):
        with pytest.raises(
            BadInput, match=r"a verb that the models were trained on \(lift, open, pass\), got '\w+'; name"
        ):
            notes(text)
        assert not (tmp_path / "out").exists()
    assert "'Lfit' is read as 'lift'" in notes("Lfit the box with the left hand.")
    with pytest.raises(BadInput, match=r"got 'bax'; did you mean 'box'"):
        notes("Lift the bax with the left hand.")
    assert any(
        "'throw' was never in training" in note for note in notes("Throw the ball with the left hand.", force=True)
    )


def test_a_hand_that_the_sentence_does_not_name_is_reported(request_for, tmp_path: Path) -> None:
    notes = {
        text: [note for note in generate_files(request_for(text), tmp_path / "out").notes if "hand:" in note]
        for text in ("Lift it.", "Lift it with the left hand.")
    }
    assert notes["Lift it with the left hand."] == []
    assert notes["Lift it."] == [
        "hand: left, since no hand is named; left in 33% of the training clips (--hand chooses another)"
    ]


def test_an_open_mesh_and_a_repaired_one_are_reported(request_for, tmp_path: Path) -> None:
    box = trimesh.creation.box((0.05, 0.08, 0.1))
    inside_out = trimesh.Trimesh(box.vertices, box.faces[:, ::-1], process=False)
    meshes = {"open": trimesh.Trimesh(box.vertices, box.faces[:-2], process=False), "turned": inside_out, "whole": box}
    notes = {}
    for name, mesh in meshes.items():
        mesh.export(tmp_path / f"{name}.obj")
        request = request_for("Lift a box with the left hand.", object=tmp_path / f"{name}.obj")
        notes[name] = [note for note in generate_files(request, tmp_path / "out").notes if note.startswith("mesh: ")]
    assert notes == {
        "open": [
            "mesh: open has no inside: it is open; hands are attracted to its surface, but penetration is not prevented"
        ],
        "turned": ["mesh: turned: triangles turned outward"],
        "whole": [],
    }


@pytest.mark.long
def test_visible_differences_are_reported_and_the_page_has_the_others(
    request_for, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = request_for("Lift a box with the left hand.", sampling={"attempts": 5})
    monkeypatch.setattr("hoidata.metrics.verdict.STILL_M", 0.0)
    monkeypatch.setattr(Actions, "usual", {"lift": {"rise_m": (0.0, 1.0)}}, raising=False)
    monkeypatch.setattr(VerbRanges, "rank", lambda *_: (1, 0.0, 0.0))
    monkeypatch.setattr(Actions, "unusual", lambda self, verb, numbers: ("rise_m 9 (usual: 0 to 1)", "path_m 8"))
    notes = {}
    for verb in ("lift", "open"):
        monkeypatch.setattr(Actions, "nearest_verb", lambda self, numbers, verb=verb: verb)
        for visible in ((), ("rise_m 9 (usual: 0 to 1)",)):
            monkeypatch.setattr(Actions, "visibly_unusual", lambda self, verb, numbers, visible=visible: visible)
            lines = generate_files(request, tmp_path / verb).verdict
            assert lines[0].startswith("sample 1: ")
            notes[verb, len(visible)] = lines[-1].strip()
    passed = "ok: does the verb: 1 measures of motion are in or near their range of the training clips"
    assert notes == {
        ("lift", 0): passed,
        ("lift", 1): "FAILS: does the verb: unlike 'lift' in training: rise_m 9 (usual: 0 to 1)",
        ("open", 0): passed,
        ("open", 1): "FAILS: does the verb: unlike 'lift' in training, more like 'open': rise_m 9 (usual: 0 to 1)",
    }
    page = (tmp_path / "open" / "index.html").read_text()
    assert "the best of 5 motions" in page
    assert "sample 1: motion classified as &#39;open&#39;, rise_m 9 (usual: 0 to 1), path_m 8" in page


def test_a_generated_clip_is_finite_and_starts_with_the_object_at_the_origin(trained: Path) -> None:
    generated = motion(trained, "Pass a box with both hands.", 0)
    np.testing.assert_array_equal(generated.clip.object.translation_m[0], 0)
    np.testing.assert_array_equal(generated.clip.gravity, [0, 0, -1])
    for side, track in generated.clip.hands.items():
        assert track.valid.all()
        assert np.isfinite(track_joints(track, load_embedded_hands()[side])).all()
    assert generated.contact.shape == (1024,)
    assert len(generated.clip.source_frames) == generated.evidence["frames"] >= 8


def test_own_meshes_get_the_axis_up_that_was_up_in_training(trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A z-up mesh moves as the same mesh in the frame of training, whose up axis is y."""
    monkeypatch.setattr(Generator, "object_ups", {"a": [0.0, 1.0, 0.0], "b": [0.1, 0.99, 0.0], "c": [0.0, 0.0, 1.0]})
    z_up, text, options = user_box(), "Lift a box with the left hand.", MotionOptions(frames=8)
    y_up = replace(z_up, vertices_m=z_up.vertices_m[:, [0, 2, 1]] * [1, 1, -1])
    generated = generator(trained).generate(text, z_up, options)[0]
    expected = generator(trained).generate(text, y_up, options, up=None)[0]
    world_m, expected_m = (
        one.clip.object.points_in_world(one.clip.object.model.vertices_m, z_up.part) for one in (generated, expected)
    )
    np.testing.assert_allclose(world_m, expected_m, atol=1e-4)
    np.testing.assert_allclose(generated.clip.hands["left"].wrist_m, expected.clip.hands["left"].wrist_m, atol=1e-4)
    np.testing.assert_allclose(
        generated.points.points_m[:, [0, 2, 1]] * [1, 1, -1], expected.points.points_m, atol=1e-5
    )
    assert generated.clip.object.model is z_up
    assert next(check for check in expected.verdict if check.name == "stands upright").passed is None


@pytest.mark.parametrize("of_dataset", [False, True], ids=["user mesh", "object of the dataset"])
def test_generate_takes_user_meshes_as_z_up_and_keeps_the_frame_of_dataset_objects(
    of_dataset: bool,
    request_for,
    trained: Path,
    annotated_root: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Generator, "object_ups", {"a": [0.0, 1.0, 0.0]})
    models = Models(trained, load_embedded_hands(), load_encoder("hash"), annotated_root / "clips")
    request = request_for("Lift a box with the left hand.", models=models)
    model = read_user_object(tmp_path / "box.stl").model
    if of_dataset:
        request = replace(request, object="box")
        model = stored_object("box", annotated_root / "clips", models.hands)
    generate_files(request, tmp_path / "out")
    expected = (
        generator(trained).generate(request.text, model, request.options, up=None if of_dataset else Z)[0].clip.object
    )
    np.testing.assert_array_equal(np.load(tmp_path / "out" / "motion.npz")["object_rotvec"], expected.rotvec)


def test_an_object_of_another_dataset_is_turned_upright_by_what_is_up_there_or_a_note_says_that_it_is_not_known(
    request_for, trained: Path, annotated_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Generator, "object_ups", {"a": [0.0, 1.0, 0.0]})
    clips = annotated_root / "clips"
    stored = stored_object("box", clips, load_embedded_hands())
    z_from_x = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    upright = {True: turned(stored, z_from_x), False: stored}
    for is_known, model in upright.items():
        ups = {"box": [0.99, 0.1, 0.0]} if is_known else {}
        models = Models(trained, load_embedded_hands(), load_encoder("hash"), clips, object_ups=ups)
        request = replace(request_for("Lift a box with the left hand.", models=models), object="box")
        written = generate_files(request, tmp_path / f"{is_known}")
        up = Z if is_known else None
        expected = generator(trained).generate(request.text, model, request.options, up=up)[0]
        arrays = np.load(tmp_path / f"{is_known}" / "motion.npz")
        track = replace(
            expected.clip.object, model=stored, rotvec=arrays["object_rotvec"], hinge_rad=arrays.get("object_hinge_rad")
        )
        world_m = track.points_in_world(stored.vertices_m, stored.part)
        expected_m = expected.clip.object.points_in_world(model.vertices_m, model.part)
        np.testing.assert_allclose(world_m, expected_m, atol=1e-4)
        assert any("it may not stand upright" in note for note in written.notes) == (not is_known)
        assert any("degrees from upright" in line for line in written.verdict) == is_known


def test_the_joint_of_a_urdf_stays_within_its_limits_and_opens_in_its_direction(
    request_for, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lid that opens to negative angles moves as one with the opposite axis that opens to positive angles."""
    vertices_m, notes = {}, {}
    for name, axis, limits in (
        ("up", "-1 0 0", (0, 0.001)),
        ("down", "1 0 0", (-0.001, 0)),
        ("wide", "1 0 0", (-3, 1)),
    ):
        text = write_laptop(tmp_path / name).read_text()
        text = text.replace('axis xyz="-1 0 0"', f'axis xyz="{axis}"')
        text = text.replace('lower="0" upper="2"', f'lower="{limits[0]}" upper="{limits[1]}"')
        (tmp_path / name / "laptop.urdf").write_text(text)
        request = request_for("Open a laptop with the left hand.")
        notes[name] = generate_files(
            replace(request, object=tmp_path / name / "laptop.urdf", force=True), tmp_path / f"{name} out"
        ).notes
        arrays = np.load(tmp_path / f"{name} out" / "motion.npz")
        hinge_rad = arrays["object_hinge_rad"]
        assert limits[0] - 1e-6 <= hinge_rad.min() < hinge_rad.max() <= limits[1] + 1e-6
        assert (hinge_rad >= 0).all() == (name == "up")
        model = read_user_object(tmp_path / name / "laptop.urdf").model
        np.testing.assert_allclose(arrays["object_hinge_axis"], model.hinge.axis)
        track = ObjectTrack(model, arrays["object_rotvec"], arrays["object_translation_m"], hinge_rad)
        vertices_m[name] = track.points_in_world(model.vertices_m, model.part)
    np.testing.assert_allclose(vertices_m["down"], vertices_m["up"], atol=1e-6)
    has_note = {name: any("the joint stops at the limit" in note for note in of_one) for name, of_one in notes.items()}
    assert has_note == {"up": True, "down": True, "wide": False}


def test_nothing_is_known_to_be_up_for_the_objects_of_a_dataset_without_networks(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    paths = StagePaths("embedded", "toy")
    assert _object_ups(paths) == {}
    paths.checkpoints.parent.mkdir(parents=True)
    paths.checkpoints.symlink_to(trained)
    assert set(_object_ups(paths)) == {"box", "notebook"}


@pytest.mark.parametrize("name", ["steps", "batch", "validate_every", "micro_batches", "save_every"])
def test_a_budget_of_zero_is_refused(name: str) -> None:
    with pytest.raises(BadInput, match=f"training.{name}: expected 1 or more"):
        TrainingConfig(**{name: 0})


def test_a_negative_number_of_augmented_copies_is_refused() -> None:
    with pytest.raises(BadInput, match="augmented_copies: expected 0 or more, got -1"):
        TrainingConfig(augmented_copies=-1)


def test_generation_refuses_other_hands_and_encoders(trained: Path) -> None:
    pair, encoder = load_embedded_hands(), load_encoder("hash")
    other = replace(pair, left=replace(pair.left, template_m=pair.left.template_m * 1.1))
    with pytest.raises(BadInput, match="hand"):
        Generator.load(trained, other, encoder)
    encoder.identity = {"name": "another"}
    with pytest.raises(BadInput, match="text features"):
        Generator.load(trained, pair, encoder)


def test_hands_and_encoder_default_to_those_of_the_networks(trained: Path) -> None:
    options, tracks = MotionOptions(frames=8), []
    for loaded in (Generator.load(trained), generator(trained)):
        tracks.append(loaded.generate("Lift a box with the left hand.", user_box(), options)[0].clip.hands["left"])
    np.testing.assert_array_equal(tracks[0].wrist_m, tracks[1].wrist_m)


class Downhill:
    """One weight that starts at 2, whose loss is itself: every step of Adam lowers it by the learning rate."""

    frames = entries = 0

    def __init__(self) -> None:
        self.network: nn.Module = nn.ParameterList([torch.tensor(2.0)])

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> dict[str, torch.Tensor]:
        return {"total": self.validation(self.network)}

    def validation(self, network: nn.Module) -> torch.Tensor:
        return next(network.parameters())


@pytest.mark.parametrize(("warmup", "expected"), [(0, (1.99, 1.971)), (1, (1.9, 1.89)), (2, (1.95, 1.85))])
def test_the_resulting_weights_are_a_running_average_after_the_warm_up(
    annotated: AnnotatedStore, warmup: int, expected: tuple[float, float]
) -> None:
    """Weights 2, 1.9, 1.8: 0.9 x 2 + 0.1 x 1.9 is 1.99, 0.9 x 1.99 + 0.1 x 1.8 is 1.971; no average in the warm-up."""
    config = TrainingConfig(2, 2, 0.1, weight_decay=0.0, warmup=warmup, ema_decay=0.9, validate_every=1)
    average, log = fit(Downhill(), Corpus.of(annotated, 0), config, 0, torch.device("cpu"))
    assert [entry["validation"] for entry in log] == pytest.approx(expected)
    assert float(next(average.parameters())) == pytest.approx(expected[1])


def test_the_learning_rate_warms_up_and_falls_to_zero() -> None:
    config = TrainingConfig(steps=110, warmup=10, schedule="cosine")
    factors = [learning_rate_factor(step, config) for step in (1, 10, 60, 110)]
    assert factors == pytest.approx([0.1, 1.0, 0.5, 0.0])
    assert learning_rate_factor(50, TrainingConfig(steps=100)) == 1


def test_matrix_products_are_float32_on_every_processor() -> None:
    """Products in bfloat16, which torch may use on a CPU with AMX, are off by 2e-3; elsewhere the setting counts."""
    make_repeatable(threads=1)
    assert torch.get_float32_matmul_precision() == "highest"
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(256, 256, generator=generator), torch.randn(256, 256, generator=generator)
    exact = (a.double() @ b.double()).float()
    assert float((a @ b - exact).norm() / exact.norm()) < 1e-6


def test_nondeterministic_operations_are_refused_and_the_compiler_is_not_loaded() -> None:
    code = "import sys, torch; from models.common.repeatable import make_repeatable; make_repeatable(1); "
    code += "print(torch.get_deterministic_debug_mode(), 'torch._inductor' in sys.modules)"
    process = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True
    )
    assert process.stdout.split() == ["2", "False"]


@pytest.mark.parametrize("size", [1, 2, 3, 100])
def test_every_epoch_contains_every_clip_once(annotated: AnnotatedStore, size: int) -> None:
    dataset = HoiDataset(annotated, "train")
    stream = batches(dataset, size, seed=0)
    for _ in range(3):
        clip_ids: list[str] = []
        while len(clip_ids) < len(dataset):
            [(_, batch)] = next(stream)
            clip_ids += [sample.clip_id for sample in batch.samples]
        assert sorted(clip_ids) == sorted(dataset.ids)
