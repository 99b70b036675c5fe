"""The training loop of every network, and ``train_network``, which writes a checkpoint.

Budgets are steps, never seconds. The random numbers of a step depend on seed, step and micro-batch. In a process that
has called ``make_repeatable``, equal inputs give equal bytes on one machine, however often the training was killed.
"""

import copy
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from hoidata.batches.dataset import ClipBatch
from hoidata.errors import BadInput
from hoidata.files import atomic_folder, canonical_json, sha256_bytes, sha256_file
from hoidata.files.written import EMPTY
from hoidata.hands import HandPair
from hoidata.settings import build_config, check_keys, key_in_file, plain_config, require_at_least
from hoidata.store.annotated import load_annotated
from models.common.checkpoints import (
    FILE_NAME,
    checkpoint_file,
    empty_reason,
    load_checkpoint,
    save_checkpoint,
    write_empty,
)  # fmt: skip
from models.common.corpus import BatchSpec, Corpus, batches
from models.common.family import Network, Objective, Setup
from models.common.features import Hands, Normaliser
from models.common.point_net import PointNet
from models.common.progress import LOG_NAME, WEIGHTS, Diverged, Line, Progress, Row, State, all_finite, write_log
from models.common.repeatable import restored_rng, seeded_generator
from models.common.team import Team
from models.common.transformer import Encoder

Precision = Literal["float32", "bfloat16"]
# Subfolder of the progress folder with the last good checkpoint of a training that diverged.
LAST_GOOD = "last_good"
# Steps between two checks that losses are finite. On a GPU each check waits for the device.
CHECK_EVERY_ON_CPU, CHECK_EVERY = 1, 50


@dataclass(frozen=True)
class TrainingConfig:
    """Budget and optimiser (AdamW). Except for ``steps``, defaults are those of Text2HOI's code."""

    steps: int = 30_000
    batch: int = 64
    learning_rate: float = 1e-4
    weight_decay: float = 0.01
    # After ``warmup`` steps: constant, or half a cosine down to zero.
    schedule: Literal["constant", "cosine"] = "constant"
    # Steps of linear warm-up.
    warmup: int = 0
    # Decay of the running average of the weights, which is the result; 0: the result is the weights themselves.
    ema_decay: float = 0.0
    # Largest norm of the gradient; 0: not clipped.
    clip_norm: float = 0.0
    # Keep the step with the lowest validation loss instead of the last one; needs validation clips.
    keep_best: bool = False
    validate_every: int = 500
    # Augmented copies of every clip (``common.augmentation``), in addition to the clip. They are cached in memory.
    augmented_copies: int = 0
    # Arithmetic of Transformers and point networks; everything else is float32.
    precision: Precision = "float32"
    # Parts of a batch whose gradients and batch-norm statistics are averaged, one after the other or in
    # ``train.processes`` processes.
    micro_batches: int = 1
    # Steps between two saves of the training state; slow steps are saved sooner (``progress.SAVE_AFTER_S``).
    save_every: int = 500

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "validate_every", "micro_batches", "save_every"):
            require_at_least("training", self, name, 1)
        require_at_least("training", self, "augmented_copies", 0)


@dataclass(frozen=True)
class TrainingSpec:
    """One training, as params.yaml specifies it."""

    network: Any  # config of the network
    training: TrainingConfig
    loss: Any  # config of the loss, or None
    seed: int

    @classmethod
    def of(cls, network: Network, params: Mapping[str, Any]) -> "TrainingSpec":
        """From a network's section of params.yaml: ``network``, ``training``, ``loss`` and ``seed``, each optional.

        Raises BadInput for unknown keys.
        """
        section = f"params.yaml: {network.name}"
        check_keys(params, ("network", "training", "loss", "seed"), section)

        def built(config: type, name: str) -> Any:
            return build_config(config, params.get(name), key_in_file(params, name, section))

        loss = built(network.loss, "loss") if network.loss else None
        return cls(
            built(network.config, "network"), built(TrainingConfig, "training"), loss, int(params.get("seed", 0))
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
    """Train one network on the training clips of one dataset.

    Reads the train split, and the validation split for selection; never test. Writes ``model.safetensors`` and
    ``log.csv``, or ``empty.json`` with the reason if there is nothing to train on. The folder appears complete or not
    at all. In a :class:`Team` only one process writes.

    Args:
        annotated_root: folder with clips, annotation, contact and splits.
        params: see :meth:`TrainingSpec.of`.
        hands: the hand model of the clips, if it is not the embedded one.
        needed: the checkpoint folder of every network in ``network.needs``.
        provenance: from facts about the training to what the checkpoint stores.
        device: a name of torch; stored in the checkpoint.
        progress: folder for the state from which a killed training resumes, and for its log so far.
        code: digest of the code; a training with other code, data or settings is not resumed.
        full_key: from a key of ``params``, such as ``training.learning_rate``, to the key that the user has to edit.

    Returns the path of the file that was written. Raises BadInput: a loss or a weight is not finite, or the settings
    are wrong.
    """
    spec, needed, team = TrainingSpec.of(network, params), needed or {}, Team.joined()
    if missing := set(network.needs) - {other.name for other in needed}:
        got = f"none of {', '.join(sorted(missing))}"
        raise BadInput(f"training of {network.name}", "checkpoint folders", got, "pass needed")
    folders = [*(Path(annotated_root) / name for name in ("clips", "annotation", "contact")), *needed.values()]
    if reason := next(filter(None, map(empty_reason, folders)), None):
        return _write_empty(out_folder, reason, team)
    annotated = load_annotated(annotated_root, hands)
    corpus = Corpus.of(annotated, spec.seed, crop=network.crop)
    if not len(corpus.train):
        return _write_empty(out_folder, f"{annotated_root}: no training clips", team)
    if not len(corpus.validation) and team.writes:
        print(f"{network.name}: no validation clips; nothing is chosen, the last weights are kept", file=sys.stderr)
    pair, torch_device = annotated.store.hand_pair(), torch.device(device)
    trained = {other.name: load_checkpoint(folder, other, torch_device) for other, folder in needed.items()}
    with restored_rng(torch_device):
        seeded_generator(spec.seed)
        setup = Setup(
            network=spec.network,
            loss=spec.loss,
            seed=spec.seed,
            corpus=corpus,
            hands=Hands(pair),
            device=torch_device,
            trained=trained,
        )
        objective, normaliser = network.objective(setup)
        saved_progress = None
        if progress is not None:
            inputs = [network.name, code, corpus.digest(), pair.digest, torch_device.type, asdict(spec)]
            inputs += [sha256_file(checkpoint_file(folder)) for folder in needed.values()]
            saved_progress = Progress(Path(progress), sha256_bytes(canonical_json(inputs).encode()), team.writes)
        info = Info(
            network=network,
            spec=spec,
            corpus=corpus,
            facts=corpus.facts(pair) | {"device": torch_device.type},
            provenance=provenance,
        )
        try:
            result, log = fit(objective, corpus, spec.training, spec.seed, torch_device, saved_progress)
        except Diverged as diverged:
            raise _explained(diverged, info, normaliser, saved_progress, full_key) from diverged
    if not team.writes:
        return Path(out_folder) / FILE_NAME
    with atomic_folder(out_folder) as partial:
        save_checkpoint(partial, network.name, result, normaliser, info.of(result, log))
        write_log(partial / LOG_NAME, log)
    if saved_progress:
        saved_progress.clear()
    return Path(out_folder) / FILE_NAME


@dataclass(frozen=True)
class Info:
    """What a checkpoint stores about its training."""

    network: Network
    spec: TrainingSpec
    corpus: Corpus
    facts: dict[str, Any]
    provenance: Callable[[dict[str, Any]], dict[str, Any]] | None

    def of(self, result: nn.Module, log: list[Row]) -> dict[str, Any]:
        """The record for the resulting weights, with the log up to them."""
        end, spec = log[-1], self.spec
        facts = {"model": self.network.name, "seed": spec.seed, "steps": int(end["step"] or 0), **self.facts}
        return {
            "facts": facts,
            "training": plain_config(spec.training),
            "loss": plain_config(spec.loss) if spec.loss else {},
            "results": {"validation_loss": end["validation"], **self.network.results(result, self.corpus)},
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
    """The error for the user. Writes the last good weights as a checkpoint first."""
    training, name = info.spec.training, info.network.name
    rate, clip = full_key("training.learning_rate"), full_key("training.clip_norm")
    got = f"{diverged.quantity} at step {diverged.step} of {training.steps}"
    remedy = f"lower {rate} ({training.learning_rate:g}) or set {clip} (now {training.clip_norm:g}; 0 is off)"
    if diverged.step == 1:  # the optimiser has not changed a weight yet
        remedy = "look for clips with numbers that are not finite (`hoidata validate`), or for a loss weighted too high"
    saved = "no weights are saved: none were validated before"
    state = diverged.state
    if progress and (good := _last_good(state, progress)):
        path, log = progress.folder / LAST_GOOD, good
        if progress.writes:
            save_checkpoint(path, name, state.ema_network, normaliser, info.of(state.ema_network, log))
        saved = f"the last good weights, of step {log[-1]['step']:g}, are kept in {path / FILE_NAME}"
    return BadInput(f"training of {name}", "finite losses and weights", got, f"{remedy}; {saved}")


def _last_good(state: State, progress: Progress) -> list[Row]:
    """Load the best weights, or else the last saved ones, into ``state.ema_network``; the log up to them, or none."""
    if state.best:
        best = next(number for number, row in enumerate(state.log) if row["validation"] == state.best_loss)
        state.ema_network.load_state_dict(state.best)
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
    """Run the training steps. Returns the resulting network in evaluation mode, and one log entry per validation."""
    team, network = Team.joined(), objective.network.train()
    trainable = [parameter for parameter in network.parameters() if parameter.requires_grad]
    groups = _parameter_groups(network)
    optimiser = torch.optim.AdamW(groups, lr=config.learning_rate, weight_decay=config.weight_decay, fused=True)
    state = State(network, copy.deepcopy(network).eval().requires_grad_(False), optimiser)
    compute_in(network, config.precision)
    if progress:
        progress.load(state)
    batch_spec = BatchSpec(
        frames=objective.frames,
        entries=objective.entries,
        parts=team.own_micro_batches(config.micro_batches),
        of=config.micro_batches,
        augmented_copies=config.augmented_copies,
    )
    stream = batches(corpus.train, config.batch, seed, batch_spec, state.step)
    losses, line = dict[int, Tensor](), Line(state.step, config.steps)
    check_every = CHECK_EVERY_ON_CPU if device.type == "cpu" else CHECK_EVERY
    for step in range(state.step + 1, config.steps + 1):
        optimiser.zero_grad(set_to_none=True)
        numbers = seed, step, config.micro_batches
        losses[step] = loss = _add_gradients(state, objective, next(stream), numbers, device, team)
        is_validated = step % config.validate_every == 0 or step == config.steps
        if is_validated or step % check_every == 0:
            _refuse_not_finite(losses, state)
        _update(state, trainable, config)
        state.step = step
        if is_validated:
            _validate(state, objective if len(corpus.validation) else None, config)
        if progress:
            progress.save_if_due(state, config.save_every)
        if team.writes:
            line.print_if_due(step, loss)
    if not all_finite(state.ema_network.state_dict()):
        raise Diverged(state.step, WEIGHTS, state)
    if state.best:
        state.ema_network.load_state_dict(state.best)
    return state.ema_network, state.log


def compute_in(network: nn.Module, precision: Precision) -> None:
    """Make Transformers and point networks compute in ``precision`` (autocast). Weights and outputs stay float32."""
    if precision == "float32":
        return
    for module in network.modules():
        if isinstance(module, Encoder | PointNet):
            lowered = _lowered(module.forward, getattr(torch, precision))
            setattr(module, "forward", lowered)  # noqa: B010 (pyright knows forward as a method)


def _lowered(forward: Any, dtype: torch.dtype) -> Any:
    def lowered(x: Tensor, *arguments: Any) -> Any:
        with torch.autocast(x.device.type, dtype):
            outputs = forward(x, *arguments)
        return outputs.float() if isinstance(outputs, Tensor) else tuple(output.float() for output in outputs)

    return lowered


def _parameter_groups(network: nn.Module) -> list[dict[str, Any]]:
    """Trainable parameters, with a factor of the learning rate for those that ``network.learning_rate_factors`` names.

    ``learning_rate_factors``, if a network has it, is a sequence of prefixes of parameter names with their factors.
    """
    factors = {"": 1.0, **dict(getattr(network, "learning_rate_factors", ()))}
    groups: dict[str, list[nn.Parameter]] = {prefix: [] for prefix in factors}
    for name, parameter in network.named_parameters():
        if parameter.requires_grad:
            groups[max((prefix for prefix in factors if name.startswith(prefix)), key=len)].append(parameter)
    return [{"params": groups[prefix], "factor": factor} for prefix, factor in factors.items()]


def _add_gradients(
    state: State,
    objective: Objective,
    parts: list[tuple[int, ClipBatch]],
    numbers: tuple[int, int, int],
    device: torch.device,
    team: Team,
) -> Tensor:
    """Add the gradients of one step: the mean over all micro-batches, in all processes of the team.

    Every micro-batch starts from the same batch-norm statistics; the mean of their updates is the result.

    Args:
        parts: this process's micro-batches, with their numbers.
        numbers: seed, step, and the number of micro-batches of all processes.

    Returns () the loss, equal in every process, on the device.
    """
    seed, step, of = numbers
    buffers = list(state.network.buffers()) if of > 1 else []
    before = [buffer.clone() for buffer in buffers]
    statistics = [buffer for buffer in buffers if buffer.is_floating_point()]
    after = [torch.zeros_like(buffer) for buffer in statistics]
    losses = dict[str, Tensor]()
    for part, batch in parts:
        for buffer, old in zip(buffers, before, strict=True):
            # Batch-norm statistics start equal for every micro-batch.
            buffer.copy_(old)
        terms = objective.losses(batch.to(device), seeded_generator(seed, step, part))
        (terms["total"] / of).backward()
        for total, buffer in zip(after, statistics, strict=True):
            total += buffer / of
        for name, value in terms.items():
            losses[name] = losses.get(name, 0) + value.detach() / of
    trainable = [parameter for parameter in state.network.parameters() if parameter.requires_grad]
    for parameter in trainable:
        # A parameter that a batch does not use, such as of an absent hand, still updates its moments in every process.
        parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
    team.sum_over_team(
        [*after, *losses.values(), *(parameter.grad for parameter in trainable if parameter.grad is not None)]
    )
    for buffer, total in zip(statistics, after, strict=True):
        buffer.copy_(total)
    for name, value in losses.items():
        state.running[name] = state.running.get(name, 0) + value
    return losses["total"]


def _refuse_not_finite(losses: dict[int, Tensor], state: State) -> None:
    """Raise Diverged at the first step whose loss is not finite; otherwise clear ``losses``."""
    for step, loss in zip(losses, torch.stack(list(losses.values())).tolist(), strict=True):
        if not math.isfinite(loss):
            raise Diverged(step, f"a loss of {loss:g}", state)
    losses.clear()


def _update(state: State, trainable: list[nn.Parameter], config: TrainingConfig) -> None:
    """One step of the optimiser and of the running average."""
    for group in state.optimiser.param_groups:
        group["lr"] = config.learning_rate * group["factor"] * learning_rate_factor(state.step + 1, config)
    if config.clip_norm:
        nn.utils.clip_grad_norm_(trainable, config.clip_norm)
    state.optimiser.step()
    _update_ema(state.ema_network, state.network, config.ema_decay if state.step >= config.warmup else 0.0)


def _validate(state: State, objective: Objective | None, config: TrainingConfig) -> None:
    """Validate, append to the log, and store the weights if they are the best so far. objective: None without clips."""
    steps = state.step - (int(state.log[-1]["step"] or 0) if state.log else 0)
    train_losses: Row = {f"train_{name}": float(value) / steps for name, value in state.running.items()}
    loss = None if objective is None else float(objective.validation(state.ema_network))
    if loss is not None and not math.isfinite(loss):
        raise Diverged(state.step, f"a validation loss of {loss:g}", state)
    state.log.append({"step": state.step, "validation": loss, **train_losses})
    state.running = {}
    if loss is not None and loss < state.best_loss:
        state.best_loss = loss
        if config.keep_best:
            state.best = copy.deepcopy(state.ema_network.state_dict())


def learning_rate_factor(step: int, config: TrainingConfig) -> float:
    """Factor of the learning rate: linear warm-up, then constant, or half a cosine down to zero at the last step."""
    if step <= config.warmup:
        return step / max(config.warmup, 1)
    if config.schedule == "constant":
        return 1.0
    fraction = (step - config.warmup) / max(config.steps - config.warmup, 1)
    return 0.5 * (1 + math.cos(math.pi * fraction))


@torch.no_grad()
def _update_ema(average: nn.Module, network: nn.Module, decay: float) -> None:
    """Update the running average of the weights; buffers, such as batch-norm statistics, are copied."""
    get_ema_multi_avg_fn(decay)(list(average.parameters()), list(network.parameters()), None)  # one call on a GPU
    for target, source in zip(average.buffers(), network.buffers(), strict=True):
        target.copy_(source)
