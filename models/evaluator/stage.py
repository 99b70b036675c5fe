"""The evaluator of one dataset: every network trained, weighed on recorded clips, and written with what is known."""

import json
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load, save
from torch import Tensor

from hoidata.files import atomic_folder, canonical_json, sha256_bytes, write_whole
from hoidata.files.sealed import METADATA_KEY
from hoidata.hands import HandPair
from hoidata.metrics.encoded import UNKNOWN
from hoidata.settings import plain_config
from hoidata.store.annotated import AnnotatedStore, load_annotated
from hoidata.workers import in_workers
from models.common.checkpoints import save_checkpoint
from models.common.repeatable import make_repeatable, restored_rng
from models.evaluator.encoders import stored_network, weights_digest
from models.evaluator.inputs import Examples
from models.evaluator.networks import EncoderConfig, MotionEncoder
from models.evaluator.settings import EvaluatorSettings, NetworkName
from models.evaluator.training import RECIPES, Classification, Pairing, Task, fit, held_out_loss, logits_of

SPLITS = ("train", "validation", "test")
PAPER_FEATURES, SHARED = 128, 64
FEATURES, FEATURES_OF_FEW, FEW_CLIPS = 32, 16, 256
DIGITS = 4
Figures = dict[str, Any]
Row = tuple[str, str, str]  # label, object, hand of one clip
INPUTS: dict[str, Callable[[Row], tuple[str, ...]]] = {
    "nothing": lambda row: (),
    "object": lambda row: row[1:2],
    "hand": lambda row: row[2:],
    "object and hand": lambda row: row[1:],
}


class Trained(NamedTuple):
    """One training. weights: as safetensors; chosen_by: on validation clips, higher is better; None without any."""

    seed: int
    weights: bytes
    chosen_by: float | None
    figures: Figures


@dataclass(frozen=True)
class Training:
    """Trains the network of a name from a seed, here or in a worker; one that a killed run had finished is read.

    is_worker: the process is one of its own, whose settings may be fixed. finished: folder for finished trainings of
    the same settings, clips and code, or None.
    """

    parts: dict[str, Examples]
    settings: EvaluatorSettings
    is_worker: bool
    finished: Path | None

    def __call__(self, item: tuple[NetworkName, int]) -> Trained:
        if self.is_worker:
            make_repeatable(threads=1)
        name, seed = item
        path = None if self.finished is None else self.finished / f"{name}-{seed}.safetensors"
        if path and (found := _read_finished(path, seed)):
            return found
        trained = _trained(name, seed, self.parts, self.settings)
        if path:
            known = {"chosen_by": trained.chosen_by, "figures": trained.figures}
            write_whole(path, save(load(trained.weights), metadata={METADATA_KEY: canonical_json(known)}))
        return trained


def _read_finished(path: Path, seed: int) -> Trained | None:
    """The training in a file, or None where there is none that can be read."""
    try:
        with safe_open(path, framework="pt") as stored:
            known = json.loads((stored.metadata() or {})[METADATA_KEY])
            weights = save({name: stored.get_tensor(name) for name in stored.keys()})  # noqa: SIM118
        return Trained(seed, weights, known["chosen_by"], known["figures"])
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
    """Write ``out/<network>/model.safetensors`` and ``out/info.json``; what stands there, or why nothing was written.

    annotated_root: clips, annotation, contact and splits of one dataset. provenance: from facts to what is stored. Each
    network is trained once per seed on the training part and chosen on validation; test clips are only weighed. Without
    validation clips of a label that was trained the last weights of the first seed are kept. jobs: trainings at once,
    in processes of their own; the bytes do not depend on it. The folder ``out`` appears whole or not at all.
    progress: a folder where a killed run leaves its finished trainings. code: a digest of what runs; trainings of other
    settings, clips or code are not read.
    """
    annotated = load_annotated(annotated_root, hands)
    parts = {split: Examples.of(annotated, split) for split in SPLITS}
    if (labels := len(parts["train"].known_verbs)) < 2:
        return f"training clips: {len(parts['train'])}, labels among them: {labels}; nothing to tell apart"
    info: dict[str, Any] = {
        "labels": list(parts["train"].known_verbs),
        "clips": {split: len(examples) for split, examples in parts.items()},
        "majority": majority_rows(*(_known(parts[split]) for split in ("train", "test"))),
        "evaluators": {},
    }
    wanted = [(name, seed) for name in settings.networks for seed in settings.seeds]
    finished = None
    if progress is not None:
        made_from = [code, plain_config(settings), *(examples.digest() for examples in parts.values())]
        finished = Path(progress) / sha256_bytes(canonical_json(made_from).encode())[:16]
    found = dict(in_workers(Training(parts, settings, jobs > 1, finished), wanted, jobs))
    with atomic_folder(out) as partial:
        for name in settings.networks:
            trainings = [found[name, seed] for seed in settings.seeds]
            kept = _chosen(trainings)
            by_seed = {str(one.seed): one.figures for one in trainings}
            facts = _facts(name, kept, parts, annotated, info["labels"])
            stored = {"facts": facts, "results": kept.figures, "provenance": provenance(facts) if provenance else {}}
            network = _network(name, kept, parts["train"])
            save_checkpoint(partial / name, stored_network(name).name, network, None, stored)
            info["evaluators"][name] = {
                "digest": weights_digest(network),
                "parameters": sum(weight.numel() for weight in network.parameters()),
                "seed": kept.seed,
                **kept.figures,
                "by_seed": by_seed,
            }
        (partial / "info.json").write_text(canonical_json(info) + "\n")
    if progress is not None:
        shutil.rmtree(progress, ignore_errors=True)
    return info


def _chosen(trainings: Sequence[Trained]) -> Trained:
    """The training in the middle by validation; without validation clips the first."""
    ranks = [(own.chosen_by, -own.seed, own) for own in trainings if own.chosen_by is not None]
    return sorted(ranks, key=lambda rank: rank[:2])[len(ranks) // 2][2] if ranks else trainings[0]


def _trained(name: NetworkName, seed: int, parts: dict[str, Examples], settings: EvaluatorSettings) -> Trained:
    train = parts["train"]
    with restored_rng():
        torch.manual_seed(seed)
        task, network = _task(name, train), MotionEncoder(config_of(name, train))
        known = {split: examples for split, examples in parts.items() if task.can_weigh(examples)}
        held_out = known.get("validation")
        fit(network, task, train, held_out, RECIPES[name], seed, settings.most_steps)
    weights = save(network.state_dict())
    if isinstance(task, Classification):
        found = {split: _accuracies(network, task, examples) for split, examples in known.items()}
        return Trained(seed, weights, found["validation"]["top1"] if held_out else None, {"accuracy": found})
    losses = {split: held_out_loss(network, task, examples) for split, examples in known.items()}
    rounded = {split: round(loss, DIGITS) for split, loss in losses.items()}
    return Trained(seed, weights, -losses["validation"] if held_out else None, {"loss": rounded})


def _network(name: NetworkName, trained: Trained, train: Examples) -> MotionEncoder:
    with restored_rng():
        network = MotionEncoder(config_of(name, train))
    network.load_state_dict(load(trained.weights))
    return network.eval()


def config_of(name: str, train: Examples) -> EncoderConfig:
    """Sizes of a network for these clips: fewer features where there are few clips."""
    features = FEATURES_OF_FEW if len(train) < FEW_CLIPS else FEATURES
    if name == "text-motion":
        return EncoderConfig("recurrent", SHARED, features, text=train.text.shape[-1])
    labels = len(train.known_verbs)
    if name == "paper":
        return EncoderConfig("planar", labels, PAPER_FEATURES)
    return EncoderConfig("recurrent", labels, features)


def _task(name: str, train: Examples) -> Task:
    if name == "text-motion":
        return Pairing()
    return Classification.of(train, "sigmoid" if name == "paper" else "softmax")


@torch.no_grad()
def _accuracies(network: MotionEncoder, task: Classification, examples: Examples) -> dict[str, float]:
    """top1 and top3 of clips whose label was learnt."""
    (labels,) = task.targets(examples)
    known = labels != UNKNOWN
    logits, labels = logits_of(network, examples)[known], labels[known]
    rank: Tensor = (logits > logits.gather(1, labels[:, None])).sum(1)
    return {f"top{k}": round(float((rank < k).double().mean()), DIGITS) for k in (1, 3)}


def _known(examples: Examples) -> list[Row]:
    """Label, object and hand of each clip that has a label."""
    rows = zip(examples.verbs, examples.objects, examples.hands, strict=True)
    return [(label, noun, hand) for label, noun, hand in rows if label]


def _facts(
    name: str,
    kept: Trained,
    parts: dict[str, Examples],
    annotated: AnnotatedStore,
    labels: Sequence[str],
) -> dict[str, Any]:
    """What the checkpoint says of itself."""
    return {
        "model": stored_network(name).name,
        "seed": kept.seed,
        "labels": [] if name == "text-motion" else list(labels),
        "clips": {split: parts[split].ids for split in ("train", "validation")},
        "synthetic": bool(annotated.info["synthetic"]),
        "encoder": annotated.encoder_identity,
    }


def majority_rows(train: Sequence[Row], test: Sequence[Row]) -> dict[str, dict[str, float]]:
    """What the inputs alone give away: per input, how often a test clip's label is the most common in training (top1)
    or among the three most common.

    Of equally common labels the first by name comes first; an input that was never met is answered with all clips'.
    """
    return {name: _majority_accuracy(train, test, key) for name, key in INPUTS.items()} if train and test else {}


def ranked_labels(train: Sequence[Row], key: Callable[[Row], tuple[str, ...]]) -> dict[tuple[str, ...], list[str]]:
    """By input, the labels of training clips from the most common on."""
    counts: defaultdict[tuple[str, ...], Counter[str]] = defaultdict(Counter)
    for row in train:
        counts[key(row)][row[0]] += 1
    return {given: sorted(found, key=lambda label: (-found[label], label)) for given, found in counts.items()}


def _majority_accuracy(
    train: Sequence[Row], test: Sequence[Row], key: Callable[[Row], tuple[str, ...]]
) -> dict[str, float]:
    known, usual = ranked_labels(train, key), ranked_labels(train, INPUTS["nothing"])[()]
    guesses = [known.get(key(row), usual) for row in test]
    hits = {k: sum(row[0] in guess[:k] for row, guess in zip(test, guesses, strict=True)) for k in (1, 3)}
    return {f"top{k}": round(count / len(test), 4) for k, count in hits.items()}
