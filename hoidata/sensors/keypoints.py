"""Keypoints on a hand's skin: vertices spread evenly over palm and finger segments."""

import numpy as np

from hoidata.hands import HandModel
from hoidata.objects.farthest import farthest_points


def hand_keypoints(model: HandModel, count: int) -> np.ndarray:
    """Choose keypoints by farthest point sampling in each segment.

    A segment is the vertices with the same joint of largest skin weight. Each segment gets at least one keypoint and
    otherwise a number in proportion to its vertices (largest remainder method). Both sides use the same vertices.

    Returns:
        (count,) vertex indices, ascending.
    """
    segment = model.skin_weights.argmax(axis=1)
    segments = [np.flatnonzero(segment == joint) for joint in np.unique(segment)]
    sizes = np.array([len(vertices) for vertices in segments])
    quotas = np.maximum(1, np.floor(count * sizes / sizes.sum())).astype(int)
    while quotas.sum() != count:
        remainder = np.where(quotas < sizes, count * sizes / sizes.sum() - quotas, -np.inf)
        remainder = remainder if quotas.sum() < count else np.where(quotas > 1, -remainder, -np.inf)
        quotas[remainder.argmax()] += 1 if quotas.sum() < count else -1
    chosen = [
        vertices[farthest_points(model.template_m[vertices], quota)]
        for vertices, quota in zip(segments, quotas, strict=True)
    ]
    return np.sort(np.concatenate(chosen))
