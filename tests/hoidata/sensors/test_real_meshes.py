"""The sensors on ManipNet's own recordings beside libigl, triangle by triangle: 100,000 values of each and more."""

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
from hoidata.sensors import Sensed, sense
from models.manipnet.features import FeatureSettings, object_from_wrist
from tests.builders.manipnet import recording_control
from tests.hoidata.sensors import slow
from tests.hoidata.sensors.test_sensors import cells_in_object

ROOT = os.environ.get("HOIDATA_MANIPNET", "")
RECORDINGS = ("cube_med2", "cyl_med3", "cup1", "mug1", "teapot2")
FRAMES = 200  # of each recording and hand; 132 distances, 104 rays and 66 numbers of normals each
_MM = 1e3  # libigl leaves out triangles of less than 1e-6 square units, seen along the ray
EVERY = 20  # of those, for the 1,000 cells


class Asked(NamedTuple):
    """Hand-frames at one object. wrist: object_from_wrist (frame, time)."""

    hand: TrackedHand
    state: HandState
    wrist: RigidTransform


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
            asked = Asked(recording.tracked_hand(side), recording.state(side, frames), wrist)
            found = sense(asked.hand, asked.state, asked.wrist, None, surface)
            tree = next(iter(surface.filled.values())).tree
            counts.update(_check_distances(asked, found, tree))
            counts.update(_check_proximity(asked, found, tree))
            counts.update(_check_ambient(asked, found, tree))
    assert len(counts) == 4
    assert min(counts.values()) >= 100_000, counts


def _check_distances(asked: Asked, found: Sensed, tree: TriangleTree) -> dict[str, int]:
    points = asked.wrist @ asked.state.point_m[:, None]
    signed, closest = _distances(tree, points.reshape(-1, 3))
    np.testing.assert_allclose(found.distance_m.ravel(), np.minimum(signed, 0.1), rtol=0, atol=1e-6)
    away = (points - closest.reshape(points.shape)) / signed.reshape(*points.shape[:3], 1)
    normal = asked.wrist[:, 0].inverse().turn(away[:, 0]) @ asked.hand.wrist_from_canonical
    # Where two places are as near as each other the direction is a choice.
    assert (np.abs(found.normal - normal).max(axis=-1) > 1e-6).mean() < 1e-3
    return {"distance": signed.size, "normal": normal.size}


def _check_proximity(asked: Asked, found: Sensed, tree: TriangleTree) -> dict[str, int]:
    start = (asked.wrist[:, 0] @ asked.state.sensor_m).reshape(-1, 3)
    way = asked.wrist[:, 0].turn(asked.state.sensor_normal).reshape(-1, 3)
    rows = zip(start, way, _distances(tree, start)[0], strict=True)
    known = np.array([_proximity(tree, *row) for row in rows])
    np.testing.assert_allclose(found.proximity_m[:, 0].ravel(), known, rtol=0, atol=1e-6)
    return {"proximity": known.size}


def _check_ambient(asked: Asked, found: Sensed, tree: TriangleTree) -> dict[str, int]:
    for frame in range(0, FRAMES, EVERY):
        cells, turn = cells_in_object(asked.hand, asked.state, asked.wrist, frame)
        rows = zip(cells, _distances(tree, cells)[0], strict=True)
        known = [slow.occupancy(tree.vertices_m, tree.corner, cell, turn, far) for cell, far in rows]
        np.testing.assert_allclose(0.018 * found.ambient[frame], 0.018 * np.array(known), rtol=0, atol=1e-6)
    return {"ambient": 1000 * FRAMES // EVERY}


def _distances(tree: TriangleTree, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed by the winding number, and nearest places."""
    vertices, faces = tree.vertices_m, tree.corner
    square, _, closest = igl.point_mesh_squared_distance(points, vertices, faces)
    near = np.flatnonzero(((points > vertices.min(axis=0)) & (points < vertices.max(axis=0))).all(axis=1))
    sign = np.ones(len(points))
    sign[near[igl.winding_number(vertices, faces, points[near]) > 0.5]] = -1
    return sign * np.sqrt(square), closest


def _proximity(tree: TriangleTree, start: np.ndarray, way: np.ndarray, depth: float) -> float:
    """As ``slow.proximity``, with libigl's loop over the triangles; its ways are float32."""
    vertices, faces, touching = tree.vertices_m, tree.corner, depth < 0.001
    back, reach = (0.02, 0.022) if touching else (0.0, 0.1)
    hits = igl.ray_mesh_intersect(_MM * (start - back * way), way, _MM * vertices, faces) or []
    facing = [hit[1] / _MM for hit in hits if _normal(vertices[faces[hit[0]]]) @ way < 0]
    ways = [far for far in facing if far <= reach]
    missed = (-0.02 if depth < 0 else 0.0) if touching else 0.1
    return min(ways) - back if ways else missed


def _normal(corners: np.ndarray) -> np.ndarray:
    return np.cross(corners[1] - corners[0], corners[2] - corners[0])
