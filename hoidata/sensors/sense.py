"""Readings of a hand's virtual sensors at an object (ManipNet, Sec. 5): 1,822 numbers per frame for ManipNet's hand.

The release also approximates the object: convex pieces instead of the mesh (one piece for cylinder, cube and cup),
distances and normals interpolated from a grid. Those approximations are not reproduced.
"""

from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal, NamedTuple

import numpy as np

from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.distance import SignedDistance
from hoidata.objects.rays import EITHER, ENTERING, LEAVING, first_hits, mark_cut_cubes
from hoidata.objects.surface_index import ON_SURFACE_M, PartSurface, SurfaceIndex, nearer_of

CELLS = 10  # along each axis of the ambient sensor
_CHUNK_FRAMES = 128  # the ambient cells of 128 frames take 3 MB


@dataclass(frozen=True)
class SensorSettings:
    """Sensor ranges and times; canonical axes: x to the fingers, y to the thumb, z out of the back of the hand."""

    # When proximity and distance are measured, now first. The finger pose of now moves with the future wrist.
    times_s: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    cell_m: float = 0.018  # edge of an ambient cell
    # Centre of the ambient cube relative to the middle finger's knuckle, canonical axes.
    ambient_offset_m: tuple[float, float, float] = (0.04, 0.0, -0.09)
    ambient_turn: Literal["knuckle", "wrist"] = "knuckle"  # which joint the cells rotate with
    reach_m: float = 0.1  # longest ray, largest distance
    depth_m: float = 1.0  # largest depth; 1 m does not limit it
    # A sensor inside the object casts its ray forward from a start behind the skin, or backward from the skin.
    inside: Literal["forward", "backward"] = "forward"
    behind_m: float = 0.02  # how far behind the skin a forward ray starts; the length of a backward ray
    # A sensor this close counts as inside. It reads 0 if its ray hits nothing.
    touching_m: float = 0.001


OURS = SensorSettings()  # the definitions of the release
PAPER = replace(OURS, ambient_turn="wrist", depth_m=0.1, inside="backward", behind_m=0.1, touching_m=0.0)


class SensorReadings(NamedTuple):
    """Sensor values in metres and canonical axes; equal for a right hand and its mirror image."""

    ambient: np.ndarray  # (frame, 1000) occupancy of each cell, 0 to 1; cell index ``100 x + 10 y + z``
    proximity_m: np.ndarray  # (frame, time, sensor) length of the ray from the skin to the object
    distance_m: np.ndarray  # (frame, time, point) signed distance of joints and tips
    normal: np.ndarray  # (frame, point, 3) gradient of the distance at the first time

    def flat(self) -> np.ndarray:
        """(frame, value), the fields one after the other: 1000 + times x sensors + times x points + 3 x points."""
        return np.concatenate([array.reshape(len(array), -1) for array in self], axis=1)


def sensor_size(hand: TrackedHand, settings: SensorSettings = OURS) -> int:
    """Number of values per frame in ``SensorReadings.flat``."""
    return CELLS**3 + len(settings.times_s) * (hand.n_sensors + hand.n_points) + 3 * hand.n_points


def sense(
    hand: TrackedHand,
    state: HandState,
    object_from_wrist: RigidTransform,
    hinge_rad: np.ndarray | None,
    surface: SurfaceIndex,
    settings: SensorSettings = OURS,
) -> SensorReadings:
    """Sensor readings of a hand at an object, now and at future times with the finger pose of now.

    Args:
        hand: sensors, capsules and axes of the hand.
        state: (frame,) hand poses in the wrist's frame, as from ``hand.state(...)``.
        object_from_wrist: (frame, time) transforms at ``settings.times_s``; the first time is now.
        hinge_rad: (frame, time) hinge angle of an articulated object, else None.
        surface: surface of the object (``hoidata.objects.surface_index.surface_index(model)``).
    """
    chunks = []
    for start in range(0, len(state.joint_m), _CHUNK_FRAMES):
        frames = slice(start, start + _CHUNK_FRAMES)
        hinge = None if hinge_rad is None else hinge_rad[frames]
        parts = [
            _Part(part_surface, surface.model.object_from_part(part, hinge).inverse() @ object_from_wrist[frames])
            for part, part_surface in surface.filled.items()
        ]
        pose = state.taken(frames)
        ambient, proximity_m = _ambient(hand, pose, parts, settings), _proximity(pose, parts, settings)
        chunks.append(SensorReadings(ambient, proximity_m, *_distances(hand, pose, parts, settings)))
    return SensorReadings(*(np.concatenate(column) for column in zip(*chunks, strict=True)))


class _Part(NamedTuple):
    surface: PartSurface
    from_wrist: RigidTransform  # (frame, time) from the wrist's frame to the rest frame of the part


def _flat_points(points: np.ndarray) -> np.ndarray:
    """(n, 3) contiguous, as compiled code takes them."""
    return np.ascontiguousarray(points.reshape(-1, 3))


def _distances(
    hand: TrackedHand, state: HandState, parts: list[_Part], settings: SensorSettings
) -> tuple[np.ndarray, np.ndarray]:
    """(frame, time, point) signed distances, and (frame, point, 3) gradients now."""
    points = state.point_m
    now = reduce(nearer_of, (_nearest_now(part, points) for part in parts))
    later_m = ((part.surface, _flat_points(part.from_wrist[:, 1:] @ points[:, None])) for part in parts)
    later = reduce(np.minimum, (surface.signed_m(point_m, settings.reach_m) for surface, point_m in later_m))
    distance_m = np.concatenate([now.distance_m[:, None], later.reshape(len(points), -1, points.shape[1])], axis=1)
    return np.clip(distance_m, -settings.depth_m, settings.reach_m), now.normal @ hand.wrist_from_canonical


def _nearest_now(part: _Part, points: np.ndarray) -> SignedDistance:
    """Signed distance and gradient at points (frame, point, 3); points and gradients are in the wrist's frame."""
    now = part.from_wrist[:, 0]
    nearest = part.surface.nearest(_flat_points(now @ points))
    closest, normal = (array.reshape(points.shape) for array in nearest[1:])
    return SignedDistance(nearest.distance_m.reshape(points.shape[:2]), closest, now.inverse().turn(normal))


def _proximity(state: HandState, parts: list[_Part], settings: SensorSettings) -> np.ndarray:
    """(frame, time, sensor) distance from each sensor along its normal to the object."""
    shape = (*parts[0].from_wrist.rotation.shape[:2], state.sensor_m.shape[1])
    inside, touching = np.zeros(np.prod(shape), bool), np.zeros(np.prod(shape), bool)
    rays = []
    for part in parts:
        start = _flat_points(part.from_wrist @ state.sensor_m[:, None])
        rays.append((part.surface, start, _flat_points(part.from_wrist.turn(state.sensor_normal[:, None]))))
        inside_part = part.surface.inside(start)
        near = part.surface.distance_m(start, max(settings.touching_m, ON_SURFACE_M))
        inside |= inside_part & (near > ON_SURFACE_M)
        touching |= inside_part | (near < np.inf)
    cast = _cast_forward if settings.inside == "forward" else _cast_backward
    return cast(rays, inside, touching, settings).reshape(shape)


_Rays = list[tuple[PartSurface, np.ndarray, np.ndarray]]  # per part: surface, ray starts, ray directions


def _cast_forward(rays: _Rays, inside: np.ndarray, touching: np.ndarray, settings: SensorSettings) -> np.ndarray:
    """As ManipNet's release: the ray of a touching sensor starts behind the skin and ends just beyond it."""
    back = np.where(touching, settings.behind_m, 0.0)
    reach = np.where(touching, settings.behind_m + 2 * settings.touching_m, settings.reach_m)
    for _, start, direction in rays:
        start[touching] -= settings.behind_m * direction[touching]
    hit = _first_hits(rays, reach, np.full(len(reach), ENTERING))
    missed = np.where(touching, np.where(inside, -settings.behind_m, 0.0), settings.reach_m)
    return np.where(np.isfinite(hit), hit - back, missed)


def _cast_backward(rays: _Rays, inside: np.ndarray, touching: np.ndarray, settings: SensorSettings) -> np.ndarray:
    """As the paper: the ray of a sensor inside is reversed and hits the surface from within."""
    reversed_rays = [
        (surface, start, np.where(inside[:, None], -direction, direction)) for surface, start, direction in rays
    ]
    reach = np.where(inside, settings.behind_m, settings.reach_m)
    hit = np.minimum(_first_hits(reversed_rays, reach, np.where(inside, LEAVING, ENTERING)), reach)
    return np.where(inside, -hit, hit)


def _first_hits(rays: _Rays, reach: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """(ray,) distance to the first surface, infinite without one. An open mesh is hit from both sides."""
    hit = np.full(len(reach), np.inf)
    for surface, start, direction in rays:
        sides = facing if surface.closed else np.full_like(facing, EITHER)
        first_hits(surface.tree, start, direction, reach, sides, hit)
    return hit


def _ambient(hand: TrackedHand, state: HandState, parts: list[_Part], settings: SensorSettings) -> np.ndarray:
    """(frame, 1000) occupancy: 0 for a cell that misses the object, 1 with its centre inside, else 1 - distance / edge.

    distance: from the centre of the cell to the object.
    """
    knuckle, rotation = state.joint_m[:, hand.middle_knuckle], hand.wrist_from_canonical
    centre = knuckle + rotation @ np.array(settings.ambient_offset_m)
    if settings.ambient_turn == "knuckle":
        rotation = state.joint_rotmats[:, hand.middle_knuckle] @ rotation
    rotation = np.broadcast_to(rotation, (len(knuckle), 3, 3))
    wrist_from_cells, cells = RigidTransform(rotation, centre), _CELLS * settings.cell_m
    half = settings.cell_m / 2
    distance, hit = np.full(len(knuckle) * CELLS**3, np.inf), np.zeros(len(knuckle) * CELLS**3, bool)
    for part in parts:
        now = part.from_wrist[:, 0]
        centres = _flat_points(now @ wrist_from_cells @ cells)
        outside = np.flatnonzero(~part.surface.inside(centres))
        part_distance = np.zeros(len(centres))
        # No point of a cell is farther from its centre than half the diagonal.
        part_distance[outside] = part.surface.distance_m(centres[outside], half * np.sqrt(3))
        distance = np.minimum(distance, part_distance)
        hit |= part_distance <= half
        # Between half an edge and half a diagonal only an exact test of cube and triangle decides.
        unclear = np.flatnonzero((part_distance > half) & (part_distance < np.inf) & ~hit)
        cut = np.zeros(len(unclear), bool)
        axes = (now.rotation @ rotation)[unclear // CELLS**3]
        mark_cut_cubes(part.surface.tree, centres[unclear], axes, half, cut)
        hit[unclear] = cut
    return np.where(hit, 1 - distance / settings.cell_m, 0.0).reshape(len(knuckle), -1)


_CELLS = np.stack(np.meshgrid(*[np.arange(CELLS) - (CELLS - 1) / 2] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
