"""Losses of generator and refiner (Text2HOI, Eq. 5-7 and 9-11), as means over valid frames.

All geometry is in metres in the model frame. Distances to surfaces come from
``hoidata.objects.signed_distance_grid``, whose gradient reaches the query points only. Masks are 0/1 tensors; an empty
mask gives zero.
"""

import torch
from torch import Tensor
from torch.nn import functional

from hoidata.clips.features import (
    GLOBAL_ORIENT_6D,
    HAND_FEATURES,
    HAND_POSE_6D,
    OBJECT_FEATURES,
    OBJECT_HINGE,
    OBJECT_POSITION,
    OBJECT_ROTATION_6D,
    WRIST,
)
from models.common.features import OBJECT_START_6D

HAND_GROUPS = (WRIST, GLOBAL_ORIENT_6D, HAND_POSE_6D)
OBJECT_GROUPS = (OBJECT_POSITION, OBJECT_ROTATION_6D, slice(OBJECT_HINGE, OBJECT_HINGE + 1), OBJECT_START_6D)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` where ``mask`` (broadcast to them) is set."""
    mask = mask.to(values.dtype).expand_as(values)
    return (values * mask).sum() / mask.sum().clamp_min(1.0)


def distance_map_loss(joints_m: Tensor, points_m: Tensor, entries: Tensor, distance_m: Tensor) -> Tensor:
    """Text2HOI, Eq. 6: squared error of the recorded joint-to-point distances, in metres.

    joints_m (B, 2, F, 21, 3), points_m (B, F, 1024, 3), entries (entry, 5): clip, side, frame, joint, point.
    """
    if not len(entries):
        return joints_m.sum() * 0
    clip, side, frame, joint, point = entries.unbind(1)
    offset = joints_m[clip, side, frame, joint] - points_m[clip, frame, point]
    # The small constant keeps the gradient finite at distance zero.
    predicted = (offset.square().sum(-1) + 1e-10).sqrt()
    return (predicted - distance_m).square().mean()


def joint_loss(joints_m: Tensor, true_m: Tensor, mask: Tensor, weight: Tensor, scale_m: float = 0.01) -> Tensor:
    """Huber loss of joints (B, 2, F, 21, 3) and recorded joints ``true_m``, in units of ``scale_m``.

    mask (B, 2, F); weight (B, 2, F, 21) of each joint. Both in one frame, metres.
    """
    error = (joints_m - true_m) / scale_m
    huber = functional.huber_loss(error, torch.zeros_like(error), reduction="none").sum(-1)
    return (huber * weight * mask[..., None]).sum() / (weight * mask[..., None]).sum().clamp_min(1.0)


def relative_orientation_loss(
    hand: Tensor, objects: Tensor, true_hand: Tensor, true_object: Tensor, mask: Tensor
) -> Tensor:
    """Text2HOI, Eq. 7: squared Frobenius error of ``R_object^T R_hand``, which does not depend on the world frame.

    hand (B, 2, F, 3, 3), object (B, F, 3, 3), mask (B, 2, F).
    """
    predicted = objects[:, None].transpose(-1, -2) @ hand
    true = true_object[:, None].transpose(-1, -2) @ true_hand
    return masked_mean((predicted - true).square().sum((-1, -2)), mask)


def penetration_loss(signed_distance_m: Tensor, mask: Tensor, scale_m: float = 0.01) -> Tensor:
    """Text2HOI, Eq. 10: squared depth of hand vertices inside the object, summed over vertices, in ``scale_m``.

    signed_distance_m (B, 2, F, V), negative inside; mask (B, 2, F).
    """
    depth = (-signed_distance_m).clamp_min(0) / scale_m
    return masked_mean(depth.square().sum(-1), mask)


def contact_loss(
    distance_m: Tensor, true_distance_m: Tensor, mask: Tensor, threshold_m: float, scale_m: float = 0.01
) -> Tensor:
    """Text2HOI, Eq. 11: Huber error of touching joints' surface distances from the recorded ones.

    Signed distances (B, 2, F, 21), mask (B, 2, F). A joint is a finger's radius below its skin. Pulling it onto the
    surface, as the paper does, would push the skin inside. Joints touch if they were recorded within ``threshold_m``.
    """
    near = touching_joints(true_distance_m, threshold_m) & (mask[..., None] > 0)
    error = (distance_m - true_distance_m) / scale_m
    return masked_mean(2 * functional.huber_loss(error, torch.zeros_like(error), reduction="none", delta=3.0), near)


def surface_loss(distance_m: Tensor, mask: Tensor, threshold_m: float, scale_m: float = 1.0) -> Tensor:
    """Text2HOI, Eq. 11 as written: squared surface distances of the joints closer than ``threshold_m``.

    Signed distances (B, 2, F, 21), mask (B, 2, F).
    """
    near = touching_joints(distance_m, threshold_m) & (mask[..., None] > 0)
    return masked_mean((distance_m / scale_m).square(), near)


def touching_joints(distance_m: Tensor, threshold_m: float) -> Tensor:
    """Whether joints are within ``threshold_m`` of the surface, inside or outside."""
    return distance_m.abs() < threshold_m


def take_frames(x: Tensor, chosen: Tensor, axis: int) -> Tensor:
    """The frames ``chosen`` (B, K) of ``x``; ``axis``, 1 or 2, is the frame axis."""
    clip = torch.arange(len(x), device=x.device)[:, None]
    return x[clip, chosen] if axis == 1 else x.transpose(1, 2)[clip, chosen].transpose(1, 2)


def feature_weights(
    by_group: bool, device: torch.device, object_features: int = OBJECT_FEATURES
) -> tuple[Tensor, Tensor]:
    """Loss weights of a hand's 99 and an object's 10 or 16 features, for squared errors of a control point.

    by_group: a mean with equal weight of wrist, palm and fingers, and of the object's position, rotation and hinge;
        else a sum (Text2HOI).
    """
    weights, object_groups = [], [group for group in OBJECT_GROUPS if group.stop <= object_features]
    for size, groups in ((HAND_FEATURES, HAND_GROUPS), (object_features, object_groups)):
        weight = torch.ones(size, device=device)
        for group in groups if by_group else ():
            weight[group] = 1 / (len(groups) * (group.stop - group.start))
        weights.append(weight)
    return weights[0], weights[1]
