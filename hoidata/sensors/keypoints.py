"""Keypoints of a hand's skin: some of its vertices, spread evenly over palm and finger segments."""

import numpy as np

from hoidata.hands import HandModel
from hoidata.objects.farthest import farthest_points


def hand_keypoints(model: HandModel, count: int) -> np.ndarray:
    """(count,) numbers of vertices, ascending: of every segment (what turns with one joint most) its farthest points.

    Segments share the count by how many vertices they have, at least one each. The same numbers serve both sides.
    """
    segment = model.skin_weights.argmax(axis=1)
    members = [np.flatnonzero(segment == joint) for joint in np.unique(segment)]
    sizes = np.array([len(own) for own in members])
    shares = np.maximum(1, np.floor(count * sizes / sizes.sum())).astype(int)
    while shares.sum() != count:  # the largest remainders get what is left over
        short = np.where(shares < sizes, count * sizes / sizes.sum() - shares, -np.inf)
        short = short if shares.sum() < count else np.where(shares > 1, -short, -np.inf)
        shares[short.argmax()] += 1 if shares.sum() < count else -1
    chosen = [own[farthest_points(model.template_m[own], n)] for own, n in zip(members, shares, strict=True)]
    return np.sort(np.concatenate(chosen))
