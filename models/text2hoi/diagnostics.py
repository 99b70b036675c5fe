"""Figures from inside Text2HOI's networks on the test clips, beside their baselines: contact maps and lengths.

How motions compare with recorded ones is no matter of a network: see ``hoidata.metrics``.
"""

import numpy as np
import torch
from scipy.spatial import KDTree

from hoidata.batches.dataset import ClipSample, HoiDataset, collate
from models.common.checkpoints import load_checkpoint
from models.common.family import Figures, Sources
from models.common.point_net import normalised_points
from models.text2hoi.contact_training import CONTACT, contact_threshold
from models.text2hoi.length import LengthModel
from models.text2hoi.length_training import LENGTH
from models.text2hoi.thresholds import (
    UNCHOSEN_THRESHOLD,
    ContactNetwork,
    best_threshold,
    contact_probabilities,
    mean_f1,
    true_maps,
)  # fmt: skip

CONTACT_SAMPLES = 32


def diagnose(sources: Sources) -> Figures:
    """Contact F1 and length error on the test clips, by network."""
    train, validation, test = (
        list(HoiDataset(sources.annotated, split, crop="start")) for split in ("train", "validation", "test")
    )
    figures = {
        "contact": contact_figures(sources, train, validation, test),
        "length": length_figures(sources, train, test),
    }
    return {name: {key: round(float(value), 6) for key, value in rows.items()} for name, rows in figures.items()}


def contact_figures(
    sources: Sources, train: list[ClipSample], held_out: list[ClipSample], test: list[ClipSample]
) -> dict[str, float]:
    """F1 of the mean of samples at the checkpoint's threshold, beside mean maps at thresholds chosen alike.

    held_out: validation clips, on which thresholds of mean maps are chosen; ``UNCHOSEN_THRESHOLD`` without any.
    """
    checkpoint = load_checkpoint(sources.checkpoints / CONTACT.name, CONTACT, sources.device)
    assert isinstance(checkpoint.network, ContactNetwork)
    threshold = contact_threshold(checkpoint)
    f1 = mean_f1(contact_probabilities(checkpoint.network, test, CONTACT_SAMPLES, 0), true_maps(test), threshold)
    baselines = {}
    for kind in ("index", "position", "object"):
        chosen = UNCHOSEN_THRESHOLD
        if held_out:
            chosen = best_threshold(mean_maps(train, held_out, kind), true_maps(held_out))
        baselines[kind] = mean_f1(mean_maps(train, test, kind), true_maps(test), chosen)
    mean_map = max(baselines["index"], baselines["position"])
    return {
        "clips": len(test),
        "f1": f1,
        "f1_mean_map": mean_map,
        "f1_margin": f1 - mean_map,
        "f1_mean_map_by_index": baselines["index"],
        "f1_mean_map_by_position": baselines["position"],
        "f1_mean_map_of_same_object": baselines["object"],
        "threshold": threshold,
    }


def length_figures(sources: Sources, train: list[ClipSample], test: list[ClipSample]) -> dict[str, float]:
    """Mean absolute error of the expected length, in frames, beside the mean length of the training clips."""
    network = load_checkpoint(sources.checkpoints / LENGTH.name, LENGTH).network
    assert isinstance(network, LengthModel)
    batch = collate(test)
    true = batch.lengths.numpy()
    error = float(np.abs(network.expected_frames(batch.text[:, 0], batch.active_hands).numpy() - true).mean())
    baseline = float(np.abs(np.mean([sample.length for sample in train]) - true).mean())
    return {
        "clips": len(true),
        "mae_frames": error,
        "mae_mean_length_frames": baseline,
        "mae_ratio": error / max(baseline, 1e-9),
    }


def mean_maps(train: list[ClipSample], clips: list[ClipSample], kind: str) -> np.ndarray:
    """(clip, point) baseline maps from training clips.

    kind "index": mean by point index. "position": mean at the nearest points in coordinates normalised to the object.
    "object": mean over the training clips of the same object, of all where there is none.
    """
    train_maps = true_maps(train).astype(np.float64)
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
    """(point,) probability of contact at each point (point, 3), each training map read at its nearest point.

    Points and training clouds (point, 3) are normalised to the size of their object; train_maps (clip, point).
    """
    probability = np.zeros(len(points))
    for cloud, contact in zip(train_clouds, train_maps, strict=True):
        probability += contact[KDTree(cloud).query(points)[1]]
    return probability / max(len(train_maps), 1)
