"""Missing subsets: without validation clips nothing is selected; without training clips the reason is reported."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from hoidata.batches.dataset import HoiDataset
from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import AnnotatedStore, load_annotated
from models.bimart.family import NO_OTHER, BimArtSampler, Change
from models.common.checkpoints import load_checkpoint
from models.common.corpus import Corpus
from models.common.family import Skipped, Sources
from models.common.predicting import PredictionConfig, requests_for
from models.common.training import train_network
from models.evaluator.settings import EvaluatorSettings
from models.evaluator.stage import train_evaluators
from models.registry import load_family, load_network
from models.text2hoi.contact_training import contact_threshold, sample_threshold
from models.text2hoi.family import contact_metrics, other_prompts
from tests.builders.stores import write_annotated
from tests.models.conftest import TOY_MOTIONS, make_clip
from tests.models.test_progress import SETTINGS

NO_VALIDATION = {"by": "subject", "train": ["s1"], "test": ["s3"], "promises": ["subject"]}
HANDS = load_embedded_hands()


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy dataset with its validation clips in no subset."""
    clips = [make_clip(number, plan) for number, plan in enumerate(TOY_MOTIONS)]
    return write_annotated(tmp_path_factory.mktemp("no-validation"), clips, rule=NO_VALIDATION)


def train(name: str, root: Path, out: Path, **training) -> Path:
    params = {**SETTINGS[name], "training": {**SETTINGS[name]["training"], **training}}
    network = load_network(name)
    needed = {load_network(other): out.parent / other for other in network.needs}
    return train_network(network, root, out, params, needed=needed)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["length", "contact", "manipnet"])
def test_without_validation_clips_the_last_weights_are_used(
    root: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture
) -> None:
    """The best of the validations chooses nothing. The log has no loss."""
    settings = {"steps": 4, "validate_every": 1, "learning_rate": 0.25}
    chosen = load_file(train(name, root, tmp_path / "chosen" / name, **settings, keep_best=True))
    assert "no validation clips; nothing is chosen, the last weights are kept" in capsys.readouterr().err
    last = load_file(train(name, root, tmp_path / "last" / name, **settings))
    assert all(torch.equal(value, last[key]) for key, value in chosen.items())
    header, *rows = (tmp_path / "chosen" / name / "log.csv").read_text().splitlines()
    assert header.startswith("step,validation,")
    assert [line.split(",")[:2] for line in rows] == [[str(step), ""] for step in range(1, 5)]
    info = load_checkpoint(tmp_path / "chosen" / name, load_network(name)).info
    assert info["results"]["validation_loss"] is None
    assert info["facts"]["clips"]["validation"] == []


@pytest.mark.slow
def test_diffusion_and_refiner_train_without_validation_clips(root: Path, tmp_path: Path) -> None:
    for name in ("contact", "diffusion", "refiner"):
        train(name, root, tmp_path / name)
        assert load_checkpoint(tmp_path / name, load_network(name)).info["results"]["validation_loss"] is None


@pytest.mark.slow
def test_thresholds_without_validation_clips_are_one_half(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also those of the mean maps that the network is compared with: no training clip chooses for them."""
    train("contact", root, tmp_path / "contact")
    checkpoint = load_checkpoint(tmp_path / "contact", load_network("contact"))
    assert (contact_threshold(checkpoint), sample_threshold(checkpoint)) == (0.5, 0.5)
    annotated = load_annotated(root)
    train_clips, test = (list(HoiDataset(annotated, subset, crop="start")) for subset in ("train", "test"))

    def refuse(*_: object) -> float:
        raise AssertionError("a threshold was chosen")

    monkeypatch.setattr("models.text2hoi.family.best_threshold", refuse)
    sources = Sources(annotated, tmp_path, HANDS, torch.device("cpu"))
    assert contact_metrics(sources, train_clips, [], test)["threshold"] == 0.5


def test_a_corpus_holds_out_no_training_clip(root: Path) -> None:
    assert Corpus.of(load_annotated(root), 0).held_out == []


@pytest.mark.slow
def test_without_validation_clips_the_evaluator_uses_the_first_seed(root: Path, tmp_path: Path) -> None:
    settings = EvaluatorSettings(("corrected", "text-motion"), seeds=(5, 1, 2), most_steps=4)
    train_evaluators(root, tmp_path, settings)
    info = json.loads((tmp_path / "info.json").read_text())
    assert info["clips"]["validation"] == 0
    for name, kind in (("corrected", "accuracy"), ("text-motion", "loss")):
        assert info["evaluators"][name]["seed"] == 5
        assert set(info["evaluators"][name][kind]) == {"train", "test"}


@pytest.mark.slow
def test_validation_clips_of_untrained_labels_select_nothing(tmp_path: Path) -> None:
    """Their loss was no number, and the weights that training began with were kept."""
    plans = [replace(plan, verb="pour") if plan.subject == "s2" else plan for plan in TOY_MOTIONS]
    root = write_annotated(tmp_path / "data", [make_clip(number, plan) for number, plan in enumerate(plans)])
    settings = EvaluatorSettings(("corrected",), seeds=(3, 1), most_steps=4)
    info = train_evaluators(root, tmp_path / "out", settings)
    assert not isinstance(info, str)
    evaluator = info["evaluators"]["corrected"]
    assert (evaluator["seed"], set(evaluator["accuracy"])) == (3, {"train", "test"})


@pytest.mark.parametrize("family", ["mean-pose", "mean-motion", "mean-pose-at-object"])
def test_a_mean_without_training_clips_of_the_hand_has_a_reason(
    annotated: AnnotatedStore, tmp_path: Path, family: str
) -> None:
    """Only clips of the right hand train; the left one had no motion at all under the name of a mean."""
    rule = {"by": "prefix", "train": ["1"], "test": ["0"], "promises": []}
    clips = [replace(make_clip(number, plan), sequence=str(number)) for number, plan in enumerate(TOY_MOTIONS)]
    store = load_annotated(write_annotated(tmp_path, clips, rule=rule))
    sample = HoiDataset(store, "test", crop="start")[0]
    sampler = load_family(family).load(Sources(store, tmp_path, HANDS, torch.device("cpu")))
    answers = sampler.sample(requests_for(sample, PredictionConfig(samples=1)))
    assert [type(answer) for answer in answers] == [Skipped]
    right = replace(requests_for(sample, PredictionConfig(samples=1))[0], active_hands=np.array([False, True]))
    assert [type(answer) for answer in sampler.sample([right])] != [Skipped]


def test_without_training_clips_there_is_no_nearest_window(tmp_path: Path) -> None:
    rule = {"by": "subject", "train": ["s9"], "test": ["s1"], "promises": []}
    store = load_annotated(write_annotated(tmp_path, [make_clip(0, TOY_MOTIONS[0])], rule=rule))
    sampler = load_family("nearest-window").load(Sources(store, tmp_path, HANDS, torch.device("cpu")))
    requests = requests_for(HoiDataset(store, "test", crop="start")[0], PredictionConfig(samples=1))
    assert [type(answer) for answer in sampler.sample(requests)] == [Skipped]


def test_a_clip_whose_sentence_all_test_clips_have_gets_no_other_prompt(tmp_path: Path, trained: Path) -> None:
    """It would be conditioned on its own sentence and still count as a control."""
    plans = [replace(TOY_MOTIONS[5]), replace(TOY_MOTIONS[0]), replace(TOY_MOTIONS[1])]
    store = load_annotated(write_annotated(tmp_path, [make_clip(number, plan) for number, plan in enumerate(plans)]))
    sources = Sources(store, trained, HANDS, torch.device("cpu"))
    assert other_prompts(sources) == {}
    sample = HoiDataset(store, "test", crop="start")[0]
    requests = requests_for(sample, PredictionConfig(samples=1))
    for family in ("other-prompt", "other-prompt-own-contact"):
        answers = load_family(family).load(sources).sample(requests)
        assert answers == [Skipped(requests[0].motion_id, "all test clips have its sentence")]


def test_bimart_gets_another_object_only_if_there_is_one(tmp_path: Path) -> None:
    plans = [
        TOY_MOTIONS[0],
        TOY_MOTIONS[1],
        TOY_MOTIONS[5],
        TOY_MOTIONS[2],
    ]  # boxes, and a notebook that tests with the last box
    plans[3] = replace(plans[3], subject="s3")
    store = load_annotated(write_annotated(tmp_path, [make_clip(number, plan) for number, plan in enumerate(plans)]))
    requests = {
        sample.object_model.name: requests_for(sample, PredictionConfig(samples=1))[0]
        for sample in HoiDataset(store, "test", crop="start")
    }
    box, notebook = requests[TOY_MOTIONS[0].model.name], requests[TOY_MOTIONS[2].model.name]

    def sampler(change: Change) -> BimArtSampler:
        return BimArtSampler(None, HANDS, synthetic=True, change=change, annotated=store)  # type: ignore[arg-type]

    left_out = {
        change: [sampler(change)._why_not(one) for one in (box, notebook)]
        for change in ("other object", "other path", "none")
    }
    assert left_out == {
        "other object": [NO_OTHER["other object"], ""],
        "other path": ["", NO_OTHER["other path"]],
        "none": ["", ""],
    }
