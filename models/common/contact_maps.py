"""Scores of predicted contact maps, and means of training maps as their baselines."""

import numpy as np
import torch
from scipy.spatial import KDTree

from hoidata.batches.dataset import ClipSample
from hoidata.contact.maps import f1_score
from models.common.point_net import normalised_points

THRESHOLDS = tuple(round(0.05 * step, 2) for step in range(1, 20))


def mean_f1(probabilities: np.ndarray, true: np.ndarray, threshold: float) -> float:
    """Mean over clips of the F1 of maps (clip, point), with probabilities cut at ``threshold``."""
    pairs = zip(probabilities, true, strict=True)
    return float(np.mean([f1_score(probability >= threshold, truth) for probability, truth in pairs]))


def best_threshold(probabilities: np.ndarray, true: np.ndarray) -> float:
    """The threshold among 0.05, 0.10, ... 0.95 with the best mean F1; the lowest if several are best."""
    scores = [mean_f1(probabilities, true, threshold) for threshold in THRESHOLDS]
    return THRESHOLDS[int(np.argmax(scores))]


def true_maps(samples: list[ClipSample]) -> np.ndarray:
    """(clip, point) bool contact maps."""
    return np.stack([sample.contact_map for sample in samples])


def mean_maps(train: list[ClipSample], clips: list[ClipSample], kind: str) -> np.ndarray:
    """Baseline contact maps (clip, point) from training clips.

    kind: "index": the mean by point index. "position": the mean at the nearest points in coordinates normalised to the
    object. "object": the mean over training clips of the same object, or over all if it is new.
    """
    train_maps = np.stack([sample.contact_map for sample in train]).astype(np.float64)
    if kind == "index":
        return np.repeat(train_maps.mean(axis=0)[None], len(clips), axis=0)
    if kind == "object":
        keys = np.array([sample.object_key for sample in train])
        same = [train_maps[keys == sample.object_key] for sample in clips]
        return np.stack([maps.mean(axis=0) if len(maps) else train_maps.mean(axis=0) for maps in same])
    points = {sample.object_key: torch.from_numpy(sample.points.points_m)[None] for sample in [*train, *clips]}
    clouds = {key: normalised_points(cloud)[0][0].numpy() for key, cloud in points.items()}
    train_clouds = [clouds[sample.object_key] for sample in train]
    of_object = {
        key: mean_map_by_position(clouds[key], train_clouds, train_maps)
        for key in {sample.object_key for sample in clips}
    }
    return np.stack([of_object[sample.object_key] for sample in clips])


def mean_map_by_position(points: np.ndarray, train_clouds: list[np.ndarray], train_maps: np.ndarray) -> np.ndarray:
    """Probability (point,) of contact at points (point, 3): the mean over training maps of their nearest points.

    Points and training clouds (point, 3) are normalised to the size of their object; train_maps (clip, point).
    """
    probability = np.zeros(len(points))
    for cloud, contact in zip(train_clouds, train_maps, strict=True):
        probability += contact[KDTree(cloud).query(points)[1]]
    return probability / max(len(train_maps), 1)
