"""BimArt's Table 6: how far a contact map is off that is known only where basis points see the object.

The paper spreads what is known over the mesh by the vector heat method; ours takes the inverse-distance mean of the
three nearest known vertices of the same part, at rest.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from hoidata.batches.dataset import ClipSample
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel, articulate
from hoidata.sensors.part_bps import BasisSettings, Variant, canonical_object, distance_map
from models.bimart.scene import Scene, hand_vertices_m

VARIANTS: tuple[Variant, ...] = ("unscaled", "whole", "part")
NEIGHBOURS, NEAREST_M = 3, 1e-6
WHERE = ("moving part", "base", "whole")


def mapping_errors_cm(
    samples: Sequence[ClipSample], pair: HandPair, count: int = 512, frames: int = 4
) -> dict[str, dict[str, list[float]]]:
    """By object and variant, the errors on the moving part, the base and the whole, cm; NaN for a part that is absent.

    count: basis points per part, twice as many for all parts together. frames: of each clip that are looked at.
    """
    found: dict[str, dict[str, list[np.ndarray]]] = {}
    for sample in samples:
        own = found.setdefault(sample.object_model.name, {})
        for variant in VARIANTS:
            own.setdefault(variant, []).append(_errors_cm(sample, pair, BasisSettings(count, variant=variant), frames))
    return {
        name: {variant: np.mean(rows, axis=0).tolist() for variant, rows in own.items()} for name, own in found.items()
    }


def _errors_cm(sample: ClipSample, pair: HandPair, basis: BasisSettings, frames: int) -> np.ndarray:
    """(3,) of one clip: where ``WHERE`` says."""
    rows = np.unique(np.linspace(0, sample.length - 1, frames).astype(int))
    scene = Scene.of(sample.object_model, sample.object[rows], basis)
    model, _ = canonical_object(sample.object_model, basis.frame)
    vertices = articulate(np.asarray(model.vertices_m, np.float64), model.part, model.hinge, scene.hinge_rad)
    vertices = np.broadcast_to(vertices, (len(rows), *vertices.shape[1:]))
    canonical_from_model, vertex = scene.model_from_canonical.inverse(), scene.bps.look(scene.hinge_rad).vertex
    errors = []
    for row in np.flatnonzero(sample.active_hands):
        skin = canonical_from_model @ hand_vertices_m(pair, int(row), sample)[rows].astype(np.float64)
        for true, seen in zip(distance_map(vertices, skin), vertex[:, scene.there], strict=True):
            errors.append(np.abs(spread_out(model, np.unique(seen), true) - true))
    error = np.mean(errors, axis=0)
    moving = (model.part == 1) & model.is_articulated
    return 100 * np.array([error[own].mean() if own.any() else np.nan for own in (moving, ~moving, moving | True)])


def spread_out(model: ObjectModel, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(vertex,) a map of which only ``known`` vertices count, by the three nearest of these on the same part."""
    spread = np.empty(len(model.vertices_m))
    for part in np.unique(model.part):
        own = np.flatnonzero(model.part == part)
        used = np.intersect1d(known, own)
        used = known if not len(used) else used
        apart, nearest = KDTree(model.vertices_m[used]).query(model.vertices_m[own], k=min(NEIGHBOURS, len(used)))
        apart, nearest = apart.reshape(len(own), -1), nearest.reshape(len(own), -1)  # of one neighbour too
        weight = 1 / np.maximum(apart, NEAREST_M)
        spread[own] = (values[used[nearest]] * weight).sum(axis=1) / weight.sum(axis=1)
    return spread
