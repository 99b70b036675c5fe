"""What a model is asked for: a motion of given hands with a given object, and many of them as one padded batch."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from hoidata.devices import send
from hoidata.errors import BadInput
from hoidata.objects.model import ObjectModel


@dataclass(frozen=True)
class ObjectPoints:
    """The sampled points of one object, in its own frame: points_m, normals (N, 3), part (N,) 0 or 1."""

    points_m: np.ndarray
    normals: np.ndarray
    part: np.ndarray


@dataclass(frozen=True)
class Trajectories:
    """What a recording without fingers knows, in the model frame; rows as in ``hoidata.clips.features``.

    wrists: (2, F, 9) position and 6D turn of each wrist. valid: (2, F) bool, where it was tracked. object: (F, 10).
    """

    wrists: np.ndarray
    valid: np.ndarray
    object: np.ndarray


@dataclass(frozen=True)
class Sentence:
    """words: as written. verb, thing: what is done and the object's words, base forms; None where that is not known."""

    words: str
    verb: str | None
    thing: str | None


@dataclass(frozen=True)
class Request:
    """One motion that is asked for; nothing in it was recorded but what the asker knows.

    motion_id: of the clip to make. clip_id: of the recorded clip whose place it takes, "" where there is none.
    object: the model; points: sampled on it. text: (512,) features of the sentence. sentence: itself, None where
    only its features are known. active_hands: (2,) bool, left and right. n_frames: at 30 fps. seed: of everything that
    is drawn. number: which of several motions asked for alike.
    betas: (2, 10) hand shapes; template_m: (2, 778, 3) personal rest meshes, or None.
    world_from_model: (4, 4) where the motion is to lie; models work z up, the object at the origin in the first frame.
    gravity_known: whether model's -z is known to be where things fall.
    trajectories: of wrists and object, for families that only add the fingers; the others take nothing from there.
    """

    motion_id: str
    object: ObjectModel
    points: ObjectPoints
    text: np.ndarray
    active_hands: np.ndarray
    n_frames: int
    seed: int = 0
    number: int = 0
    clip_id: str = ""
    object_words: str = ""
    sentence: Sentence | None = None
    betas: np.ndarray = field(default_factory=lambda: np.zeros((2, 10), np.float32))
    template_m: np.ndarray | None = None
    world_from_model: np.ndarray = field(default_factory=lambda: np.eye(4))
    gravity_known: bool = True
    trajectories: Trajectories | None = None


@dataclass(frozen=True)
class RequestBatch:
    """Requests padded to the longest of them; tensors, padding is zero.

    objects: the model of each. text (B, ...) features of sentences. points_m, normals (B, N, 3), part (B, N).
    active_hands (B, 2). frames (B, F): True where a motion has a frame. lengths (B,). Two of them also as plain values,
    for which no device has to be waited: counts, the lengths, and sides, whether each acts in any. betas (B, 2, 10).
    template_m (B, 2, 778, 3) or None. hinge_axis, hinge_origin_m (B, 3), zero for rigid objects; articulated (B,).
    """

    objects: tuple[ObjectModel, ...]
    text: Tensor
    points_m: Tensor
    normals: Tensor
    part: Tensor
    active_hands: Tensor
    frames: Tensor
    lengths: Tensor
    counts: tuple[int, ...]
    sides: tuple[bool, bool]
    betas: Tensor
    template_m: Tensor | None
    hinge_axis: Tensor
    hinge_origin_m: Tensor
    articulated: Tensor

    def __len__(self) -> int:
        return len(self.objects)

    @property
    def hand_frames(self) -> Tensor:
        """(B, 2, F) bool: frames in which a hand that takes part is to be there."""
        return self.active_hands[:, :, None] & self.frames[:, None]

    def to(self, device: torch.device | str) -> Self:
        """The batch with every tensor on ``device``."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return replace(
            self, **{name: send(value, device) for name, value in values.items() if isinstance(value, Tensor)}
        )


def collate_requests(requests: Sequence[Request]) -> RequestBatch:
    """Requests to one padded batch. Raises BadInput for personal hand templates in some of them only."""
    lengths = np.array([request.n_frames for request in requests])
    text = torch.from_numpy(np.stack([request.text for request in requests]))
    return RequestBatch(text=text, **conditions(requests, [request.object for request in requests], lengths))


def conditions(asked: Sequence[Any], objects: Sequence[ObjectModel], lengths: np.ndarray) -> dict[str, Any]:
    """The fields of a :class:`RequestBatch` but the text, of B requests or samples: points, hands and their shape.

    objects: the model of each. lengths: (B,) frames.
    """
    hinges = [model.hinge for model in objects]
    arrays = {
        "points_m": np.stack([item.points.points_m for item in asked]),
        "normals": np.stack([item.points.normals for item in asked]),
        "part": np.stack([item.points.part for item in asked]).astype(np.int64),
        "active_hands": np.stack([item.active_hands for item in asked]),
        "frames": np.arange(lengths.max()) < lengths[:, None],
        "lengths": lengths,
        "betas": np.stack([item.betas for item in asked]),
        "hinge_axis": np.stack([np.zeros(3) if h is None else h.axis for h in hinges]).astype(np.float32),
        "hinge_origin_m": np.stack([np.zeros(3) if h is None else h.origin_m for h in hinges]).astype(np.float32),
        "articulated": np.array([hinge is not None for hinge in hinges]),
    }
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    templates = _batch_templates([item.template_m for item in asked])
    plain = {"counts": tuple(lengths.tolist()), "sides": tuple(arrays["active_hands"].any(0).tolist())}
    return {"objects": tuple(objects), "template_m": templates, **plain, **tensors}


def _batch_templates(templates: Sequence[np.ndarray | None]) -> Tensor | None:
    there = [template for template in templates if template is not None]
    if not there:
        return None
    if len(there) < len(templates):
        raise BadInput(
            "collate", "personal hand templates in all clips or in none", "a mixture", "batch one dataset at a time"
        )
    return torch.from_numpy(np.stack(there))
