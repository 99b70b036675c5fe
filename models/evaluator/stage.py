"""Trains the evaluator networks of one dataset, measures them on recorded clips and writes their checkpoints."""

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load, save
from torch import Tensor

from hoidata.files import atomic_folder, canonical_json, sha256_bytes, write_whole
from hoidata.files.checksums import METADATA_KEY
from hoidata.hands import HandPair
from hoidata.metrics.encoded import UNKNOWN
from hoidata.settings import plain_config
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.workers import map_in_workers
from models.common.checkpoints import save_checkpoint
from models.common.repeatable import make_repeatable, restored_rng
from models.evaluator.encoders import stored_network, weights_digest
from models.evaluator.inputs import Examples
from models.evaluator.networks import EncoderConfig, MotionEncoder
from models.evaluator.settings import EvaluatorSettings, NetworkName
from models.evaluator.training import RECIPES, Classification, Pairing, Task, fit, held_out_loss, logits_of

SPLITS = ("train", "validation", "test")
PAPER_FEATURES, SHARED_SPACE = 128, 64
FEATURES, FEATURES_FEW_CLIPS, FEW_CLIPS = 32, 16, 256
DIGITS = 4
Results = dict[str, Any]


class Trained(NamedTuple):
    """The result of one training."""

    seed: int
    weights: bytes  # safetensors
    chosen_by: float | None  # score on validation clips, higher is better; None without such clips
    figures: Results  # accuracies or losses by split


@dataclass(frozen=True)
class Training:
    """Trains one network from one seed, or reads the result that a killed run had finished."""

    parts: dict[str, Examples]  # by split
    settings: EvaluatorSettings
    is_worker: bool  # runs in a separate process, whose torch settings may be changed
    finished: Path | None  # folder for finished trainings of the same settings, clips and code

    def __call__(self, item: tuple[NetworkName, int]) -> Trained:
        if self.is_worker:
            make_repeatable(threads=1)
        name, seed = item
        path = None if self.finished is None else self.finished / f"{name}-{seed}.safetensors"
        if path and (finished := _read_finished(path, seed)):
            return finished
        trained = _trained(name, seed, self.parts, self.settings)
        if path:
            record = {"chosen_by": trained.chosen_by, "figures": trained.figures}
            write_whole(path, save(load(trained.weights), metadata={METADATA_KEY: canonical_json(record)}))
        return trained


def _read_finished(path: Path, seed: int) -> Trained | None:
    """The training stored in a file, or None if the file is missing or damaged."""
    try:
        with safe_open(path, framework="pt") as stored:
            record = json.loads((stored.metadata() or {})[METADATA_KEY])
            weights = save({name: stored.get_tensor(name) for name in stored.keys()})  # noqa: SIM118
        return Trained(seed, weights, record["chosen_by"], record["figures"])
    except (OSError, SafetensorError, KeyError, ValueError):
        return None


def train_evaluators(
    annotated_root: str | Path,
    out: str | Path,
    settings: EvaluatorSettings,
    hands: HandPair | None = None,
    *,
    jobs: int = 1,
    provenance: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
    progress: str | Path | None = None,
    code: str = "",
) -> dict[str, Any] | str:
    """Train the evaluator and write ``out/<network>/model.safetensors`` and ``out/info.json`` atomically.

    Each network is trained once per seed. The training with the median validation score is used; without validation
    clips that of the first seed. Test clips are only measured.

    Args:
        annotated_root: folder with clips, annotation, contact and splits of one dataset.
        provenance: maps the facts of a checkpoint to the provenance that it stores.
        jobs: number of parallel trainings, in separate processes; the bytes do not depend on it.
        progress: folder in which a killed run leaves finished trainings for the next run.
        code: digest of the code; trainings of other settings, clips or code are not reused.

    Returns:
        The content of info.json, or the reason why nothing was written.
    """
    annotated = load_annotated(annotated_root, hands)
    joints_only = set(settings.networks) == {"paper"}
    parts = {split: Examples.of(annotated, split, joints_only) for split in SPLITS}
    if (labels := len(parts["train"].trained_verbs)) < 2:
        return f"training clips: {len(parts['train'])}, labels among them: {labels}; nothing to tell apart"
    info: dict[str, Any] = {
        "labels": list(parts["train"].trained_verbs),
        "clips": {split: len(examples) for split, examples in parts.items()},
        "evaluators": {},
    }
    runs = [(name, seed) for name in settings.networks for seed in settings.seeds]
    finished = None
    if progress is not None:
        identity = [code, plain_config(settings), *(examples.digest() for examples in parts.values())]
        finished = Path(progress) / sha256_bytes(canonical_json(identity).encode())[:16]
    trained = dict(map_in_workers(Training(parts, settings, jobs > 1, finished), runs, jobs))
    with atomic_folder(out) as partial:
        for name in settings.networks:
            trainings = [trained[name, seed] for seed in settings.seeds]
            best = _chosen(trainings)
            by_seed = {str(one.seed): one.figures for one in trainings}
            facts = _facts(name, best, parts, annotated, info["labels"])
            stored = {"facts": facts, "results": best.figures, "provenance": provenance(facts) if provenance else {}}
            network = _network(name, best, parts["train"])
            save_checkpoint(partial / name, stored_network(name).name, network, None, stored)
            info["evaluators"][name] = {
                "digest": weights_digest(network),
                "parameters": sum(weight.numel() for weight in network.parameters()),
                "seed": best.seed,
                **best.figures,
                "by_seed": by_seed,
            }
        (partial / "info.json").write_text(canonical_json(info) + "\n")
    if progress is not None:
        shutil.rmtree(progress, ignore_errors=True)
    return info


def _chosen(trainings: Sequence[Trained]) -> Trained:
    """The training with the median validation score; without validation clips the first."""
    ranks = [(training.chosen_by, -training.seed, training) for training in trainings if training.chosen_by is not None]
    return sorted(ranks, key=lambda rank: rank[:2])[len(ranks) // 2][2] if ranks else trainings[0]


def _trained(name: NetworkName, seed: int, parts: dict[str, Examples], settings: EvaluatorSettings) -> Trained:
    train = parts["train"]
    with restored_rng():
        torch.manual_seed(seed)
        task, network = _task(name, train), MotionEncoder(config_of(name, train))
        evaluable = {split: examples for split, examples in parts.items() if task.can_evaluate(examples)}
        held_out = evaluable.get("validation")
        fit(network, task, train, held_out, RECIPES[name], seed, settings.most_steps)
    weights = save(network.state_dict())
    if isinstance(task, Classification):
        accuracies = {split: _accuracies(network, task, examples) for split, examples in evaluable.items()}
        return Trained(seed, weights, accuracies["validation"]["top1"] if held_out else None, {"accuracy": accuracies})
    losses = {split: held_out_loss(network, task, examples) for split, examples in evaluable.items()}
    rounded = {split: round(loss, DIGITS) for split, loss in losses.items()}
    return Trained(seed, weights, -losses["validation"] if held_out else None, {"loss": rounded})


def _network(name: NetworkName, trained: Trained, train: Examples) -> MotionEncoder:
    with restored_rng():
        network = MotionEncoder(config_of(name, train))
    network.load_state_dict(load(trained.weights))
    return network.eval()


def config_of(name: str, train: Examples) -> EncoderConfig:
    """The configuration of a network for these clips; few clips get fewer features."""
    features = FEATURES_FEW_CLIPS if len(train) < FEW_CLIPS else FEATURES
    if name == "text-motion":
        return EncoderConfig("recurrent", SHARED_SPACE, features, text=train.text.shape[-1])
    labels = len(train.trained_verbs)
    if name == "paper":
        return EncoderConfig("planar", labels, PAPER_FEATURES)
    return EncoderConfig("recurrent", labels, features)


def _task(name: str, train: Examples) -> Task:
    if name == "text-motion":
        return Pairing()
    return Classification.of(train, "sigmoid" if name == "paper" else "softmax")


@torch.no_grad()
def _accuracies(network: MotionEncoder, task: Classification, examples: Examples) -> dict[str, float]:
    """Top-1 and top-3 accuracy of clips whose label was trained."""
    (labels,) = task.targets(examples)
    has_label = labels != UNKNOWN
    logits, labels = logits_of(network, examples)[has_label], labels[has_label]
    rank: Tensor = (logits > logits.gather(1, labels[:, None])).sum(1)
    return {f"top{k}": round(float((rank < k).double().mean()), DIGITS) for k in (1, 3)}


def _facts(
    name: str,
    best: Trained,
    parts: dict[str, Examples],
    annotated: AnnotatedStore,
    labels: Sequence[str],
) -> dict[str, Any]:
    """The facts stored in the checkpoint."""
    return {
        "model": stored_network(name).name,
        "seed": best.seed,
        "labels": [] if name == "text-motion" else list(labels),
        "clips": {split: parts[split].ids for split in ("train", "validation")},
        "synthetic": bool(annotated.info["synthetic"]),
        "encoder": annotated.encoder_identity,
    }
