"""Training: one plain loop for every network, and the stage entry ``train_network``.

Budgets are steps, never seconds; every draw comes from a seeded generator; deterministic algorithms and a fixed
number of threads make equal inputs give equal bytes on one machine.
"""

import copy
import csv
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich.progress import track
from torch import nn

from hoidata.errors import BadInput
from hoidata.files import atomic_file
from hoidata.hands import HandPair
from hoidata.settings import build_config, plain_config
from hoidata.store.annotated import load_annotated
from models.common.checkpoints import empty_reason, load_checkpoint, save_checkpoint, write_empty
from models.common.corpus import Corpus, batches
from models.common.family import Network, Objective, Setup
from models.common.features import Hands


@dataclass(frozen=True)
class TrainingConfig:
    """Budget and optimiser (AdamW). The defaults are Text2HOI's released ones, but for ``steps``.

    schedule: "constant", or "cosine" to zero after ``warmup`` steps. average: decay of the running average of the
    weights that is kept (0: the weights themselves). keep_best: keep the step with the lowest validation loss, not
    the last.
    """

    steps: int = 30_000
    batch: int = 64
    learning_rate: float = 1e-4
    weight_decay: float = 0.01
    schedule: str = "constant"
    warmup: int = 0
    ema_decay: float = 0.0
    clip_norm: float = 0.0
    keep_best: bool = False
    validate_every: int = 500


@dataclass(frozen=True)
class Plan:
    """One training as params.yaml states it: sizes of the network, the optimiser's budget, weights of the losses."""

    network: Any
    training: TrainingConfig
    loss: Any
    seed: int

    @classmethod
    def of(cls, network: Network, params: Mapping[str, Any]) -> "Plan":
        """From a network's section of params.yaml: ``network``, ``training``, ``loss`` and ``seed``, each optional.

        Raises BadInput for unknown keys.
        """
        where = f"params.yaml: {network.name}"
        known = {"network", "training", "loss", "seed"}
        if unknown := set(params) - known:
            raise BadInput(where, f"keys among {sorted(known)}", ", ".join(sorted(unknown)), "correct it")
        return cls(
            build_config(network.config, params.get("network"), f"{where}.network"),
            build_config(TrainingConfig, params.get("training"), f"{where}.training"),
            build_config(network.loss, params.get("loss"), f"{where}.loss") if network.loss else None,
            int(params.get("seed", 0)),
        )


def train_network(
    network: Network,
    annotated_root: str | Path,
    out_folder: str | Path,
    params: Mapping[str, Any],
    hands: HandPair | None = None,
    *,
    needed: Mapping[Network, str | Path] | None = None,
    provenance: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
    threads: int = 1,
    device: str = "cpu",
) -> Path:
    """Train one network on the training clips of one dataset; the path of what was written.

    annotated_root: folder with clips, annotation, contact and splits. params: see :meth:`Plan.of`.
    hands: the hand model of the clips where it is not the embedded one. provenance: from facts to what is stored.
    needed: the checkpoint folder of every network that ``network.needs`` names. device: as torch names it; recorded.

    Reads the train split, and validation for choosing; never test. Writes ``model.safetensors`` and ``log.csv``, or
    ``empty.json`` with the reason where there is nothing to train on.
    """
    plan, needed = Plan.of(network, params), needed or {}
    if missing := set(network.needs) - {other.name for other in needed}:
        got = f"none of {', '.join(sorted(missing))}"
        raise BadInput(f"training of {network.name}", "checkpoint folders", got, "pass needed")
    make_repeatable(plan.seed, threads)
    folders = [*(Path(annotated_root) / name for name in ("clips", "annotation", "contact")), *needed.values()]
    if reason := next(filter(None, map(empty_reason, folders)), None):
        return write_empty(out_folder, reason)
    annotated = load_annotated(annotated_root, hands)
    corpus = Corpus.of(annotated, plan.seed, crop=network.crop)
    if not len(corpus.train):
        return write_empty(out_folder, f"{annotated_root}: no training clips")
    pair, where = annotated.store.hand_pair(), torch.device(device)
    trained = {other.name: load_checkpoint(folder, other, where) for other, folder in needed.items()}
    setup = Setup(plan.network, plan.loss, plan.seed, corpus, Hands(pair), where, trained)
    objective, normaliser = network.objective(setup)
    kept, log = fit(objective, corpus, plan.training, plan.seed, where)
    facts = {"model": network.name, "seed": plan.seed, "steps": plan.training.steps, "device": where.type}
    facts |= corpus.facts(pair)
    info = {
        "facts": facts,
        "training": plain_config(plan.training),
        "loss": plain_config(plan.loss) if plan.loss else {},
        "results": {"validation_loss": log[-1]["validation"], **network.results(kept.cpu(), corpus)},
        "provenance": provenance(facts) if provenance else {},
    }
    path = save_checkpoint(out_folder, network.name, kept, normaliser, info)
    write_log(Path(out_folder) / "log.csv", log)
    return path


def make_repeatable(seed: int, threads: int) -> None:
    """Fix what could change bytes from run to run: seed, threads, algorithms. Matrix products may use bfloat16x3."""
    torch.manual_seed(seed)
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(True)
    # Nothing here reads memory before writing it; filling it first would cost a seventh of the time.
    setattr(torch.utils.deterministic, "fill_uninitialized_memory", False)  # noqa: B010 (pyright does not know it)
    torch.set_float32_matmul_precision("medium")


def fit(
    objective: Objective, corpus: Corpus, config: TrainingConfig, seed: int, device: torch.device
) -> tuple[nn.Module, list[dict[str, float]]]:
    """Run the steps; the network to keep, in evaluation mode, and one log row per validation."""
    network = objective.network.train()
    kept = copy.deepcopy(network).eval().requires_grad_(False)
    learnt = [parameter for parameter in network.parameters() if parameter.requires_grad]
    optimiser = torch.optim.AdamW(learnt, lr=config.learning_rate, weight_decay=config.weight_decay)
    generator = torch.Generator().manual_seed(seed)
    stream = batches(corpus.train, config.batch, generator, objective.needs_entries)
    log, best, best_loss, running = [], None, math.inf, {}
    for step in track(range(1, config.steps + 1), description=type(network).__name__, transient=True):
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * learning_rate_factor(step, config)
        found = objective.losses(next(stream).to(device), generator)
        optimiser.zero_grad(set_to_none=True)
        found["total"].backward()
        if config.clip_norm:
            nn.utils.clip_grad_norm_(learnt, config.clip_norm)
        optimiser.step()
        _follow(kept, network, config.ema_decay if step > config.warmup else 0.0)
        for name, value in found.items():
            running.setdefault(name, []).append(value.detach())
        if step % config.validate_every == 0 or step == config.steps:
            row = {f"train_{name}": float(torch.stack(values).mean()) for name, values in running.items()}
            loss, running = objective.validation(kept), {}
            log.append({"step": step, "validation": loss, **row})
            if config.keep_best and loss < best_loss:
                best, best_loss = copy.deepcopy(kept.state_dict()), loss
    if best is not None:
        kept.load_state_dict(best)
    return kept, log


def learning_rate_factor(step: int, config: TrainingConfig) -> float:
    """Linear warm-up, then constant or half a cosine down to zero at the last step."""
    if step <= config.warmup:
        return step / max(config.warmup, 1)
    if config.schedule == "constant":
        return 1.0
    done = (step - config.warmup) / max(config.steps - config.warmup, 1)
    return 0.5 * (1 + math.cos(math.pi * done))


@torch.no_grad()
def _follow(kept: nn.Module, network: nn.Module, decay: float) -> None:
    """Running average of the weights; buffers (batch-norm statistics) are copied."""
    for target, source in zip(kept.parameters(), network.parameters(), strict=True):
        target.lerp_(source, 1 - decay)
    for target, source in zip(kept.buffers(), network.buffers(), strict=True):
        target.copy_(source)


def write_log(path: Path, log: list[dict[str, float]]) -> None:
    """log.csv: step, validation loss, and the mean training losses since the row before."""
    with atomic_file(path) as partial, open(partial, "w", newline="") as stream:
        writer = csv.DictWriter(stream, list(log[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in log)
