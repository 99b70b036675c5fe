"""What a model family is: its networks, and the one question it answers: motions for requests."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip, HandTrack, ObjectTrack
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair
from hoidata.store.annotated import AnnotatedStore
from models.common.corpus import Corpus
from models.common.features import (
    Hands,
    Normaliser,
    hand_rotmats,
    hand_wrist_m,
    object_hinge_rad,
    object_position_m,
    object_rotmat,
)

DOWN = np.array([0.0, 0.0, -1.0])
Figures = dict[str, dict[str, float]]
Losses = dict[str, Tensor]


class Objective(Protocol):
    """How to train one network. frames, entries: how many frames of each clip and distance entries of all of them
    batches are to carry for its losses (``Wanted``)."""

    frames: int
    entries: int

    @property
    def network(self) -> nn.Module: ...

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        """Named losses of one training batch; "total" is the one to minimise."""
        ...

    def validation(self, network: nn.Module) -> Tensor:
        """() the loss on held-out clips, always with the same draws; network is in evaluation mode.

        Called only where there are validation clips (``Corpus.held_out``).
        """
        ...


@dataclass(frozen=True)
class Setup:
    """What an objective is made from. network, loss: its configs. trained: the checkpoint of each network it needs."""

    network: Any
    loss: Any
    seed: int
    corpus: Corpus
    hands: Hands
    device: torch.device
    trained: Mapping[str, Any]


@dataclass(frozen=True)
class StoredNetwork:
    """What reading a checkpoint needs. name: that it says of itself. config: a frozen dataclass; build: to a module."""

    name: str
    config: type
    build: Callable[[Any], nn.Module]


@dataclass(frozen=True)
class Network(StoredNetwork):
    """One network of a family, trained by one stage; ``name`` is that of its checkpoint folder, unique over all.

    objective: how it is trained, with the normalisation it is trained in or None. loss: config of the objective.
    needs: names of the networks that must be trained before. crop: of training clips that are too long.
    results: what else is found on training and validation clips and kept in the checkpoint, as plain values.
    """

    objective: Callable[[Setup], tuple[Objective, Normaliser | None]]
    loss: type | None = None
    needs: tuple[str, ...] = ()
    crop: Literal["random", "start"] = "random"
    results: Callable[[nn.Module, Corpus], Mapping[str, Any]] = lambda network, corpus: {}


@dataclass(frozen=True)
class Sources:
    """What a family may use to answer. annotated: the dataset; checkpoints: folder with one folder per network.

    hands: the hand model of the dataset's clips. settings: sections of families, by name.
    """

    annotated: AnnotatedStore
    checkpoints: Path
    hands: HandPair
    device: torch.device
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class LeftOut:
    """A request that a family has no answer to. clip_id: of the motion that was asked for; reason: in words."""

    clip_id: str
    reason: str


class Sampler(Protocol):
    """A family that is ready to answer."""

    def sample(self, requests: Sequence[Request]) -> Sequence[Clip | LeftOut]:
        """One answer per request, in their order. A request gives the same motion in whatever company it is asked."""
        ...


class EachAlone:
    """A sampler that answers every request by itself."""

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        return [self.motion(request) for request in requests]

    def motion(self, request: Request) -> Clip | LeftOut:
        """The answer to one request."""
        raise NotImplementedError


@dataclass(frozen=True)
class Family:
    """A model family. title: in words, for tables. networks: what it trains itself.

    uses: networks its motions need, of whatever family. load: makes it ready. diagnose: figures from inside its
    networks on the test clips, by network; {} for most.
    """

    name: str
    title: str
    load: Callable[[Sources], Sampler]
    networks: tuple[Network, ...] = ()
    uses: tuple[str, ...] = ()
    diagnose: Callable[[Sources], Figures] = lambda sources: {}


def motion_clip(request: Request, hands: Tensor, objects: Tensor, synthetic: bool) -> Clip:
    """Features (2, F, 99) and (F, 10) of the model frame as the clip that was asked for.

    A hand that takes no part is invalid in every frame. synthetic: whether the model learnt from generated data. Raises
    BadInput where a number of an active hand or of the object is not finite.
    """
    refuse_not_finite(request, hands[torch.from_numpy(request.active_hands).to(hands.device)], objects)
    hands, objects = hands[:, : request.n_frames].cpu().double(), objects[: request.n_frames].cpu().double()
    rotation, origin = request.world_from_model[:3, :3], request.world_from_model[:3, 3]
    hinge = object_hinge_rad(objects).float().numpy() if request.object.is_articulated else None
    return Clip(
        clip_id=request.motion_id,
        dataset="generated",
        subject="generated",
        sequence=request.clip_id,
        hands={
            side: _track(hands[row], bool(request.active_hands[row]), request, row, rotation, origin)
            for row, side in enumerate(SIDES)
        },
        object=ObjectTrack(
            request.object,
            rotmat_to_rotvec(rotation @ object_rotmat(objects).numpy()).astype(np.float32),
            (object_position_m(objects).numpy() @ rotation.T + origin).astype(np.float32),
            hinge,
        ),
        source_frames=np.arange(request.n_frames, dtype=np.int32),
        gravity=rotation @ DOWN if request.gravity_known else None,
        gravity_note="" if request.gravity_known else "not known of the clip this motion stands for",
        verb=None,
        object_words=request.object_words or request.object.name,
        synthetic=synthetic,
    )


def refuse_not_finite(request: Request, *made: Tensor | np.ndarray) -> None:
    """Raise BadInput that names the request where a model's answer holds a number that is not finite."""
    if not all(bool(torch.isfinite(torch.as_tensor(values)).all()) for values in made):
        asked = f" ({request.sentence.words})" if request.sentence else ""
        remedy = "lower the guidance (--scale), try another seed, or train the network again"
        raise BadInput(f"motion {request.motion_id}{asked}", "finite numbers", "NaN or infinity", remedy)


def _track(
    hand: Tensor, active: bool, request: Request, row: int, rotation: np.ndarray, origin: np.ndarray
) -> HandTrack:
    n_frames = len(hand)
    template = None if request.template_m is None else request.template_m[row]
    betas = request.betas[row][None].astype(np.float32)
    if not active:
        nothing = np.zeros((n_frames, 3), np.float32)
        return HandTrack(
            nothing, nothing, np.zeros((n_frames, 45), np.float32), betas, np.zeros(n_frames, bool), template
        )
    rotmats = hand_rotmats(hand).numpy()
    rotmats[:, 0] = rotation @ rotmats[:, 0]
    turns = rotmat_to_rotvec(rotmats).astype(np.float32)
    wrist = (hand_wrist_m(hand).numpy() @ rotation.T + origin).astype(np.float32)
    return HandTrack(wrist, turns[:, 0], turns[:, 1:].reshape(n_frames, 45), betas, np.ones(n_frames, bool), template)
