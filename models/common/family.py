"""The interface of a model family: networks to train, and a sampler that answers requests with motions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.batches.dataset import ClipBatch, ClipSample, HoiDataset, collate
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip, HandTrack, ObjectTrack
from hoidata.clips.features import N_ROTATIONS, OBJECT_HINGE, OBJECT_POSITION, WRIST
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair
from hoidata.store.annotated import AnnotatedStore
from models.common.corpus import Corpus
from models.common.features import Hands, Normaliser, hand_rotmats, object_rotmat

DOWN = np.array([0.0, 0.0, -1.0])
Figures = dict[str, dict[str, float]]
Losses = dict[str, Tensor]


class Objective(Protocol):
    """How to train one network."""

    frames: int  # selected frames per clip that the losses need (``BatchSpec``)
    entries: int  # distance entries per batch that the losses need (``BatchSpec``)

    @property
    def network(self) -> nn.Module: ...

    def losses(self, batch: ClipBatch, generator: torch.Generator) -> Losses:
        """Loss terms of one training batch; "total" is minimised."""
        ...

    def validation(self, network: nn.Module) -> Tensor:
        """() the loss on validation clips, with fixed random numbers; ``network`` is in evaluation mode.

        Not called without validation clips (``Corpus.held_out``).
        """
        ...


class ClipObjective:
    """An objective that computes the losses of whole clips, without geometry."""

    frames = entries = 0

    def __init__(self, network: nn.Module, corpus: Corpus, device: torch.device) -> None:
        self.network, self.corpus, self.device = network, corpus, device

    @cached_property
    def held_out(self) -> ClipBatch:
        """The validation clips."""
        return collate(self.corpus.held_out).to(self.device)


@dataclass(frozen=True)
class Setup:
    """The inputs of an objective."""

    network: Any  # config of the network
    loss: Any  # config of the loss, or None
    seed: int
    corpus: Corpus
    hands: Hands
    device: torch.device
    trained: Mapping[str, Any]  # checkpoints of the networks in ``Network.needs``


@dataclass(frozen=True)
class StoredNetwork:
    """A network that a checkpoint can contain."""

    name: str  # stored in the checkpoint
    config: type  # a frozen dataclass
    build: Callable[[Any], nn.Module]  # from the config


@dataclass(frozen=True)
class Network(StoredNetwork):
    """One network of a family, trained by one stage; ``name`` is unique and names its checkpoint folder."""

    # Creates the objective, and the normalisation of the features or None.
    objective: Callable[[Setup], tuple[Objective, Normaliser | None]]
    # Config class of the loss; None without settings.
    loss: type | None = None
    # Names of networks that are trained before and passed to the objective.
    needs: tuple[str, ...] = ()
    # Which window of a training clip that is too long.
    crop: Literal["random", "start"] = "random"
    # Plain values computed after training on training and validation clips, and stored in the checkpoint.
    results: Callable[[nn.Module, Corpus], Mapping[str, Any]] = lambda network, corpus: {}


@dataclass(frozen=True)
class Sources:
    """What a family may read to answer requests."""

    annotated: AnnotatedStore
    checkpoints: Path  # folder with one folder per network
    hands: HandPair  # the hand model of the dataset's clips
    device: torch.device
    settings: Mapping[str, Any] = field(default_factory=dict)  # section of params.yaml by family
    encoder: str = ""  # name of the text encoder (``load_encoder``); "": the one that the annotation names

    def clips(self, split: str) -> list[ClipSample]:
        """The clips of a split; of a clip that is too long, the first frames."""
        return list(HoiDataset(self.annotated, split, crop="start"))


@dataclass(frozen=True)
class Skipped:
    """A request that a family cannot answer."""

    clip_id: str  # of the requested motion
    reason: str  # in words


class Sampler(Protocol):
    """A loaded family."""

    def sample(self, requests: Sequence[Request]) -> Sequence[Clip | Skipped]:
        """One answer per request, in order. An answer does not depend on the other requests."""
        ...


@runtime_checkable
class ReportsContact(Protocol):
    """A sampler that conditions motions on contact and reports it."""

    def sample(self, requests: Sequence[Request]) -> Sequence[Clip | Skipped]:
        return self.sample_with_targets(requests)[0]

    def sample_with_targets(self, requests: Sequence[Request]) -> tuple[Sequence[Clip | Skipped], Sequence[Any]]:
        """The answers, with their conditions: (point,) bool touched points, ``TargetDistances`` to hands, or None."""
        ...


class SingleRequestSampler:
    """A sampler that answers requests one by one."""

    def sample(self, requests: Sequence[Request]) -> list[Clip | Skipped]:
        return [self.motion(request) for request in requests]

    def motion(self, request: Request) -> Clip | Skipped:
        """The answer to one request."""
        raise NotImplementedError


@dataclass(frozen=True)
class Family:
    """A model family."""

    name: str
    title: str  # for tables
    load: Callable[[Sources], Sampler]
    networks: tuple[Network, ...] = ()  # trained by this family
    uses: tuple[str, ...] = ()  # names of networks that sampling needs, of any family
    estimates_length: bool = False  # motions do not have the length of the recorded clip
    # Metrics of its networks on the test clips: name of the network to metrics.
    diagnose: Callable[[Sources], Figures] = lambda sources: {}


def motion_clip(request: Request, hands: Tensor, objects: Tensor, synthetic: bool) -> Clip:
    """The requested clip from features (2, F, 99) and (F, 10) in the model frame.

    A hand that is not active is invalid in every frame. Raises BadInput if a number of an active hand or of the object
    is not finite.
    synthetic: whether the model was trained on generated data.
    """
    refuse_not_finite(request, hands[torch.from_numpy(request.active_hands).to(hands.device)], objects)
    hands, objects = hands[:, : request.n_frames].cpu().double(), objects[: request.n_frames].cpu().double()
    rotation, origin = request.world_from_model[:3, :3], request.world_from_model[:3, 3]
    hinge = None
    if request.object.is_articulated:
        hinge = objects[..., OBJECT_HINGE].float().numpy() * np.float32(request.object.joint_scale)
    return Clip(
        clip_id=request.motion_id,
        dataset="generated",
        subject="generated",
        sequence=request.clip_id,
        hands={
            side: _track(hands[index], bool(request.active_hands[index]), request, index, rotation, origin)
            for index, side in enumerate(SIDES)
        },
        object=ObjectTrack(
            request.object,
            rotmat_to_rotvec(rotation @ object_rotmat(objects).numpy()).astype(np.float32),
            (objects[..., OBJECT_POSITION].numpy() @ rotation.T + origin).astype(np.float32),
            hinge,
        ),
        source_frames=np.arange(request.n_frames, dtype=np.int32),
        gravity=rotation @ DOWN if request.gravity_known else None,
        gravity_note="" if request.gravity_known else "not known of the clip this motion stands for",
        verb=None,
        object_words=request.object_words or request.object.name,
        synthetic=synthetic,
    )


def refuse_not_finite(request: Request, *values: Tensor | np.ndarray) -> None:
    """Raise BadInput with the request's name if a model's answer has a number that is not finite."""
    if not all(bool(torch.isfinite(torch.as_tensor(array)).all()) for array in values):
        sentence = f" ({request.sentence.words})" if request.sentence else ""
        remedy = "try another seed, or train the network again"
        raise BadInput(f"motion {request.motion_id}{sentence}", "finite numbers", "NaN or infinity", remedy)


def _track(
    hand: Tensor, active: bool, request: Request, side: int, rotation: np.ndarray, origin: np.ndarray
) -> HandTrack:
    template = None if request.template_m is None else request.template_m[side]
    betas = request.betas[side][None].astype(np.float32)
    wrist_m, rotvec = np.zeros((len(hand), 3), np.float32), np.zeros((len(hand), N_ROTATIONS, 3), np.float32)
    if active:
        rotmats = hand_rotmats(hand).numpy()
        rotmats[:, 0] = rotation @ rotmats[:, 0]
        rotvec = rotmat_to_rotvec(rotmats).astype(np.float32)
        wrist_m = (hand[..., WRIST].numpy() @ rotation.T + origin).astype(np.float32)
    hand_pose, valid = rotvec[:, 1:].reshape(-1, 45), np.full(len(hand), active)
    return HandTrack(wrist_m, rotvec[:, 0], hand_pose, betas=betas, valid=valid, template_m=template)
