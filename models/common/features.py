"""Motion features to rotations, joints and surface points, in torch; and their normalisation.

Feature layout: ``hoidata.clips.features``. Axes (batch, side, frame, ...); sides left, right; metres, model frame.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.batches.requests import RequestBatch
from hoidata.clips.clip import SIDES
from hoidata.clips.features import (
    GLOBAL_ORIENT_6D,
    HAND_FEATURES,
    HAND_POSE_6D,
    HAND_ROTATIONS_6D,
    N_ROTATIONS,
    OBJECT_FEATURES,
    OBJECT_HINGE,
    OBJECT_POSITION,
    OBJECT_ROTATION_6D,
    WRIST,
)
from hoidata.devices import send
from hoidata.geometry.rotations import rot6d_to_rotmat, rotmat_to_rot6d, rotvec_to_rotmat
from hoidata.hands import HandKinematics, HandPair

TEXT_FEATURES = 512  # of a sentence, whatever the encoder
# First-frame rotation, appended to features whose rotation is relative to the first frame.
OBJECT_START_6D = slice(OBJECT_FEATURES, OBJECT_FEATURES + 6)
# Least standard deviation by which a feature is divided, so that noise in a constant feature is not amplified.
SMALLEST_SCALE = 0.05


def scaled_text(text: Tensor) -> Tensor:
    """Sentence features (..., D) scaled to length sqrt(D), independent of the encoder's scale."""
    return nn.functional.normalize(text, dim=-1) * text.shape[-1] ** 0.5


def verb_one_hot(verbs: Sequence[str | None], known: Sequence[str], device: torch.device) -> Tensor:
    """(B, len(known)) one-hot verbs; zeros for a verb that is not known."""
    return send(torch.tensor([[float(verb == name) for name in known] for verb in verbs]), device)


def hand_rotmats(hands: Tensor) -> Tensor:
    """Local rotations (..., 16, 3, 3) of hand features (..., 99), the global one first."""
    return rot6d_to_rotmat(hands[..., HAND_ROTATIONS_6D].reshape(*hands.shape[:-1], N_ROTATIONS, 6))


def object_rotmat(objects: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of object features (..., 10)."""
    return rot6d_to_rotmat(objects[..., OBJECT_ROTATION_6D])


def proper_hands(hands: Tensor) -> Tensor:
    """Hand features (..., 99) with every 6D rotation made orthonormal."""
    return torch.cat((hands[..., WRIST], rotmat_to_rot6d(hand_rotmats(hands)).flatten(-2)), -1)


def proper_object(objects: Tensor) -> Tensor:
    """Object features (..., 10) with the 6D rotation made orthonormal."""
    return torch.cat(
        (objects[..., OBJECT_POSITION], rotmat_to_rot6d(object_rotmat(objects)), objects[..., OBJECT_HINGE:]), -1
    )


def base_middle_m(points_m: Tensor, part: Tensor) -> Tensor:
    """Centre (..., 3) of the bounding box of an object's base, or of the whole object if no point is of the base.

    points_m: (..., N, 3) in the object's frame. part: (..., N), 1 if the hinge moves the point.
    """
    moved = (part == 1) & ~(part == 1).all(-1, keepdim=True)
    lowest, highest = (points_m.masked_fill(moved[..., None], bound) for bound in (math.inf, -math.inf))
    return (lowest.amin(-2) + highest.amax(-2)) / 2


def placed_at(objects: Tensor, point_m: Tensor) -> Tensor:
    """Object features (..., F, 10) with ``point_m`` (..., 3), given in the object's frame, as the position.

    ``-point_m`` inverts it.
    """
    position = objects[..., OBJECT_POSITION] + (object_rotmat(objects) @ point_m[..., None, :, None])[..., 0]
    return torch.cat((position, objects[..., OBJECT_ROTATION_6D.start :]), -1)


def recentred(hands: Tensor, objects: Tensor) -> tuple[Tensor, Tensor]:
    """Hands (..., 2, F, 99) and objects (..., F, 10) moved so that the object's position is zero in the first frame."""
    shift = objects[..., :1, OBJECT_POSITION]
    hands = torch.cat((hands[..., WRIST] - shift.unsqueeze(-3), hands[..., WRIST.stop :]), -1)
    return hands, torch.cat((objects[..., OBJECT_POSITION] - shift, objects[..., OBJECT_POSITION.stop :]), -1)


def to_object_frame(points_m: Tensor, objects: Tensor) -> Tensor:
    """World points (..., point, 3) in the frame of the object (..., 10): ``R^T (p - t)``."""
    return (points_m - objects[..., None, OBJECT_POSITION]) @ object_rotmat(objects)


def hands_in_object_frame(hands: Tensor, objects: Tensor) -> Tensor:
    """Hand features (B, 2, F, 99) relative to the object (B, F, 10): wrist and global rotation change."""
    rotation, position = object_rotmat(objects)[:, None], objects[:, None, :, OBJECT_POSITION]
    return _moved(hands, rotation.transpose(-1, -2), position)


def hands_in_world(hands: Tensor, objects: Tensor) -> Tensor:
    """The inverse of :func:`hands_in_object_frame`."""
    rotation, position = object_rotmat(objects)[:, None], objects[:, None, :, OBJECT_POSITION]
    inverse_origin = -(position[..., None, :] @ rotation)[..., 0, :]
    return _moved(hands, rotation, inverse_origin)


def _moved(hands: Tensor, rotation: Tensor, origin: Tensor) -> Tensor:
    """Rotate wrist and global 6D by ``rotation`` about ``origin``."""
    wrist = (rotation @ (hands[..., WRIST] - origin)[..., None])[..., 0]
    # A 6D rotation is two columns of a matrix, stored by row.
    columns = rotation @ hands[..., GLOBAL_ORIENT_6D].unflatten(-1, (3, 2))
    return torch.cat((wrist, columns.flatten(-2), hands[..., HAND_POSE_6D]), -1)


def place_points(batch: RequestBatch, objects: Tensor) -> Tensor:
    """Object points (B, F, 1024, 3) at each pose (B, F, 10), with the moving part moved by its joint."""
    hinge_rotmat = rotvec_to_rotmat(batch.hinge_axis[:, None] * objects[..., OBJECT_HINGE, None])
    origin = batch.hinge_origin_m[:, None, None]
    slid_m = (batch.slide_m[:, None] * objects[..., OBJECT_HINGE, None])[..., None, :]
    still = batch.points_m[:, None].expand(-1, objects.shape[1], -1, -1)
    moved = (still - origin) @ hinge_rotmat.transpose(-1, -2) + origin + slid_m
    # Only part 1 of an articulated object moves with the hinge.
    moves = ((batch.part == 1) & batch.articulated[:, None])[:, None, :, None]
    articulated = torch.where(moves, moved, still)
    return articulated @ object_rotmat(objects).transpose(-1, -2) + objects[..., None, OBJECT_POSITION]


def turned_since_start(objects: Tensor) -> Tensor:
    """Object features (F, 16): rotations become relative to the first frame, whose rotation (6 numbers) is appended."""
    rotation = object_rotmat(objects)
    since_start_6d, start_6d = rotmat_to_rot6d(rotation @ rotation[0].T), rotmat_to_rot6d(rotation[:1])
    start_6d = start_6d.expand(len(objects), -1)
    return torch.cat((objects[:, OBJECT_POSITION], since_start_6d, objects[:, OBJECT_HINGE:], start_6d), -1)


def mean_start(rows: Tensor, mask: Tensor) -> Tensor:
    """First-frame rotations (B, 1, 3, 3): the mean over control points (B, L, 16) that ``mask`` (B, L) marks valid."""
    start_6d = (rows[..., OBJECT_START_6D] * mask[..., None]).sum(1, keepdim=True)
    return rot6d_to_rotmat(start_6d / mask.sum(1)[:, None, None])


def turned_from(rows: Tensor, start: Tensor) -> Tensor:
    """Object features (B, F, 10): the inverse of ``turned_since_start``, for first-frame rotations (B, 1, 3, 3)."""
    rotation = rotmat_to_rot6d(object_rotmat(rows) @ start)
    return torch.cat((rows[..., OBJECT_POSITION], rotation, rows[..., OBJECT_HINGE:OBJECT_FEATURES]), -1)


class Hands(nn.Module):
    """Forward kinematics of both hands as a layer on hand features; without trainable weights."""

    def __init__(self, pair: HandPair) -> None:
        super().__init__()
        self.digest = pair.digest
        self.kinematics = nn.ModuleList([HandKinematics(pair[side]) for side in SIDES])

    def joints(self, hands: Tensor, betas: Tensor, template_m: Tensor | None = None) -> Tensor:
        """Joints (B, 2, F, 21, 3), metres, of features (B, 2, F, 99); betas (B, 2, 10), template (B, 2, 778, 3)."""
        joints = [layer.joints(*arguments) for layer, arguments in self._sides(hands, betas, template_m)]
        return torch.stack([side.reshape(len(hands), hands.shape[2], 21, 3) for side in joints], 1)

    def vertices(self, hands: Tensor, betas: Tensor, template_m: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Vertices (B, 2, F, 778, 3) and joints (B, 2, F, 21, 3), metres; arguments as in ``joints``."""
        both = [layer(*arguments) for layer, arguments in self._sides(hands, betas, template_m)]
        shape = (len(hands), hands.shape[2], -1, 3)
        vertices, joints = zip(*[(mesh.reshape(shape), joint.reshape(shape)) for mesh, joint in both], strict=True)
        return torch.stack(vertices, 1), torch.stack(joints, 1)

    def _sides(
        self, hands: Tensor, betas: Tensor, template_m: Tensor | None
    ) -> Iterator[tuple[HandKinematics, tuple[Tensor, Tensor, Tensor, Tensor | None]]]:
        """The layer of each side, and its arguments for all frames."""
        for side, layer in enumerate(self.kinematics):
            assert isinstance(layer, HandKinematics)
            flat, n_frames = hands[:, side].reshape(-1, HAND_FEATURES), hands.shape[2]
            frame_betas = betas[:, side].repeat_interleave(n_frames, 0)
            template = None if template_m is None else template_m[:, side].repeat_interleave(n_frames, 0)
            yield layer, (flat[..., WRIST], hand_rotmats(flat), frame_betas, template)


@dataclass(frozen=True)
class Normaliser:
    """Mean and standard deviation of every feature over the training frames."""

    hand_mean: Tensor  # (2, 99), by hand
    hand_scale: Tensor  # (2, 99)
    object_mean: Tensor  # (10,) or (16,)
    object_scale: Tensor  # (10,) or (16,)

    @classmethod
    def of(cls, clips: Sequence[tuple[Tensor, Tensor, Tensor]]) -> "Normaliser":
        """From training clips: hands (2, K, 99), object (L, 10 or 16), present (2, K); absent hands are skipped."""
        means, scales = np.zeros((2, HAND_FEATURES)), np.ones((2, HAND_FEATURES))
        for side in range(2):
            hands = [hand[side][present[side]] for hand, _, present in clips]
            means[side], scales[side] = _moments(hands, HAND_FEATURES)
        objects = [points for _, points, _ in clips]
        object_mean, object_scale = _moments(objects, objects[0].shape[-1] if objects else OBJECT_FEATURES)
        arrays = (means, scales, object_mean, object_scale)
        return cls(*(torch.from_numpy(np.asarray(array, dtype=np.float32)) for array in arrays))

    @classmethod
    def identity(cls, object_features: int = OBJECT_FEATURES) -> "Normaliser":
        """A normaliser that does not change features."""
        shapes = (2, HAND_FEATURES), (object_features,)
        return cls(torch.zeros(shapes[0]), torch.ones(shapes[0]), torch.zeros(shapes[1]), torch.ones(shapes[1]))

    def scaled_to(self, deviation: float) -> "Normaliser":
        """A normaliser that scales features to this standard deviation instead of 1."""
        return replace(self, hand_scale=self.hand_scale / deviation, object_scale=self.object_scale / deviation)

    def encode(self, hands: Tensor, objects: Tensor) -> tuple[Tensor, Tensor]:
        """Features (B, 2, F, 99) and (B, F, 10) to zero mean and unit deviation."""
        hands = (hands - self.hand_mean[:, None]) / self.hand_scale[:, None]
        return hands, (objects - self.object_mean) / self.object_scale

    def decode(self, hands: Tensor, objects: Tensor) -> tuple[Tensor, Tensor]:
        """The inverse of ``encode``."""
        hands = hands * self.hand_scale[:, None] + self.hand_mean[:, None]
        return hands, objects * self.object_scale + self.object_mean

    def to(self, device: torch.device | str) -> "Normaliser":
        """A copy on ``device``."""
        return Normaliser(*(tensor.to(device) for tensor in self.tensors().values()))

    def tensors(self) -> dict[str, Tensor]:
        """The four tensors with their field names, to store in a checkpoint."""
        return dict(vars(self))


def _moments(frames: list[Tensor], size: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (size,) over frames (frame, size)."""
    values = torch.cat([torch.zeros(0, size), *frames]).double().numpy()
    if not len(values):
        return np.zeros(size), np.ones(size)
    scale = values.std(axis=0)
    rotations = (OBJECT_ROTATION_6D, OBJECT_START_6D)[: 2 if size == OBJECT_START_6D.stop else 1]
    for group in (WRIST,) if size == HAND_FEATURES else (OBJECT_POSITION, *rotations):
        # One scale per position, and per object rotation, keeps directions comparable.
        scale[group] = np.sqrt((scale[group] ** 2).mean())
    return values.mean(axis=0), np.maximum(scale, SMALLEST_SCALE)
