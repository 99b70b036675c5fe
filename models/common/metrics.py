"""Measures of evaluation, as plain functions of arrays: the same for every system whose motions are clips."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree

from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.objects.distance import closest_points, signed_distance
from hoidata.objects.model import ObjectModel

THRESHOLDS = tuple(round(0.05 * step, 2) for step in range(1, 20))


def f1_score(predicted: np.ndarray, true: np.ndarray) -> float:
    """F1 of boolean maps (point,): 2 TP / (2 TP + FP + FN); 1 where both are empty."""
    hits = int((predicted & true).sum())
    total = int(predicted.sum()) + int(true.sum())
    return 2 * hits / total if total else 1.0


def mean_f1(chances: np.ndarray, true: np.ndarray, threshold: float) -> float:
    """Mean over clips of the F1 of maps (clip, point) of chances at a threshold."""
    return float(np.mean([f1_score(chance >= threshold, truth) for chance, truth in zip(chances, true, strict=True)]))


def best_threshold(chances: np.ndarray, true: np.ndarray) -> float:
    """The threshold among 0.05, 0.10, ... 0.95 with the best mean F1; the lowest of equals."""
    scores = [mean_f1(chances, true, threshold) for threshold in THRESHOLDS]
    return THRESHOLDS[int(np.argmax(scores))]


def spatial_mean_map(
    points: np.ndarray, training_points: np.ndarray, training_maps: np.ndarray, neighbours: int = 1
) -> np.ndarray:
    """(point,) chance of contact at each place, averaged over training objects.

    points (point, 3) and training_points (clip, point, 3) are normalised to the size of their object; each training map
    (clip, point) is read at its nearest point.
    """
    chances = np.zeros(len(points))
    for cloud, contact in zip(training_points, training_maps, strict=True):
        _, nearest = KDTree(cloud).query(points, k=neighbours)
        chances += contact[nearest].reshape(len(points), -1).mean(axis=1)
    return chances / max(len(training_maps), 1)


def joint_error_mm(predicted_m: np.ndarray, true_m: np.ndarray, present: np.ndarray) -> float:
    """Mean distance in millimetres between joints (side, frame, joint, 3) over the (side, frame) that are present."""
    apart = np.linalg.norm(predicted_m - true_m, axis=-1)
    return float(apart[present].mean() * 1000)


def points_in_object_frame(points_m: np.ndarray, rotmat: np.ndarray, position_m: np.ndarray) -> np.ndarray:
    """World points (frame, point, 3) at object poses (frame, 3, 3), (frame, 3): ``R^T (p - t)``."""
    return (points_m - position_m[:, None]) @ rotmat


def depths_m(model: ObjectModel, points_m: np.ndarray, hinge_rad: np.ndarray | None) -> np.ndarray:
    """(frame, point) depth below the surface, metres, of points (frame, point, 3) of the object frame; 0 outside.

    On an articulated object, below the surface of the part a point lies in.
    """
    depth = np.zeros(points_m.shape[:2])
    for faces, points in _parts(model, points_m, hinge_rad):
        corners = model.vertices_m[np.unique(faces)]
        close = np.logical_and(points >= corners.min(axis=0), points <= corners.max(axis=0)).min(axis=-1)
        if close.max():
            inside = -signed_distance(model.vertices_m, faces, points[close]).distance_m
            depth[close] = np.maximum(depth[close], inside)
    return depth


def surface_distances_m(model: ObjectModel, points_m: np.ndarray, hinge_rad: np.ndarray | None) -> np.ndarray:
    """(frame, point) unsigned distance to the mesh surface, metres, of points (frame, point, 3) of the object frame."""
    each = [
        closest_points(model.vertices_m, faces, points.reshape(-1, 3)).distance_m.reshape(points.shape[:2])
        for faces, points in _parts(model, points_m, hinge_rad)
    ]
    return np.minimum.reduce(each)


def _parts(
    model: ObjectModel, points_m: np.ndarray, hinge_rad: np.ndarray | None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Faces of every part, and the points (frame, point, 3) seen from that part: meshes stay, points turn."""
    if model.hinge is None or hinge_rad is None:
        yield model.faces, points_m
        return
    turn = rotvec_to_rotmat(model.hinge.axis * np.asarray(hinge_rad, dtype=np.float64)[:, None])
    turned = (points_m - model.hinge.origin_m) @ turn + model.hinge.origin_m
    for part, points in enumerate((points_m, turned)):
        faces = model.faces[model.face_part == part]
        if len(faces):
            yield faces, points
