"""The refinement of BimArt's paper: each term by its formula, the printed weights and steps, and the result."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from trimesh import remesh

from hoidata.clips.clip import SIDES, ObjectTrack
from hoidata.errors import BadInput
from hoidata.objects.model import articulate
from hoidata.refinement import fit_hands, refine_as_released, released
from hoidata.refinement.released import ObjectVertices, energy_terms
from tests.builders.clips import still_object
from tests.builders.objects import hinged_box
from tests.hoidata.refinement.test_refinement import BOX, IDS, PAIR, depth_mm, skin, touching


def test_the_constants_are_those_of_section_3_5() -> None:
    weights = released.PROJECTION_WEIGHT, released.PENETRATION_WEIGHT, released.ACCELERATION_WEIGHT
    assert weights == (100, 10, 1000)
    assert (released.STEPS, released.LEARNING_RATE, released.CHUNK_FRAMES) == (100, 5e-4, 2)


def test_each_term_is_that_of_equations_10_to_12_with_squared_means() -> None:
    rng = np.random.default_rng(0)
    frames, ids = 5, np.array([3, 0, 7])
    track = still_object(BOX, frames)  # 0.30 x 0.30 x 0.10 m about the origin
    vertices = rng.uniform(-1, 1, (frames, 2, 9, 3)) * [0.2, 0.2, 0.07]
    to_object = rng.normal(0, 0.05, (frames, 2, 3, 3))
    present = np.ones((frames, 2), bool)
    present[3, 1] = False
    terms = energy_terms(torch.from_numpy(vertices), present, ids, to_object, ObjectVertices(track))
    corners = BOX.vertices_m

    def square(point: np.ndarray) -> float:
        return float(((corners - point) ** 2).sum(axis=1).min())

    projected = [
        square(vertices[f, h, v] + to_object[f, h, k])
        for f, h in zip(*np.nonzero(present), strict=True)
        for k, v in enumerate(ids)
    ]
    penetration = 0.0
    for first in range(0, frames, 2):
        hands = [vertices[f, h] for f in range(first, min(first + 2, frames)) for h in range(2) if present[f, h]]
        points = np.concatenate(hands)
        inside = points[(np.abs(points) < [0.15, 0.15, 0.05]).all(axis=1)]
        penetration += np.mean([square(point) for point in inside])
    differences = [
        vertices[f, h] - 2 * vertices[f - 1, h] + vertices[f - 2, h]
        for f in range(2, frames)
        for h in range(2)
        if present[f - 2 : f + 1, h].all()
    ]
    expected = np.array([np.mean(projected), penetration, np.mean(np.square(differences))])
    np.testing.assert_allclose([float(term) for term in terms], expected, rtol=1e-9)


def test_vertices_of_both_parts_move_with_the_object() -> None:
    model, rng = hinged_box(), np.random.default_rng(1)
    hinge = np.linspace(0, 1, 4).astype(np.float32)
    rotvec = rng.normal(size=(4, 3)).astype(np.float32)
    track = ObjectTrack(model, rotvec, rng.normal(size=(4, 3)).astype(np.float32), hinge)
    posed = track.world_from_object @ articulate(model.vertices_m, model.part, model.hinge, hinge)
    points, frame = rng.normal(size=(30, 3)) + track.translation_m[1], rng.integers(0, 4, 30)
    nearest = ObjectVertices(track).nearest_m(points, frame)
    for point, answer, number in zip(points, nearest, frame, strict=True):
        distance = np.linalg.norm(posed[number] - point, axis=1)
        np.testing.assert_allclose(answer, posed[number][distance.argmin()], atol=1e-6)


@pytest.mark.long
def test_hands_leave_the_object_and_are_smoothed_and_the_same_input_gives_the_same_bytes() -> None:
    generated = touching()
    fitted = fit_hands(PAIR, None, IDS, generated)
    fine = replace(BOX, **dict(zip(("vertices_m", "faces", "part"), _divided(BOX), strict=True)))
    track = still_object(fine, len(generated["left"].is_active))
    first, again = (refine_as_released(PAIR, IDS, generated, fitted, track) for _ in range(2))
    assert depth_mm(first, fine)[:, 14:].max() < 0.6 * depth_mm(fitted, fine)[:, 14:].max()
    for side in SIDES:
        acceleration = [np.abs(np.diff(skin(side, hands[side]), 2, axis=0)).mean() for hands in (fitted, first)]
        assert acceleration[1] < acceleration[0]
        assert all(np.array_equal(getattr(first[side], n), getattr(again[side], n)) for n in first[side].PER_FRAME)
        assert np.array_equal(first[side].valid, fitted[side].valid)


def _divided(model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same box with vertices every centimetre: distances are to vertices."""
    vertices_m, faces, *_ = remesh.subdivide_to_size(model.vertices_m, model.faces, 0.01)
    return np.asarray(vertices_m), np.asarray(faces), np.zeros(len(vertices_m), np.uint8)


def test_inconsistent_arrays_are_refused() -> None:
    generated = touching()
    fitted = fit_hands(PAIR, None, IDS, generated)
    with pytest.raises(BadInput, match="equally many frames"):
        refine_as_released(PAIR, IDS, generated, fitted, still_object(BOX, 3))
