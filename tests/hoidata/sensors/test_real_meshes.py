"""Sensors on ManipNet's recordings against libigl: at least 100,000 values of each sensor."""

import os
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import igl
import numpy as np
import pytest

from hoidata.clips.clip import SIDES
from hoidata.datasets.base import RawTree, SequenceKey
from hoidata.datasets.manipnet.adapter import read_hand_recording
from hoidata.geometry.transform import RigidTransform
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.surface_index import surface_index
from hoidata.objects.triangle_tree import TriangleTree
from hoidata.sensors import SensorReadings, sense
from models.manipnet.features import FeatureSettings, object_from_wrist
from tests.builders.manipnet import recording_control
from tests.hoidata.sensors import slow
from tests.hoidata.sensors.test_sensors import cells_in_object

ROOT = os.environ.get("HOIDATA_MANIPNET", "")
RECORDINGS = ("cube_med2", "cyl_med3", "cup1", "mug1", "teapot2")
FRAMES = 200  # of each recording and hand; each has 132 distances, 104 rays and 66 components of normals
_MM = 1e3  # libigl skips triangles whose projection along the ray is less than 1e-6 square units
FRAME_STEP = 20  # the 1,000 cells are checked in one of 20 frames


class SensorQuery(NamedTuple):
    """Hand poses at one object."""

    hand: TrackedHand
    state: HandState
    wrist: RigidTransform  # object_from_wrist (frame, time)


@pytest.mark.long
@pytest.mark.skipif(not ROOT, reason="HOIDATA_MANIPNET is not set: the recordings are not part of this repository")
def test_all_sensors_agree_with_libigl_on_real_hands_and_meshes_within_a_micrometre():
    counts = Counter()
    for name in RECORDINGS:
        recording = read_hand_recording(RawTree(Path(ROOT)), SequenceKey("manipnet", "manipnet", name))
        control, surface = recording_control(recording), surface_index(recording.object.model)
        frames = np.flatnonzero(recording.usable)
        frames = frames[np.linspace(0, len(frames) - 1, FRAMES).astype(int)]
        for side in SIDES:
            wrist, _ = object_from_wrist(control, side, recording.time_s[frames], FeatureSettings())
            query = SensorQuery(recording.tracked_hand(side), recording.state(side, frames), wrist)
            readings = sense(query.hand, query.state, query.wrist, None, surface)
            tree = next(iter(surface.filled.values())).tree
            counts.update(_check_distances(query, readings, tree))
            counts.update(_check_proximity(query, readings, tree))
            counts.update(_check_ambient(query, readings, tree))
    assert len(counts) == 4
    assert min(counts.values()) >= 100_000, counts


def _check_distances(query: SensorQuery, readings: SensorReadings, tree: TriangleTree) -> dict[str, int]:
    points = query.wrist @ query.state.point_m[:, None]
    signed, closest = _distances(tree, points.reshape(-1, 3))
    np.testing.assert_allclose(readings.distance_m.ravel(), np.minimum(signed, 0.1), rtol=0, atol=1e-6)
    away = (points - closest.reshape(points.shape)) / signed.reshape(*points.shape[:3], 1)
    normal = query.wrist[:, 0].inverse().turn(away[:, 0]) @ query.hand.wrist_from_canonical
    # The gradient is ambiguous where two points of the surface are equally close.
    assert (np.abs(readings.normal - normal).max(axis=-1) > 1e-6).mean() < 1e-3
    return {"distance": signed.size, "normal": normal.size}


def _check_proximity(query: SensorQuery, readings: SensorReadings, tree: TriangleTree) -> dict[str, int]:
    start = (query.wrist[:, 0] @ query.state.sensor_m).reshape(-1, 3)
    direction = query.wrist[:, 0].turn(query.state.sensor_normal).reshape(-1, 3)
    queries = zip(start, direction, _distances(tree, start)[0], strict=True)
    reference = np.array([_proximity(tree, *row) for row in queries])
    np.testing.assert_allclose(readings.proximity_m[:, 0].ravel(), reference, rtol=0, atol=1e-6)
    return {"proximity": reference.size}


def _check_ambient(query: SensorQuery, readings: SensorReadings, tree: TriangleTree) -> dict[str, int]:
    for frame in range(0, FRAMES, FRAME_STEP):
        cells, axes = cells_in_object(query.hand, query.state, query.wrist, frame)
        queries = zip(cells, _distances(tree, cells)[0], strict=True)
        reference = [slow.occupancy(tree.vertices_m, tree.corner, cell, axes, distance) for cell, distance in queries]
        np.testing.assert_allclose(0.018 * readings.ambient[frame], 0.018 * np.array(reference), rtol=0, atol=1e-6)
    return {"ambient": 1000 * FRAMES // FRAME_STEP}


def _distances(tree: TriangleTree, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances, signed by the winding number, and nearest points."""
    vertices, faces = tree.vertices_m, tree.corner
    square, _, closest = igl.point_mesh_squared_distance(points, vertices, faces)
    near = np.flatnonzero(((points > vertices.min(axis=0)) & (points < vertices.max(axis=0))).all(axis=1))
    sign = np.ones(len(points))
    sign[near[igl.winding_number(vertices, faces, points[near]) > 0.5]] = -1
    return sign * np.sqrt(square), closest


def _proximity(tree: TriangleTree, start: np.ndarray, direction: np.ndarray, depth: float) -> float:
    """As ``slow.proximity``, with libigl's loop over the triangles; its distances are float32."""
    vertices, faces, touching = tree.vertices_m, tree.corner, depth < 0.001
    back, reach = (0.02, 0.022) if touching else (0.0, 0.1)
    hits = igl.ray_mesh_intersect(_MM * (start - back * direction), direction, _MM * vertices, faces) or []
    facing = [hit[1] / _MM for hit in hits if _normal(vertices[faces[hit[0]]]) @ direction < 0]
    distances = [distance for distance in facing if distance <= reach]
    missed = (-0.02 if depth < 0 else 0.0) if touching else 0.1
    return min(distances) - back if distances else missed


def _normal(corners: np.ndarray) -> np.ndarray:
    return np.cross(corners[1] - corners[0], corners[2] - corners[0])
