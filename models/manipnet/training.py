"""Training of ManipNet on annotated clips: the shared loop draws clips, from each of which steps are drawn."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import nn

from hoidata.batches.dataset import ClipBatch, ClipSample
from hoidata.clips.clip import FPS, SIDES
from hoidata.hands import HandPair
from hoidata.objects.surface_index import surface_index
from models.common.family import Losses, Network, Setup
from models.manipnet.examples import LEARNT, Examples, hand_examples, prepared, step_loss
from models.manipnet.features import FeatureSettings
from models.manipnet.network import ManipNet, NetworkConfig
from models.manipnet.tracks import control_of, finger_rotmats_of, hands_of, trajectories_of


@dataclass(frozen=True)
class LossConfig:
    """rows: steps drawn from each clip of a batch."""

    rows: int = 16


def clip_examples(sample: ClipSample, pair: HandPair, settings: FeatureSettings) -> list[Examples]:
    """The steps of every active hand of a whole clip."""
    hands = hands_of(pair, sample.betas, sample.template_m)
    control, surface = control_of(trajectories_of(sample), sample.object_model), surface_index(sample.object_model)
    time_s = np.arange(sample.length) / FPS
    return [
        hand_examples(
            control,
            side,
            hands[side],
            finger_rotmats_of(sample.hands[row]),
            time_s,
            sample.valid[row],
            surface,
            settings,
        )
        for row, side in enumerate(SIDES)
        if sample.active_hands[row] and (sample.valid[row, :-1] & sample.valid[row, 1:]).any()
    ]


class FingersObjective:
    """Squared error of the next pose and distances; inputs are always the recorded ones."""

    needs_entries = False

    def __init__(self, setup: Setup) -> None:
        pair = setup.corpus.annotated.store.hand_pair()
        self.rows, self.device = setup.loss.rows, setup.device
        settings = replace(setup.network.features, step_s=1 / FPS)
        whole = [setup.corpus.train.whole(clip_id) for clip_id in setup.corpus.train.ids]
        self.examples = {sample.clip_id: clip_examples(sample, pair, settings) for sample in whole}
        hand = hands_of(pair, whole[0].betas, whole[0].template_m)["right"]
        known = [one for clip in self.examples.values() for one in clip]
        self.network = prepared(replace(setup.network, features=settings), hand, known).to(setup.device)
        held = [one for sample in setup.corpus.held_out for one in clip_examples(sample, pair, settings)]
        self.held_out = [np.concatenate([getattr(one, name) for one in held]) for name in LEARNT]

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        drawn = [pair for sample in batch.samples for pair in self._drawn(sample, generator)]
        if not drawn:  # clips in which no hand is seen twice in a row
            return {"total": self.network.decoder.bias.sum() * 0}
        inputs, made = (torch.from_numpy(np.stack(rows)).to(self.device) for rows in zip(*drawn, strict=True))
        return {"total": step_loss(self.network, inputs, made)}

    def _drawn(self, sample: ClipSample, generator: torch.Generator) -> list[tuple[np.ndarray, np.ndarray]]:
        """So many steps of the frames of a cropped clip, any hand."""
        steps = [
            (one, row)
            for one in self.examples[sample.clip_id]
            for row in np.flatnonzero((one.frame >= sample.start) & (one.frame < sample.start + sample.length - 1))
        ]
        if not steps:
            return []
        chosen = torch.randint(len(steps), (self.rows,), generator=generator).tolist()
        return [(one.inputs[row], one.outputs[row]) for one, row in (steps[number] for number in chosen)]

    @torch.no_grad()
    def validation(self, network: nn.Module) -> float:
        assert isinstance(network, ManipNet)
        inputs, made = (torch.from_numpy(rows).to(self.device) for rows in self.held_out)
        return float(step_loss(network, inputs, made))


MANIPNET = Network("manipnet", NetworkConfig, ManipNet, lambda setup: (FingersObjective(setup), None), loss=LossConfig)
