"""Training of one network of the evaluator: small, on the CPU, chosen on validation clips, from recorded clips alone.

The common loop is not used: it moves a generator's ``ClipBatch``; here an epoch is a moment over inputs that stay.
"""

import copy
import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hoidata.errors import BadInput
from hoidata.metrics.encoded import UNKNOWN
from models.evaluator.inputs import Examples
from models.evaluator.networks import MotionEncoder, turned

LABEL_SMOOTHING = 0.05
ALL_AT_ONCE = 256
SLOWER_AFTER = 4  # epochs in a row without gain


@dataclass(frozen=True)
class Recipe:
    """Optimiser (Adam; with ``weight_decay`` AdamW) and budget. patience: epochs without a lower validation loss.

    plateau: factor on the learning rate after four such epochs. turn: every clip about gravity, at random.
    """

    learning_rate: float
    epochs: int
    batch: int
    patience: int
    weight_decay: float = 0.0
    clip_norm: float = 1.0
    plateau: float = 1.0
    turn: bool = True


# ``paper``: facts sheet 3.1, with batches of 16 for its single clips; the others: sheet 6.1 and 6.4.
RECIPES = {
    "paper": Recipe(5e-4, epochs=500, batch=16, patience=60, plateau=0.999, turn=False),
    "corrected": Recipe(1e-3, epochs=300, batch=16, patience=40, weight_decay=0.01),
    "text-motion": Recipe(1e-3, epochs=300, batch=64, patience=40, weight_decay=0.01),
}


@dataclass(frozen=True)
class Classification:
    """Labels from motions. kind: "sigmoid" of each label, as IMoS released it, or "softmax" with smoothed labels.

    weights: (label,) of each in the loss, so that rare ones count as much.
    """

    labels: tuple[str, ...]
    weights: Tensor
    kind: str

    @classmethod
    def of(cls, train: Examples, kind: str) -> "Classification":
        labels = train.known_verbs
        counts = torch.bincount(train.labels(labels), minlength=len(labels))
        return cls(labels, len(train) / (len(labels) * counts), kind)

    def targets(self, examples: Examples) -> tuple[Tensor, ...]:
        """What is asked of each clip; the first axis counts clips."""
        return (examples.labels(self.labels),)

    def can_weigh(self, examples: Examples) -> bool:
        """Whether one of them has a label of the training clips."""
        return bool((self.targets(examples)[0] != UNKNOWN).any())

    def loss(
        self, network: MotionEncoder, logits: Tensor, targets: tuple[Tensor, ...], generator: torch.Generator | None
    ) -> Tensor:
        """The loss of a batch; nothing of it is drawn."""
        known = targets[0] != UNKNOWN
        logits, wanted = logits[known], targets[0][known]
        if self.kind == "sigmoid":
            one_hot = nn.functional.one_hot(wanted, len(self.labels)).to(logits)
            return nn.functional.binary_cross_entropy_with_logits(logits, one_hot)
        return nn.functional.cross_entropy(logits, wanted, self.weights, label_smoothing=LABEL_SMOOTHING)


class Pairing:
    """Which sentence belongs to which motion (InfoNCE both ways); clips of the same prompt are no negatives."""

    def targets(self, examples: Examples) -> tuple[Tensor, ...]:
        return torch.from_numpy(examples.text), examples.prompts()

    def can_weigh(self, examples: Examples) -> bool:
        return len(examples) > 0

    def loss(
        self, network: MotionEncoder, logits: Tensor, targets: tuple[Tensor, ...], generator: torch.Generator | None
    ) -> Tensor:
        """The loss of a batch; without a generator always that of the first sentences."""
        text, prompts = targets
        rows = torch.arange(len(text))
        forms = torch.randint(text.shape[1], (len(text),), generator=generator) if generator else 0 * rows
        assert network.log_scale is not None
        motions, sentences = nn.functional.normalize(logits, dim=-1), network.of_text(text[rows, forms])
        alike = motions @ sentences.T * network.log_scale.exp()
        same = (prompts[:, None] == prompts) & ~torch.eye(len(rows), dtype=torch.bool)
        alike = alike.masked_fill(same, -math.inf)
        return (nn.functional.cross_entropy(alike, rows) + nn.functional.cross_entropy(alike.T, rows)) / 2


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
    """The network as it was at the lowest loss on ``held_out``, in evaluation mode; without those clips at the end.

    Raises BadInput at the first loss that is no finite number.
    """
    generator, trunk, targets = torch.Generator().manual_seed(seed), network.config.trunk, task.targets(train)
    optimiser = torch.optim.AdamW(network.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay)
    best, best_loss, since, steps = copy.deepcopy(network.state_dict()), math.inf, 0, 0
    for _ in range(recipe.epochs):
        for rows in torch.randperm(len(train), generator=generator).split(recipe.batch):
            motion, lengths = train.drawn(trunk, rows, generator)
            if recipe.turn:
                motion = turned(motion, 2 * math.pi * torch.rand(len(rows), generator=generator))
            optimiser.zero_grad(set_to_none=True)
            logits = network.train()(motion, lengths)[1]
            loss = task.loss(network, logits, tuple(target[rows] for target in targets), generator)
            _refuse_not_finite(float(loss.detach()), f"training loss at step {steps + 1}", best_loss)
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), recipe.clip_norm)
            optimiser.step()
            steps += 1
        if held_out is not None:
            found = held_out_loss(network, task, held_out)
            _refuse_not_finite(found, f"validation loss after step {steps}", best_loss)
            since = 0 if found < best_loss else since + 1
            if found < best_loss:
                best, best_loss = copy.deepcopy(network.state_dict()), found
            elif since % SLOWER_AFTER == 0:
                for group in optimiser.param_groups:
                    group["lr"] *= recipe.plateau
        if since >= recipe.patience or steps >= most_steps:
            break
    if held_out is None:
        # Nothing has looked at the weights after the last step.
        _refuse_not_finite(held_out_loss(network, task, train), f"training loss after step {steps}", best_loss)
    else:
        network.load_state_dict(best)
    return network.eval()


def _refuse_not_finite(loss: float, what: str, best_loss: float) -> None:
    if not math.isfinite(loss):
        best = "" if math.isinf(best_loss) else f" (the best validation loss before was {best_loss:g})"
        remedy = "look for clips with numbers that are not finite (`hoidata validate`), or leave the network out"
        raise BadInput("evaluator", "finite losses", f"a {what} of {loss:g}{best}", f"{remedy} of evaluator.networks")


@torch.no_grad()
def held_out_loss(network: MotionEncoder, task: Task, held_out: Examples) -> float:
    """The loss of all held-out clips together, as in evaluation: nothing is turned or drawn."""
    return float(task.loss(network.eval(), logits_of(network, held_out), task.targets(held_out), None))


@torch.no_grad()
def logits_of(network: MotionEncoder, examples: Examples) -> Tensor:
    """(clip, K) logits of every clip."""
    parts = torch.arange(len(examples)).split(ALL_AT_ONCE)
    found = [network.eval()(*examples.whole(network.config.trunk, rows))[1] for rows in parts]
    return torch.cat([torch.zeros(0, network.config.outputs), *found])
