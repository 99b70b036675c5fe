"""Hand shapes that are unlikely: betas are coefficients of principal components in standard deviations (MANO, 2017)."""

from collections.abc import Mapping

import numpy as np

from hoidata.clips.clip import HandTrack


def meant_betas(track: HandTrack) -> np.ndarray:
    """(row, 10) betas of the frames in which the hand is valid; what stands in the others means nothing."""
    return track.betas if len(track.betas) == 1 else track.betas[track.valid]


def largest_beta(betas: np.ndarray) -> float:
    """Largest ``|beta|`` of (row, 10), standard deviations. Zero for a personal template, which replaces the shape."""
    return float(np.abs(betas).max())


def distances_to_others(betas: Mapping[str, np.ndarray]) -> dict[str, float]:
    """How far each clip's betas lie from the same hand's in the other clips, by clip id.

    betas: (row, 10) of one side of one subject in each clip. The distance is the largest difference of a component
    between the clip's median row and the median of all other clips' median rows, standard deviations; NaN with fewer
    than two others, where nobody can say which of them is wrong.
    """
    rows = {key: np.median(values, axis=0) for key, values in betas.items()}
    if len(rows) < 3:
        return dict.fromkeys(rows, float("nan"))
    table = np.array(list(rows.values()))
    others = [np.median(np.delete(table, number, axis=0), axis=0) for number in range(len(table))]
    return {key: float(np.abs(row - other).max()) for (key, row), other in zip(rows.items(), others, strict=True)}
