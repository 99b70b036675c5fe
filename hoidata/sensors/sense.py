"""What the sensors of a hand say about an object: 1,822 numbers per hand and frame for ManipNet's hand (section 5)."""

from functools import reduce
from typing import NamedTuple

import numpy as np

from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.distance import SignedDistance
from hoidata.objects.rays import EITHER, ENTERING, LEAVING, first_hits, mark_cut_cubes
from hoidata.objects.surface_index import ON_SURFACE_M, PartSurface, SurfaceIndex, nearer_of
from hoidata.sensors.settings import CELLS, OURS, SensorSettings

_CHUNK_FRAMES = 128  # the ambient cells of so many frames take 3 MB


class Sensed(NamedTuple):
    """Metres and canonical axes; equal for a right hand and the left hand that is its mirror image.

    ambient: (frame, 1000) occupancy 0 to 1 of cells, index ``100 x + 10 y + z``. proximity_m: (frame, time, sensor).
    distance_m: (frame, time, point) signed, of joints and tips. normal: (frame, point, 3) gradient of the distance now.
    """

    ambient: np.ndarray
    proximity_m: np.ndarray
    distance_m: np.ndarray
    normal: np.ndarray

    def flat(self) -> np.ndarray:
        """(frame, value) in this order: 1000 + times x sensors + times x points + 3 x points."""
        return np.concatenate([array.reshape(len(array), -1) for array in self], axis=1)


def sensor_size(hand: TrackedHand, settings: SensorSettings = OURS) -> int:
    """How many numbers ``Sensed.flat`` has per frame."""
    return CELLS**3 + len(settings.times_s) * (hand.n_sensors + hand.n_points) + 3 * hand.n_points


def sense(
    hand: TrackedHand,
    state: HandState,
    object_from_wrist: RigidTransform,
    hinge_rad: np.ndarray | None,
    surface: SurfaceIndex,
    settings: SensorSettings = OURS,
) -> Sensed:
    """The sensors of a hand at an object, now and while the hand as it is now is carried by its wrist.

    state: the hand in its wrist's frame (``hand.state(...)``), (frame,). object_from_wrist: (frame, time) transforms at
    the times of ``settings.times_s``, the first now. hinge_rad: (frame, time) of a hinged object, else None.
    surface: of the object (``hoidata.objects.surface_index.surface_index(model)``).
    """
    found = []
    for start in range(0, len(state.joint_m), _CHUNK_FRAMES):
        rows = slice(start, start + _CHUNK_FRAMES)
        parts = _parts(surface, object_from_wrist[rows], None if hinge_rad is None else hinge_rad[rows])
        found.append(_sense(hand, state.taken(rows), parts, settings))
    return Sensed(*(np.concatenate(column) for column in zip(*found, strict=True)))


class _Part(NamedTuple):
    """One part's surface, and (frame, time) transforms from the wrist's frame to the part's at rest."""

    surface: PartSurface
    from_wrist: RigidTransform


def _parts(surface: SurfaceIndex, object_from_wrist: RigidTransform, hinge_rad: np.ndarray | None) -> list[_Part]:
    model = surface.model
    return [
        _Part(own, model.object_from_part(part, hinge_rad).inverse() @ object_from_wrist)
        for part, own in surface.filled.items()
    ]


def _sense(hand: TrackedHand, state: HandState, parts: list[_Part], settings: SensorSettings) -> Sensed:
    distance_m, normal = _distances(hand, state, parts, settings)
    return Sensed(_ambient(hand, state, parts, settings), _proximity(state, parts, settings), distance_m, normal)


def _rows(points: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(points.reshape(-1, 3))


def _distances(
    hand: TrackedHand, state: HandState, parts: list[_Part], settings: SensorSettings
) -> tuple[np.ndarray, np.ndarray]:
    """(frame, time, point) signed distances, and (frame, point, 3) gradients now."""
    points = state.point_m
    now = reduce(nearer_of, (_nearest_now(part, points) for part in parts))
    later = reduce(np.minimum, (_signed_later(part, points, settings.reach_m) for part in parts))
    every = np.concatenate([now.distance_m[:, None], later.reshape(len(points), -1, points.shape[1])], axis=1)
    return np.clip(every, -settings.depth_m, settings.reach_m), now.normal @ hand.wrist_from_canonical


def _signed_later(part: _Part, points: np.ndarray, reach_m: float) -> np.ndarray:
    return part.surface.signed_m(_rows(part.from_wrist[:, 1:] @ points[:, None]), reach_m)


def _nearest_now(part: _Part, points: np.ndarray) -> SignedDistance:
    """Of points (frame, point, 3) of the wrist's frame, as are the gradients."""
    now = part.from_wrist[:, 0]
    found = part.surface.nearest(_rows(now @ points))
    closest, normal = (array.reshape(points.shape) for array in found[1:])
    return SignedDistance(found.distance_m.reshape(points.shape[:2]), closest, now.inverse().turn(normal))


def _proximity(state: HandState, parts: list[_Part], settings: SensorSettings) -> np.ndarray:
    """(frame, time, sensor) way from each sensor along its normal to the object."""
    shape = (*parts[0].from_wrist.rotation.shape[:2], state.sensor_m.shape[1])
    inside, touching = np.zeros(np.prod(shape), bool), np.zeros(np.prod(shape), bool)
    rays = []
    for part in parts:
        start = _rows(part.from_wrist @ state.sensor_m[:, None])
        rays.append((part.surface, start, _rows(part.from_wrist.turn(state.sensor_normal[:, None]))))
        own = part.surface.inside(start)
        near = part.surface.distance_m(start, max(settings.touching_m, ON_SURFACE_M))
        inside |= own & (near > ON_SURFACE_M)
        touching |= own | (near < np.inf)
    look = _forward if settings.inside == "forward" else _backward
    return look(rays, inside, touching, settings).reshape(shape)


_Rays = list[tuple[PartSurface, np.ndarray, np.ndarray]]


def _forward(rays: _Rays, inside: np.ndarray, touching: np.ndarray, settings: SensorSettings) -> np.ndarray:
    """As the release: a touching sensor's ray starts behind it and goes a little beyond it."""
    back = np.where(touching, settings.behind_m, 0.0)
    reach = np.where(touching, settings.behind_m + 2 * settings.touching_m, settings.reach_m)
    behind = np.flatnonzero(touching)
    for _, start, way in rays:
        start[behind] -= settings.behind_m * way[behind]
    met = _first_hits(rays, reach, np.full(len(reach), ENTERING))
    missed = np.where(touching, np.where(inside, -settings.behind_m, 0.0), settings.reach_m)
    return np.where(np.isfinite(met), met - back, missed)


def _backward(rays: _Rays, inside: np.ndarray, touching: np.ndarray, settings: SensorSettings) -> np.ndarray:
    """As the paper: the ray of a sensor inside is reversed and meets the surface on its way out."""
    turned = [(surface, start, np.where(inside[:, None], -way, way)) for surface, start, way in rays]
    reach = np.where(inside, settings.behind_m, settings.reach_m)
    met = np.minimum(_first_hits(turned, reach, np.where(inside, LEAVING, ENTERING)), reach)
    return np.where(inside, -met, met)


def _first_hits(rays: _Rays, reach: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """(ray,) way to the first surface met; infinite where none is. An open mesh is met from both sides."""
    met = np.full(len(reach), np.inf)
    for surface, start, way in rays:
        first_hits(surface.tree, start, way, reach, facing if surface.closed else np.full_like(facing, EITHER), met)
    return met


def _ambient(hand: TrackedHand, state: HandState, parts: list[_Part], settings: SensorSettings) -> np.ndarray:
    """(frame, 1000): 1 less the distance in cells where a cell meets the object, 1 inside, 0 where it does not."""
    knuckle, turn = state.joint_m[:, hand.middle_knuckle], hand.wrist_from_canonical
    middle = knuckle + turn @ np.array(settings.ambient_offset_m)
    if settings.ambient_turn == "knuckle":
        turn = state.joint_rotmats[:, hand.middle_knuckle] @ turn
    turn = np.broadcast_to(turn, (len(knuckle), 3, 3))
    wrist_from_cells, cells = RigidTransform(turn, middle), _CELLS * settings.cell_m
    half = settings.cell_m / 2
    distance, met = np.full(len(knuckle) * CELLS**3, np.inf), np.zeros(len(knuckle) * CELLS**3, bool)
    for part in parts:
        now = part.from_wrist[:, 0]
        own = _rows(now @ wrist_from_cells @ cells)
        inside = part.surface.inside(own)
        outside = np.flatnonzero(~inside)
        far = np.zeros(len(own))
        far[outside] = part.surface.distance_m(own[outside], half * np.sqrt(3))
        distance = np.minimum(distance, far)
        met |= far <= half
        corner = np.flatnonzero((far > half) & (far < np.inf) & ~met)
        cut = np.zeros(len(corner), bool)
        mark_cut_cubes(part.surface.tree, own[corner], (now.rotation @ turn)[corner // CELLS**3], half, cut)
        met[corner] = cut
    return np.where(met, 1 - distance / settings.cell_m, 0.0).reshape(len(knuckle), -1)


_CELLS = np.stack(np.meshgrid(*[np.arange(CELLS) - (CELLS - 1) / 2] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
