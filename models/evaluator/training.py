"""Trains one evaluator network on recorded clips, on the CPU, with early stopping on validation clips.

This loop replaces that of ``models/common/training.py``: the inputs are computed once and an epoch takes a moment.
"""

import copy
import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hoidata.errors import BadInput
from hoidata.metrics.encoded import UNKNOWN
from models.evaluator.inputs import Examples
from models.evaluator.networks import MotionEncoder, rotated

LABEL_SMOOTHING = 0.05
LARGEST_WEIGHT = 5.0  # of a label in the loss: a verb of two clips among 2,000 would decide the network
EVALUATION_BATCH = 256
PLATEAU_EPOCHS = 4  # epochs without gain before the learning rate falls


@dataclass(frozen=True)
class Recipe:
    """Hyperparameters of AdamW training."""

    learning_rate: float
    epochs: int
    batch: int
    patience: int  # epochs without a lower validation loss before training stops
    weight_decay: float = 0.0
    clip_norm: float = 1.0  # of the gradient
    plateau: float = 1.0  # factor on the learning rate after ``PLATEAU_EPOCHS`` epochs without gain
    random_heading: bool = True  # rotate every clip about the vertical at random


# ``paper`` follows the code of Text2HOI, with batches of 16 in place of single clips.
RECIPES = {
    "paper": Recipe(5e-4, epochs=500, batch=16, patience=60, plateau=0.999, random_heading=False),
    "corrected": Recipe(1e-3, epochs=300, batch=16, patience=40, weight_decay=0.01),
    "text-motion": Recipe(1e-3, epochs=300, batch=64, patience=40, weight_decay=0.01),
}


@dataclass(frozen=True)
class Classification:
    """The task of predicting the verb of a motion."""

    labels: tuple[str, ...]
    weights: Tensor  # (label,) weights in the loss, inverse to the frequency, at most ``LARGEST_WEIGHT``
    kind: str  # "sigmoid" per label, as IMoS released it, or "softmax" with label smoothing

    @classmethod
    def of(cls, train: Examples, kind: str) -> "Classification":
        labels = train.trained_verbs
        counts = torch.bincount(train.labels(labels), minlength=len(labels))
        return cls(labels, (len(train) / (len(labels) * counts)).clamp(max=LARGEST_WEIGHT), kind)

    def targets(self, examples: Examples) -> tuple[Tensor, ...]:
        """The target labels (clip,)."""
        return (examples.labels(self.labels),)

    def can_evaluate(self, examples: Examples) -> bool:
        """Whether any clip has a label of the training clips."""
        return bool((self.targets(examples)[0] != UNKNOWN).any())

    def loss(
        self, network: MotionEncoder, logits: Tensor, targets: tuple[Tensor, ...], generator: torch.Generator | None
    ) -> Tensor:
        """The classification loss of a batch; it uses no random numbers."""
        has_label = targets[0] != UNKNOWN
        logits, labels = logits[has_label], targets[0][has_label]
        if self.kind == "sigmoid":
            one_hot = nn.functional.one_hot(labels, len(self.labels)).to(logits)
            return nn.functional.binary_cross_entropy_with_logits(logits, one_hot)
        return nn.functional.cross_entropy(logits, labels, self.weights, label_smoothing=LABEL_SMOOTHING)


class Pairing:
    """The task of matching motions and sentences (symmetric InfoNCE); clips of the same prompt are not negatives."""

    def targets(self, examples: Examples) -> tuple[Tensor, ...]:
        return torch.from_numpy(examples.text), examples.prompts()

    def can_evaluate(self, examples: Examples) -> bool:
        return len(set(examples.prompts().tolist())) > 1  # clips of one prompt have no negatives: any loss is 0

    def loss(
        self, network: MotionEncoder, logits: Tensor, targets: tuple[Tensor, ...], generator: torch.Generator | None
    ) -> Tensor:
        """The contrastive loss of a batch with one random sentence per clip; without a generator the first sentence."""
        text, prompts = targets
        rows = torch.arange(len(text))
        forms = torch.randint(text.shape[1], (len(text),), generator=generator) if generator else 0 * rows
        assert network.log_scale is not None
        motions, sentences = nn.functional.normalize(logits, dim=-1), network.of_text(text[rows, forms])
        similarity = motions @ sentences.T * network.log_scale.exp()
        is_same_prompt = (prompts[:, None] == prompts) & ~torch.eye(len(rows), dtype=torch.bool)
        similarity = similarity.masked_fill(is_same_prompt, -math.inf)
        return (nn.functional.cross_entropy(similarity, rows) + nn.functional.cross_entropy(similarity.T, rows)) / 2


Task = Classification | Pairing


def fit(
    network: MotionEncoder,
    task: Task,
    train: Examples,
    held_out: Examples | None,
    recipe: Recipe,
    seed: int,
    most_steps: int,
) -> MotionEncoder:
    """Train ``network`` and restore its weights with the lowest loss on ``held_out``, in evaluation mode.

    Without ``held_out`` clips the last weights remain. Raises BadInput at the first loss that is not finite.
    """
    generator, trunk, targets = torch.Generator().manual_seed(seed), network.config.trunk, task.targets(train)
    optimiser = torch.optim.AdamW(network.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay)
    best, best_loss, epochs_without_gain, steps = copy.deepcopy(network.state_dict()), math.inf, 0, 0
    for _ in range(recipe.epochs):
        for rows in torch.randperm(len(train), generator=generator).split(recipe.batch):
            motion, lengths = train.random_inputs(trunk, rows, generator)
            if recipe.random_heading:
                motion = rotated(motion, 2 * math.pi * torch.rand(len(rows), generator=generator))
            optimiser.zero_grad(set_to_none=True)
            logits = network.train()(motion, lengths)[1]
            loss = task.loss(network, logits, tuple(target[rows] for target in targets), generator)
            _refuse_not_finite(float(loss.detach()), f"training loss at step {steps + 1}", best_loss)
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), recipe.clip_norm)
            optimiser.step()
            steps += 1
        if held_out is not None:
            validation_loss = held_out_loss(network, task, held_out)
            _refuse_not_finite(validation_loss, f"validation loss after step {steps}", best_loss)
            epochs_without_gain = 0 if validation_loss < best_loss else epochs_without_gain + 1
            if validation_loss < best_loss:
                best, best_loss = copy.deepcopy(network.state_dict()), validation_loss
            elif epochs_without_gain % PLATEAU_EPOCHS == 0:
                for group in optimiser.param_groups:
                    group["lr"] *= recipe.plateau
        if epochs_without_gain >= recipe.patience or steps >= most_steps:
            break
    if held_out is None:
        # The weights after the last step have not been evaluated.
        _refuse_not_finite(held_out_loss(network, task, train), f"training loss after step {steps}", best_loss)
    else:
        network.load_state_dict(best)
    return network.eval()


def _refuse_not_finite(loss: float, description: str, best_loss: float) -> None:
    if not math.isfinite(loss):
        best = "" if math.isinf(best_loss) else f" (the best validation loss before was {best_loss:g})"
        remedy = "look for clips with values that are not finite (`hoidata validate`), or remove the network"
        got = f"a {description} of {loss:g}{best}"
        raise BadInput("evaluator", "finite losses", got, f"{remedy} from evaluator.networks")


@torch.no_grad()
def held_out_loss(network: MotionEncoder, task: Task, held_out: Examples) -> float:
    """The loss of all held-out clips in one batch, without augmentation or sampling."""
    return float(task.loss(network.eval(), logits_of(network, held_out), task.targets(held_out), None))


@torch.no_grad()
def logits_of(network: MotionEncoder, examples: Examples) -> Tensor:
    """(clip, K) logits of all clips."""
    parts = torch.arange(len(examples)).split(EVALUATION_BATCH)
    logits = [network.eval()(*examples.evaluation_inputs(network.config.trunk, rows))[1] for rows in parts]
    return torch.cat([torch.zeros(0, network.config.outputs), *logits])
