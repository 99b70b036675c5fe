"""Refinement of BimArt as printed (Eqs. 9 to 12) and released: 100 steps of Adam on pose and shape, no data term.

Squared distances to object vertices stand for the printed norms, as in the released code. Two differences to that code:
the solids of the object's parts decide which vertices are inside, not a ray through the open mesh; and weights do not
decay, because that would pull hands to the world's origin.
"""

from collections.abc import Mapping

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from hoidata.clips.clip import HandTrack, ObjectTrack
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands.kinematics import kinematics_of
from hoidata.hands.model import HandPair, Side
from hoidata.refinement.fitting import GeneratedKeypoints, check_generated
from hoidata.refinement.object_field import ObjectField, world_from_part

STEPS = 100
LEARNING_RATE = 5e-4
PROJECTION_WEIGHT, PENETRATION_WEIGHT, ACCELERATION_WEIGHT = 100.0, 10.0, 1000.0  # w_proj, w_pen and w_acc of Eq. 9
CHUNK_FRAMES = 2  # the penetration term is a mean over the vertices in so many frames, summed over the motion


class ObjectVertices:
    """The vertices of a moving object, and its inside."""

    def __init__(self, track: ObjectTrack) -> None:
        self._field, self._parts = ObjectField(track), []
        for part in track.model.parts:
            chosen = track.model.part == part if track.model.is_articulated else slice(None)
            self._parts.append((world_from_part(track, part), KDTree(track.model.vertices_m[chosen])))

    def inside(self, points_m: np.ndarray) -> np.ndarray:
        """(frame, point) bool, of points (frame, point, 3), world."""
        return self._field.distances(points_m)[0] < 0

    def nearest_m(self, points_m: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """(point, 3) the object vertex nearest to each point (point, 3) in its frame (point,), world."""
        nearest, least = points_m.copy(), np.full(len(points_m), np.inf)
        for world_from_rest, tree in self._parts:
            pose = world_from_rest[frame]
            distance, vertex = tree.query((pose.inverse() @ points_m[:, None])[:, 0])
            candidate = (pose @ tree.data[vertex][:, None])[:, 0]
            nearest = np.where((distance < least)[:, None], candidate, nearest)
            least = np.minimum(distance, least)
        return nearest


def energy_terms(
    vertices_m: Tensor, present: np.ndarray, ids: np.ndarray, to_object_m: np.ndarray, surface: ObjectVertices
) -> tuple[Tensor, Tensor, Tensor]:
    """The terms of Eqs. 10 to 12: projection, penetration and acceleration.

    Args:
        vertices_m: (frame, hand, 778, 3) world.
        present: (frame, hand) bool, frames that have the hand.
        ids: (keypoint,) vertices.
        to_object_m: (frame, hand, keypoint, 3) generated vectors from the keypoints to the object.
    """

    def squares(points_m: Tensor, mask: np.ndarray) -> Tensor:
        """(point,) squared distances of the points in the mask to the nearest object vertex."""
        chosen = points_m[torch.from_numpy(mask)]
        nearest_m = surface.nearest_m(chosen.detach().double().numpy(), np.nonzero(mask)[0])
        return (chosen - torch.from_numpy(nearest_m).to(chosen)).square().sum(-1)

    keypoints_m = vertices_m[:, :, ids]
    projected_m = keypoints_m + torch.from_numpy(to_object_m).to(keypoints_m)
    projection = squares(projected_m, np.repeat(present[..., None], len(ids), axis=2)).mean()
    inside = surface.inside(vertices_m.detach().double().flatten(1, 2).numpy()).reshape(vertices_m.shape[:3])
    inside &= present[..., None]
    chunk = np.nonzero(inside)[0] // CHUNK_FRAMES
    counts = np.bincount(chunk, minlength=1)[chunk]
    penetration = (squares(vertices_m, inside) / torch.from_numpy(counts).to(vertices_m)).sum()
    three_frames = torch.from_numpy(present[2:] & present[1:-1] & present[:-2])
    difference_m = vertices_m.diff(dim=0).diff(dim=0)[three_frames]
    return projection, penetration, difference_m.square().sum() / max(difference_m.numel(), 1)


def refine_as_released(
    pair: HandPair,
    keypoint_ids: np.ndarray,
    generated: Mapping[Side, GeneratedKeypoints],
    tracks: Mapping[Side, HandTrack],
    object_track: ObjectTrack,
) -> dict[Side, HandTrack]:
    """Refine fitted hands together; arguments as in ``refine_hands``. Shapes change, too."""
    for side, hand in generated.items():
        check_generated(side, hand, keypoint_ids, (tracks[side].n_frames, object_track.n_frames))
    surface = ObjectVertices(object_track)
    present = np.stack([hand.is_present for hand in generated.values()], axis=1)
    to_object_m = np.stack([np.nan_to_num(hand.to_object_m) for hand in generated.values()], axis=1)
    unknowns: dict[Side, list[Tensor]] = {side: _unknowns(tracks[side]) for side in generated}
    optimiser = torch.optim.Adam([array for arrays in unknowns.values() for array in arrays], lr=LEARNING_RATE)
    for _ in range(STEPS):
        hands = [_vertices_m(pair, side, arrays, tracks[side].template_m) for side, arrays in unknowns.items()]
        projection, penetration, acceleration = energy_terms(
            torch.stack(hands, 1), present, keypoint_ids, to_object_m, surface
        )
        energy = PROJECTION_WEIGHT * projection + PENETRATION_WEIGHT * penetration + ACCELERATION_WEIGHT * acceleration
        optimiser.zero_grad()
        energy.backward()
        optimiser.step()
    return {side: _track(arrays, tracks[side]) for side, arrays in unknowns.items()}


def _unknowns(track: HandTrack) -> list[Tensor]:
    """Wrist position, axis-angles of the hand and of its fingers, and the shape."""
    arrays = track.wrist_m, track.global_orient, track.hand_pose, track.mean_betas[None]
    return [torch.tensor(np.asarray(array, np.float32)).requires_grad_() for array in arrays]


def _vertices_m(pair: HandPair, side: Side, unknowns: list[Tensor], template_m: np.ndarray | None) -> Tensor:
    wrist_m, orient, fingers, betas = unknowns
    rotmats = rotvec_to_rotmat(torch.cat((orient, fingers), 1).unflatten(1, (-1, 3)))
    template = None if template_m is None else torch.from_numpy(np.asarray(template_m, np.float32))
    return kinematics_of(pair[side])(wrist_m, rotmats, betas, template)[0]


def _track(unknowns: list[Tensor], start: HandTrack) -> HandTrack:
    wrist_m, orient, fingers, betas = (array.detach().numpy().copy() for array in unknowns)
    return HandTrack(wrist_m, orient, fingers, betas=betas, valid=start.valid, template_m=start.template_m)
