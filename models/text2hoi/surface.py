"""Hands against the surface of a moving, articulated object: what the refiner sees and what its losses measure."""

from collections.abc import Iterable

import torch
from torch import Tensor

from hoidata.batches.requests import RequestBatch
from hoidata.objects.model import ObjectModel
from hoidata.objects.signed_distance_grid import DistanceFields
from models.common.features import Hands, object_hinge_rad, to_object_frame
from models.text2hoi.refiner import CoarseMotion


class Surface:
    """Joints and vertices of hand features, and their signed distances to each clip's object."""

    def __init__(self, hands: Hands, fields: DistanceFields) -> None:
        self.hands, self.fields = hands, fields

    @classmethod
    def of(cls, hands: Hands, objects: Iterable[ObjectModel], resolution: int, device: torch.device) -> "Surface":
        """Fields of all these objects, told apart by their names."""
        fields = DistanceFields([(model.name, model) for model in objects], resolution)
        return cls(hands.to(device), fields.to(device))

    def coarse(
        self, batch: RequestBatch, hands: Tensor, objects: Tensor, contact_map: Tensor, present: Tensor
    ) -> CoarseMotion:
        """The refiner's view of generated hands (B, 2, F, 99) and object (B, F, 10) with contact maps (B, N).

        present: (B, 2, F) bool, the frames in which a hand is there.
        """
        joints = self.hands.joints(hands, batch.betas, batch.template_m)
        local, distance, offset = self.measure(batch, joints, objects)
        return CoarseMotion(hands, objects, local, distance, offset, present, batch, contact_map)

    def measure(self, batch: RequestBatch, points_m: Tensor, objects: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """For points (B, 2, F, P, 3) of the model frame and objects (B, F, 10): the points in the object's frame, their
        signed distance (B, 2, F, P), and the offset to the nearest surface point (B, 2, F, P, 3)."""
        local = to_object_frame(points_m, objects[:, None])
        rows = self.fields.rows([model.name for model in batch.objects])
        hinge = object_hinge_rad(objects) * batch.articulated[:, None]
        both_sides = local.transpose(1, 2).flatten(2, 3)
        distance, offset = self.fields.query(rows, both_sides, hinge)
        shape = (len(local), local.shape[2], 2, local.shape[3])
        return local, distance.reshape(shape).transpose(1, 2), offset.reshape(*shape, 3).transpose(1, 2)
