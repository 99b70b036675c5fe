"""Requests to a model: a motion of given hands with a given object; and padded batches of requests."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import groupby
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from hoidata.devices import send
from hoidata.errors import BadInput
from hoidata.objects.model import ObjectModel, joint_vectors

MAX_BATCH_SIZE = 64  # requests with the same hand type and similar length, so that there is little padding


@dataclass(frozen=True)
class ObjectPoints:
    """The sampled points of one object, object frame: points_m, normals (N, 3), part (N,) 0 or 1."""

    points_m: np.ndarray
    normals: np.ndarray
    part: np.ndarray


@dataclass(frozen=True)
class Trajectories:
    """Trajectories of wrists and object, in the model frame; features as in ``hoidata.clips.features``."""

    wrists: np.ndarray  # (2, F, 9) position and 6D rotation of each wrist
    valid: np.ndarray  # (2, F) bool: tracked frames
    object: np.ndarray  # (F, 10)


@dataclass(frozen=True)
class Sentence:
    """A prompt, with its verb and object if known."""

    words: str  # as written
    verb: str | None  # base form
    object_words: str | None  # base form


@dataclass(frozen=True)
class Request:
    """A request for one motion."""

    motion_id: str  # id of the clip to generate
    object: ObjectModel
    points: ObjectPoints  # sampled on the object
    text: np.ndarray  # (512,) features of the sentence
    active_hands: np.ndarray  # (2,) bool: left, right
    n_frames: int  # at 30 fps
    seed: int = 0
    number: int = 0  # index among several motions for the same request
    clip_id: str = ""  # the recorded clip that the motion is compared with
    object_words: str = ""
    sentence: Sentence | None = None  # None if only the features are known
    betas: np.ndarray = field(default_factory=lambda: np.zeros((2, 10), np.float32))  # (2, 10) hand shapes
    template_m: np.ndarray | None = None  # (2, 778, 3) personal rest meshes
    world_from_model: np.ndarray = field(default_factory=lambda: np.eye(4))  # (4, 4); models use z up, object at zero
    gravity_known: bool = True  # whether -z of the model frame is the direction of gravity
    trajectories: Trajectories | None = None  # only for families that predict fingers


@dataclass(frozen=True)
class RequestBatch:
    """Requests padded with zeros to the longest one."""

    objects: tuple[ObjectModel, ...]
    text: Tensor  # (B, ...) features of sentences
    points_m: Tensor  # (B, N, 3)
    normals: Tensor  # (B, N, 3)
    part: Tensor  # (B, N)
    scale_m: Tensor  # (B,) ``ObjectModel.scale_m``
    active_hands: Tensor  # (B, 2) bool
    frames: Tensor  # (B, F) bool: False for padding
    lengths: Tensor  # (B,)
    counts: tuple[int, ...]  # the lengths as plain numbers, which need no synchronisation with the device
    sides: tuple[bool, bool]  # likewise: whether each hand is active in any request
    betas: Tensor  # (B, 2, 10)
    template_m: Tensor | None  # (B, 2, 778, 3)
    hinge_axis: Tensor  # (B, 3), zero for rigid objects and prismatic joints
    hinge_origin_m: Tensor  # (B, 3), zero for rigid objects
    slide_m: Tensor  # (B, 3) displacement per unit of the joint feature, zero without a prismatic joint
    articulated: Tensor  # (B,) bool

    def __len__(self) -> int:
        return len(self.objects)

    @property
    def hand_frames(self) -> Tensor:
        """(B, 2, F) bool: the frames of the active hands."""
        return self.active_hands[:, :, None] & self.frames[:, None]

    def to(self, device: torch.device | str) -> Self:
        """Return the batch with all tensors on ``device``."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return replace(
            self, **{name: send(value, device) for name, value in values.items() if isinstance(value, Tensor)}
        )


def collate_requests(requests: Sequence[Request]) -> RequestBatch:
    """Pad requests to one batch. Raises BadInput if only some have personal hand templates."""
    lengths = np.array([request.n_frames for request in requests])
    text = torch.from_numpy(np.stack([request.text for request in requests]))
    return RequestBatch(text=text, **conditions(requests, [request.object for request in requests], lengths))


def bucket_by_length(requests: Sequence[Request]) -> list[list[int]]:
    """Indices of the requests in batches of the same hand type and similar length."""
    keys = [(tuple(request.active_hands.tolist()), request.n_frames) for request in requests]
    ordered = sorted(range(len(requests)), key=keys.__getitem__)
    groups = [list(numbers) for _, numbers in groupby(ordered, key=lambda number: keys[number][0])]
    return [group[start : start + MAX_BATCH_SIZE] for group in groups for start in range(0, len(group), MAX_BATCH_SIZE)]


def conditions(items: Sequence[Any], objects: Sequence[ObjectModel], lengths: np.ndarray) -> dict[str, Any]:
    """Collect the fields of a :class:`RequestBatch`, except the text, of requests or samples with (B,) ``lengths``."""
    hinges = [model.hinge for model in objects]
    joints = [joint_vectors(model) for model in objects]
    arrays = {
        "points_m": np.stack([item.points.points_m for item in items]),
        "normals": np.stack([item.points.normals for item in items]),
        "part": np.stack([item.points.part for item in items]).astype(np.int64),
        "scale_m": np.array([model.scale_m for model in objects], np.float32),
        "active_hands": np.stack([item.active_hands for item in items]),
        "frames": np.arange(lengths.max()) < lengths[:, None],
        "lengths": lengths,
        "betas": np.stack([item.betas for item in items]),
        "hinge_axis": np.stack([axis for axis, _ in joints]).astype(np.float32),
        "hinge_origin_m": np.stack([np.zeros(3) if h is None else h.origin_m for h in hinges]).astype(np.float32),
        "slide_m": np.stack([slide_m for _, slide_m in joints]).astype(np.float32),
        "articulated": np.array([hinge is not None for hinge in hinges]),
    }
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    templates = _batch_templates([item.template_m for item in items])
    plain = {"counts": tuple(lengths.tolist()), "sides": tuple(arrays["active_hands"].any(0).tolist())}
    return {"objects": tuple(objects), "template_m": templates, **plain, **tensors}


def _batch_templates(templates: Sequence[np.ndarray | None]) -> Tensor | None:
    present = [template for template in templates if template is not None]
    if not present:
        return None
    if len(present) < len(templates):
        raise BadInput(
            "collate", "personal hand templates in all clips or in none", "a mixture", "batch one dataset at a time"
        )
    return torch.from_numpy(np.stack(present))
