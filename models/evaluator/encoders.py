"""Loads the trained evaluator networks of a dataset as encoders for ``evaluate_store``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from hoidata.clips.clip import Side
from hoidata.files import canonical_json, sha256_bytes
from hoidata.metrics.encoded import Encoding
from hoidata.metrics.pair import Motion
from hoidata.metrics.paths import even_frames, joints_and_presence
from hoidata.settings import plain_config
from models.common.checkpoints import FILE_NAME, load_checkpoint
from models.common.family import StoredNetwork
from models.evaluator.inputs import corrected_input, padded, paper_input
from models.evaluator.networks import EncoderConfig, MotionEncoder


@dataclass(frozen=True)
class MotionEvaluator:
    """A trained network as ``hoidata.metrics.encoded.Encoder``."""

    name: str
    network: MotionEncoder
    labels: tuple[str, ...]
    digest: str

    @torch.no_grad()
    def encode(self, motions: Sequence[Motion], sides: Sequence[tuple[Side, ...]]) -> Encoding:
        """Features and logits; the text-motion encoder has unit features and no logits."""
        to_input = _planar if self.network.config.trunk == "planar" else corrected_input
        inputs = [to_input(motion, acting) for motion, acting in zip(motions, sides, strict=True)]
        feature, logits = self.network(*padded(inputs))
        if self.network.text is not None:
            feature, logits = nn.functional.normalize(logits, dim=-1), logits[:, :0]
        return Encoding(feature.double().numpy(), logits.double().numpy())

    @torch.no_grad()
    def encode_text(self, text: np.ndarray) -> np.ndarray | None:
        if self.network.text is None:
            return None
        return self.network.of_text(torch.from_numpy(np.asarray(text, np.float32))).double().numpy()


def load_evaluators(folder: str | Path) -> list[MotionEvaluator]:
    """All networks below ``evaluators/<profile>/<dataset>`` in order of name; empty if the evaluator is off."""
    return [load_evaluator(path.parent) for path in sorted(Path(folder).glob(f"*/{FILE_NAME}"))]


def load_evaluator(folder: Path) -> MotionEvaluator:
    """The network in ``folder``. Raises BadInput as ``load_checkpoint`` does."""
    checkpoint = load_checkpoint(folder, stored_network(folder.name))
    network = checkpoint.network
    assert isinstance(network, MotionEncoder)
    return MotionEvaluator(folder.name, network, tuple(checkpoint.facts["labels"]), weights_digest(network))


def stored_network(name: str) -> StoredNetwork:
    """How the checkpoint of an evaluator network is stored."""
    return StoredNetwork(f"evaluator-{name}", EncoderConfig, MotionEncoder)


def weights_digest(network: MotionEncoder) -> str:
    """SHA-256 of configuration and weights, independent of the other contents of the checkpoint."""
    tensors = {name: tensor.contiguous() for name, tensor in sorted(network.state_dict().items())}
    digests = {name: sha256_bytes(tensor.numpy().tobytes()) for name, tensor in tensors.items()}
    return sha256_bytes(canonical_json([plain_config(network.config), digests]).encode())


def _planar(motion: Motion, sides: tuple[Side, ...]) -> np.ndarray:
    joints, present = joints_and_presence(motion, sides)
    return paper_input(joints, present, even_frames(len(joints)))
