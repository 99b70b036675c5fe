"""Training: one plain loop for all four models, and the stage entry ``train_model``.

Budgets are steps, never seconds; every draw comes from a seeded generator; deterministic algorithms and a fixed
number of threads make equal inputs give equal bytes on one machine.
"""

import copy
import csv
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from rich.progress import track
from torch import nn

from hoidata.errors import BadInput
from hoidata.files import atomic_file
from hoidata.hands import HandPair
from hoidata.store.annotated import load_annotated
from models.common.checkpoints import (
    NETWORKS,
    Checkpoint,
    empty_reason,
    load_checkpoint,
    motion_generator,
    save_checkpoint,
    write_empty,
)
from models.common.config import build_config, plain_config
from models.common.corpus import Corpus, batches
from models.common.evaluation import choose_contact_threshold
from models.common.features import Hands, Normaliser
from models.common.surface import Surface
from models.text2hoi.contact import ContactLossConfig, ContactModel
from models.text2hoi.diffusion import DiffusionModel
from models.text2hoi.length import LengthModel
from models.text2hoi.recipes import ContactRecipe, DiffusionLossConfig, DiffusionRecipe, LengthRecipe, Recipe
from models.text2hoi.refiner import RefinerModel
from models.text2hoi.refining import RefinerLossConfig, RefinerRecipe

UPSTREAM = {"contact": None, "length": None, "diffusion": "contact", "refiner": "diffusion"}
LOSSES = {"contact": ContactLossConfig, "length": None, "diffusion": DiffusionLossConfig, "refiner": RefinerLossConfig}


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
    average: float = 0.0
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
    def of(cls, model_name: str, params: Mapping[str, Any]) -> "Plan":
        """From a model's section of params.yaml: ``network``, ``training``, ``loss`` and ``seed``, each optional.

        Raises BadInput for unknown keys and for a model that does not exist.
        """
        if model_name not in NETWORKS:
            raise BadInput("model", f"one of {sorted(NETWORKS)}", model_name, "correct the name")
        where = f"params.yaml: {model_name}"
        known = {"network", "training", "loss", "seed"}
        if unknown := set(params) - known:
            raise BadInput(where, f"keys among {sorted(known)}", ", ".join(sorted(unknown)), "correct it")
        loss_type = LOSSES[model_name]
        return cls(
            build_config(NETWORKS[model_name][0], params.get("network"), f"{where}.network"),
            build_config(TrainingConfig, params.get("training"), f"{where}.training"),
            build_config(loss_type, params.get("loss"), f"{where}.loss") if loss_type else None,
            int(params.get("seed", 0)),
        )


def train_model(
    model_name: str,
    annotated_root: str | Path,
    out_folder: str | Path,
    params: Mapping[str, Any],
    hands: HandPair | None = None,
    *,
    provenance: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
    upstream: Mapping[str, str | Path] | None = None,
    threads: int = 2,
    device: str = "cpu",
) -> Path:
    """Train one model on the training clips of one dataset; the path of what was written.

    annotated_root: folder with clips, annotation and contact. params: see :meth:`Plan.of`.
    hands: the hand model of the clips where it is not the embedded one. provenance: from facts to what is stored.
    upstream: ``{"contact": folder}`` for diffusion, ``{"diffusion": folder}`` for the refiner.

    Reads the train split, and validation for choosing; never test. Writes ``model.safetensors`` and ``log.csv``, or
    ``empty.json`` with the reason where there is nothing to train on.
    """
    plan = Plan.of(model_name, params)
    make_repeatable(plan.seed, threads)
    if reason := _nothing_to_train_on(annotated_root, model_name, upstream or {}):
        return write_empty(out_folder, reason)
    annotated = load_annotated(annotated_root, hands)
    corpus = Corpus.of(annotated, plan.seed, crop="start" if model_name == "refiner" else "random")
    if not len(corpus.train):
        return write_empty(out_folder, f"{annotated_root}: no training clips")
    pair = annotated.store.hand_pair()
    accelerator = Accelerator(cpu=device == "cpu")
    setup = Setup(
        plan, corpus, Hands(pair), accelerator.device, _load_upstream(model_name, upstream or {}, accelerator)
    )
    recipe, normaliser = BUILDERS[model_name](setup)
    network, log = fit(recipe, corpus, plan.training, plan.seed, accelerator)
    facts = {"model": model_name, "seed": plan.seed, "steps": plan.training.steps}
    facts |= corpus.facts(pair)
    info = {
        "facts": facts,
        "training": plain_config(plan.training),
        "loss": plain_config(plan.loss) if plan.loss else {},
        "results": {"validation_loss": log[-1]["validation"], **_results(network, corpus)},
        "provenance": provenance(facts) if provenance else {},
    }
    path = save_checkpoint(out_folder, model_name, network, normaliser, info)
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


@dataclass(frozen=True)
class Setup:
    """What a builder needs to make network and recipe."""

    plan: Plan
    corpus: Corpus
    hands: Hands
    device: torch.device
    upstream: Checkpoint | None


def _contact(setup: Setup) -> tuple[Recipe, None]:
    network = ContactModel(setup.plan.network).to(setup.device)
    return ContactRecipe(network, setup.plan.loss, setup.corpus, setup.device), None


def _length(setup: Setup) -> tuple[Recipe, None]:
    return LengthRecipe(LengthModel(setup.plan.network).to(setup.device), setup.corpus, setup.device), None


def _diffusion(setup: Setup) -> tuple[Recipe, Normaliser]:
    contact = setup.upstream.network if setup.upstream else None
    assert isinstance(contact, ContactModel)
    config = replace(setup.plan.network, point_net=contact.config.point_net)
    network = DiffusionModel(config).to(setup.device)
    network.object_net.load_state_dict(contact.object_net.state_dict())
    normaliser = Normaliser.of(list(setup.corpus.train)).to(setup.device)
    return DiffusionRecipe(network, setup.plan.loss, setup.corpus, setup.hands, normaliser, setup.device), normaliser


def _refiner(setup: Setup) -> tuple[Recipe, None]:
    assert setup.upstream is not None
    generator = motion_generator(setup.upstream)
    network = RefinerModel(setup.plan.network).to(setup.device)
    samples = [*setup.corpus.train, *setup.corpus.held_out]
    surface = Surface.of(setup.hands, samples, setup.plan.loss.field_resolution, setup.device)
    recipe = RefinerRecipe(network, setup.plan.loss, setup.corpus, generator, surface, setup.device, setup.plan.seed)
    return recipe, None


BUILDERS = {"contact": _contact, "length": _length, "diffusion": _diffusion, "refiner": _refiner}


def fit(
    recipe: Recipe, corpus: Corpus, config: TrainingConfig, seed: int, accelerator: Accelerator
) -> tuple[nn.Module, list[dict[str, float]]]:
    """Run the steps; the network to keep, in evaluation mode, and one log row per validation."""
    network = recipe.network.train()
    kept = copy.deepcopy(network).eval().requires_grad_(False)
    learnt = [parameter for parameter in network.parameters() if parameter.requires_grad]
    optimiser = torch.optim.AdamW(learnt, lr=config.learning_rate, weight_decay=config.weight_decay)
    generator = torch.Generator().manual_seed(seed)
    stream = batches(corpus.train, config.batch, generator, recipe.needs_entries)
    log, best, best_loss, running = [], None, math.inf, {}
    for step in track(range(1, config.steps + 1), description=type(network).__name__, transient=True):
        for group in optimiser.param_groups:
            group["lr"] = config.learning_rate * learning_rate_factor(step, config)
        found = recipe.losses(next(stream).to(accelerator.device), generator)
        optimiser.zero_grad(set_to_none=True)
        accelerator.backward(found["total"])
        if config.clip_norm:
            nn.utils.clip_grad_norm_(learnt, config.clip_norm)
        optimiser.step()
        _follow(kept, network, config.average if step > config.warmup else 0.0)
        for name, value in found.items():
            running.setdefault(name, []).append(value.detach())
        if step % config.validate_every == 0 or step == config.steps:
            row = {f"train_{name}": float(torch.stack(values).mean()) for name, values in running.items()}
            loss, running = recipe.validation(kept), {}
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
    with atomic_file(path) as part, open(part, "w", newline="") as stream:
        writer = csv.DictWriter(stream, list(log[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in log)


def _results(network: nn.Module, corpus: Corpus) -> dict[str, float]:
    if not isinstance(network, ContactModel):
        return {}
    return {"contact_threshold": choose_contact_threshold(network, corpus.held_out)}


def _load_upstream(model_name: str, upstream: Mapping[str, str | Path], accelerator: Accelerator) -> Checkpoint | None:
    needed = UPSTREAM[model_name]
    return load_checkpoint(upstream[needed], needed, accelerator.device) if needed else None


def _nothing_to_train_on(annotated_root: str | Path, model_name: str, upstream: Mapping[str, str | Path]) -> str | None:
    """Why this training cannot be: an empty dataset or an empty model before it."""
    for folder in ("clips", "annotation", "contact"):
        if reason := empty_reason(Path(annotated_root) / folder):
            return reason
    needed = UPSTREAM[model_name]
    if needed is None:
        return None
    if needed not in upstream:
        raise BadInput(f"training of {model_name}", f"the checkpoint folder of {needed}", "none", "pass upstream")
    return empty_reason(upstream[needed])
