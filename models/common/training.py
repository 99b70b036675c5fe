"""Training: one plain loop for every network, and the stage entry ``train_network``.

Budgets are steps, never seconds; what a step draws comes from (seed, step, part of the batch). In a process that has
called ``make_repeatable`` equal inputs give equal bytes on one machine, however often the training was killed.
"""

import copy
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from rich.progress import track
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from hoidata.batches.dataset import ClipBatch
from hoidata.errors import BadInput
from hoidata.files import atomic_folder, canonical_json, sha256_bytes, sha256_file
from hoidata.files.written import EMPTY
from hoidata.hands import HandPair
from hoidata.settings import at_least, build_config, key_in_file, plain_config, refuse_unknown
from hoidata.store.annotated import load_annotated
from models.common.checkpoints import (
    FILE_NAME,
    checkpoint_file,
    empty_reason,
    load_checkpoint,
    save_checkpoint,
    write_empty,
)  # fmt: skip
from models.common.corpus import Corpus, Wanted, batches
from models.common.family import Network, Objective, Setup
from models.common.features import Hands, Normaliser
from models.common.precision import Precision, compute_in
from models.common.progress import LOG_NAME, WEIGHTS, Diverged, Progress, Row, State, all_finite, write_log
from models.common.repeatable import own_draws, seed_draws
from models.common.team import Team

# Folder, in that of the progress, with the last good checkpoint of a training that diverged.
LAST_GOOD = "last_good"
# Steps between two looks at the losses. The CPU has them at once; another device is waited for.
CHECK_EVERY_ON_CPU, CHECK_EVERY = 1, 50


@dataclass(frozen=True)
class TrainingConfig:
    """Budget and optimiser (AdamW). The defaults are Text2HOI's, but for ``steps``.

    schedule: "constant", or "cosine" to zero after ``warmup`` steps. ema_decay: of the running average of the weights
    that is kept (0: the weights themselves). keep_best: keep the step with the lowest validation loss, not
    the last. Without validation clips the last step is kept.
    augmented_copies: how many copies of every clip are seen beside it, with other paths, turns and moments
    (``common.augmentation``); they are kept in memory, each as large as its clip.
    precision: of Transformers and point networks, where the time is; all else stays float32. parts: of a batch, whose
    gradients (and statistics of batch norms) are averaged; they take turns, or are shared by ``train.processes``.
    save_every: steps after which all is written down that a killed training needs to go on; long steps sooner, by time
    (``progress.SAVE_AFTER_S``).
    """

    steps: int = 30_000
    batch: int = 64
    learning_rate: float = 1e-4
    weight_decay: float = 0.01
    schedule: Literal["constant", "cosine"] = "constant"
    warmup: int = 0
    ema_decay: float = 0.0
    clip_norm: float = 0.0
    keep_best: bool = False
    validate_every: int = 500
    augmented_copies: int = 0
    precision: Precision = "float32"
    parts: int = 1
    save_every: int = 500

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "validate_every", "parts", "save_every"):
            at_least("training", self, name, 1)
        at_least("training", self, "augmented_copies", 0)


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
        refuse_unknown(params, ("network", "training", "loss", "seed"), where)
        network_key, training_key, loss_key = (
            key_in_file(params, name, where) for name in ("network", "training", "loss")
        )
        return cls(
            build_config(network.config, params.get("network"), network_key),
            build_config(TrainingConfig, params.get("training"), training_key),
            build_config(network.loss, params.get("loss"), loss_key) if network.loss else None,
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
    device: str = "cpu",
    progress: str | Path | None = None,
    code: str = "",
    full_key: Callable[[str], str] = str,
) -> Path:
    """Train one network on the training clips of one dataset; the path of what was written.

    annotated_root: folder with clips, annotation, contact and splits. params: see :meth:`Plan.of`.
    hands: the hand model of the clips where it is not the embedded one. provenance: from facts to what is stored.
    needed: the checkpoint folder of every network that ``network.needs`` names. device: as torch names it; recorded.
    progress: a folder where a killed training leaves what it needs to go on, and its losses so far. code: a digest of
    what runs; a training of other code, data or settings is not taken up. full_key: from a key of ``params``, such as
    ``training.learning_rate``, to the one that the user has to edit.

    Reads the train split, and validation for choosing; never test. Writes ``model.safetensors`` and ``log.csv``, or
    ``empty.json`` with the reason where there is nothing to train on; the folder appears whole or not at all, at the
    end. In a :class:`Team` only one process writes. Raises BadInput at the first loss that is no finite number.
    """
    plan, needed, team = Plan.of(network, params), needed or {}, Team.joined()
    if missing := set(network.needs) - {other.name for other in needed}:
        got = f"none of {', '.join(sorted(missing))}"
        raise BadInput(f"training of {network.name}", "checkpoint folders", got, "pass needed")
    folders = [*(Path(annotated_root) / name for name in ("clips", "annotation", "contact")), *needed.values()]
    if reason := next(filter(None, map(empty_reason, folders)), None):
        return _write_empty(out_folder, reason, team)
    annotated = load_annotated(annotated_root, hands)
    corpus = Corpus.of(annotated, plan.seed, crop=network.crop)
    if not len(corpus.train):
        return _write_empty(out_folder, f"{annotated_root}: no training clips", team)
    if not len(corpus.validation) and team.writes:
        print(f"{network.name}: no validation clips; nothing is chosen, the last weights are kept", file=sys.stderr)
    pair, where = annotated.store.hand_pair(), torch.device(device)
    trained = {other.name: load_checkpoint(folder, other, where) for other, folder in needed.items()}
    with own_draws(where):
        seed_draws(plan.seed)
        setup = Setup(plan.network, plan.loss, plan.seed, corpus, Hands(pair), where, trained)
        objective, normaliser = network.objective(setup)
        kept_there = None
        if progress is not None:
            made_from = [network.name, code, corpus.digest(), pair.digest, where.type, asdict(plan)]
            made_from += [sha256_file(checkpoint_file(folder)) for folder in needed.values()]
            kept_there = Progress(Path(progress), sha256_bytes(canonical_json(made_from).encode()), team.writes)
        info = Info(network, plan, corpus, corpus.facts(pair) | {"device": where.type}, provenance)
        try:
            kept, log = fit(objective, corpus, plan.training, plan.seed, where, kept_there)
        except Diverged as diverged:
            raise _explained(diverged, info, normaliser, kept_there, full_key) from diverged
    if not team.writes:
        return Path(out_folder) / FILE_NAME
    with atomic_folder(out_folder) as partial:
        save_checkpoint(partial, network.name, kept, normaliser, info.of(kept, log))
        write_log(partial / LOG_NAME, log)
    if kept_there:
        kept_there.clear()
    return Path(out_folder) / FILE_NAME


@dataclass(frozen=True)
class Info:
    """What a checkpoint records of its training, but for what is known at the end alone."""

    network: Network
    plan: Plan
    corpus: Corpus
    facts: dict[str, Any]
    provenance: Callable[[dict[str, Any]], dict[str, Any]] | None

    def of(self, kept: nn.Module, log: list[Row]) -> dict[str, Any]:
        """For the weights that are kept, with the log up to them."""
        end, plan = log[-1], self.plan
        facts = {"model": self.network.name, "seed": plan.seed, "steps": int(end["step"] or 0), **self.facts}
        return {
            "facts": facts,
            "training": plain_config(plan.training),
            "loss": plain_config(plan.loss) if plan.loss else {},
            "results": {"validation_loss": end["validation"], **self.network.results(kept, self.corpus)},
            "provenance": self.provenance(facts) if self.provenance else {},
        }


def _write_empty(out_folder: str | Path, reason: str, team: Team) -> Path:
    if team.writes:
        with atomic_folder(out_folder) as partial:
            write_empty(partial, reason)
    return Path(out_folder) / EMPTY


def _explained(
    diverged: Diverged,
    info: Info,
    normaliser: Normaliser | None,
    progress: Progress | None,
    full_key: Callable[[str], str],
) -> BadInput:
    """The error for the user; the last good weights are written as a checkpoint before."""
    training, name = info.plan.training, info.network.name
    rate, clip = full_key("training.learning_rate"), full_key("training.clip_norm")
    got = f"{diverged.what} at step {diverged.step} of {training.steps}"
    remedy = f"lower {rate} ({training.learning_rate:g}) or set {clip} (now {training.clip_norm:g}; 0 is off)"
    if diverged.step == 1:  # before the optimiser has changed a weight
        remedy = "look for clips with numbers that are not finite (`hoidata validate`), or for a loss weighted too high"
    kept = "nothing was kept: no weights were saved or validated before"
    state = diverged.state
    if progress and (good := _last_good(state, progress)):
        path, log = progress.folder / LAST_GOOD, good
        if progress.writes:
            save_checkpoint(path, name, state.kept, normaliser, info.of(state.kept, log))
        kept = f"the last good weights, of step {log[-1]['step']:g}, are kept in {path / FILE_NAME}"
    return BadInput(f"training of {name}", "finite losses and weights", got, f"{remedy}; {kept}")


def _last_good(state: State, progress: Progress) -> list[Row]:
    """Put the best weights, or those that were saved last, into ``state.kept``; the log up to them, or nothing."""
    if state.best:
        best = next(number for number, row in enumerate(state.log) if row["validation"] == state.best_loss)
        state.kept.load_state_dict(state.best)
        return state.log[: best + 1]
    if not progress.state_file.is_file() or not progress.read(state):
        return []
    return [*state.log, {"step": state.step, "validation": None}]


def fit(
    objective: Objective,
    corpus: Corpus,
    config: TrainingConfig,
    seed: int,
    device: torch.device,
    progress: Progress | None = None,
) -> tuple[nn.Module, list[Row]]:
    """Run the steps; the network to keep, in evaluation mode, and one log row per validation."""
    team, network = Team.joined(), objective.network.train()
    learnt = [parameter for parameter in network.parameters() if parameter.requires_grad]
    optimiser = torch.optim.AdamW(learnt, lr=config.learning_rate, weight_decay=config.weight_decay, fused=True)
    state = State(network, copy.deepcopy(network).eval().requires_grad_(False), optimiser)
    compute_in(network, config.precision)
    if progress:
        progress.load(state)
    shared = team.own_parts(config.parts), config.parts
    wanted = Wanted(objective.frames, objective.entries, *shared, config.augmented_copies)
    stream = batches(corpus.train, config.batch, seed, wanted, state.step)
    remaining, losses = range(state.step + 1, config.steps + 1), dict[int, Tensor]()
    check_every = CHECK_EVERY_ON_CPU if device.type == "cpu" else CHECK_EVERY
    for step in track(remaining, description=type(network).__name__, transient=True, disable=not team.writes):
        optimiser.zero_grad(set_to_none=True)
        losses[step] = _add_gradients(state, objective, next(stream), (seed, step, config.parts), device, team)
        is_validated = step % config.validate_every == 0 or step == config.steps
        if is_validated or step % check_every == 0:
            _refuse_not_finite(losses, state)
        _update(state, learnt, config)
        state.step = step
        if is_validated:
            _validate(state, objective if len(corpus.validation) else None, config)
        if progress:
            progress.keep(state, config.save_every)
    if not all_finite(state.kept.state_dict()):
        raise Diverged(state.step, WEIGHTS, state)
    if state.best:
        state.kept.load_state_dict(state.best)
    return state.kept, state.log


def _add_gradients(
    state: State,
    objective: Objective,
    parts: list[tuple[int, ClipBatch]],
    numbers: tuple[int, int, int],
    device: torch.device,
    team: Team,
) -> Tensor:
    """Gradients of one step, the mean over all parts of its batch. numbers: seed, step, and how many parts there are.

    Gives () the loss, the same in every process of the team, on the device. Every part starts with the same statistics
    of batch norms; the mean of what they become is kept.
    """
    seed, step, of = numbers
    buffers = list(state.network.buffers()) if of > 1 else []
    before = [buffer.clone() for buffer in buffers]
    statistics = [buffer for buffer in buffers if buffer.is_floating_point()]
    after = [torch.zeros_like(buffer) for buffer in statistics]
    losses = dict[str, Tensor]()
    for part, batch in parts:
        for buffer, old in zip(buffers, before, strict=True):
            buffer.copy_(old)
        found = objective.losses(batch.to(device), seed_draws(seed, step, part))
        (found["total"] / of).backward()
        for total, buffer in zip(after, statistics, strict=True):
            total += buffer / of
        for name, value in found.items():
            losses[name] = losses.get(name, 0) + value.detach() / of
    learnt = [parameter for parameter in state.network.parameters() if parameter.requires_grad]
    for parameter in learnt:
        # What a batch did not use (hands that are in none of its clips) has moments like all else, in every process.
        parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
    team.add_up([*after, *losses.values(), *(parameter.grad for parameter in learnt if parameter.grad is not None)])
    for buffer, total in zip(statistics, after, strict=True):
        buffer.copy_(total)
    for name, value in losses.items():
        state.running[name] = state.running.get(name, 0) + value
    return losses["total"]


def _refuse_not_finite(losses: dict[int, Tensor], state: State) -> None:
    """Raise Diverged at the first of these steps whose loss is no finite number; forget them otherwise."""
    for step, loss in zip(losses, torch.stack(list(losses.values())).tolist(), strict=True):
        if not math.isfinite(loss):
            raise Diverged(step, f"a loss of {loss:g}", state)
    losses.clear()


def _update(state: State, learnt: list[nn.Parameter], config: TrainingConfig) -> None:
    """One step of the optimiser and of the running average."""
    for group in state.optimiser.param_groups:
        group["lr"] = config.learning_rate * learning_rate_factor(state.step + 1, config)
    if config.clip_norm:
        nn.utils.clip_grad_norm_(learnt, config.clip_norm)
    state.optimiser.step()
    _follow(state.kept, state.network, config.ema_decay if state.step >= config.warmup else 0.0)


def _validate(state: State, objective: Objective | None, config: TrainingConfig) -> None:
    """A row of the log; the weights and the loss where they are the best so far. objective: None without clips."""
    steps = state.step - (int(state.log[-1]["step"] or 0) if state.log else 0)
    row: Row = {f"train_{name}": float(value) / steps for name, value in state.running.items()}
    loss = None if objective is None else float(objective.validation(state.kept))
    if loss is not None and not math.isfinite(loss):
        raise Diverged(state.step, f"a validation loss of {loss:g}", state)
    state.log.append({"step": state.step, "validation": loss, **row})
    state.running = {}
    if loss is not None and loss < state.best_loss:
        state.best_loss = loss
        if config.keep_best:
            state.best = copy.deepcopy(state.kept.state_dict())


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
    get_ema_multi_avg_fn(decay)(list(kept.parameters()), list(network.parameters()), None)  # one call on a GPU
    for target, source in zip(kept.buffers(), network.buffers(), strict=True):
        target.copy_(source)
