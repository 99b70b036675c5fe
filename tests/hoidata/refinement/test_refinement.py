"""Fitted hands reproduce their keypoints; refined hands are on the surface and near the keypoints elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits
from trimesh import remesh

from hoidata.clips.clip import SIDES, HandTrack, ObjectTrack, Side
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.refinement import GeneratedKeypoints, fit_hands, refine_hands
from hoidata.refinement.banded import solve_damped
from hoidata.refinement.fitting import MAX_SHAPE_NORM
from hoidata.refinement.skin import HandPose
from tests.builders.clips import still_object
from tests.builders.objects import box_model

PAIR = load_embedded_hands()
IDS = np.arange(0, 770, 7)
BETAS = np.random.default_rng(0).normal(0, 0.7, (2, 10))
FRAMES, DEPTH_M, SHAKE_M = 24, 0.012, 0.001
BOX = box_model((0.30, 0.30, 0.10))


def skin(side: Side, track: HandTrack) -> np.ndarray:
    return track_vertices(track, PAIR[side]).astype(np.float64)


def touching(frames: int = FRAMES, seed: int = 0) -> dict[Side, GeneratedKeypoints]:
    """Both hands come from 8 cm above and sink 12 mm into the top of a box, one into each half."""
    hands, random = {}, np.random.default_rng(seed)
    for index, side in enumerate(SIDES):
        pose = np.tile(PAIR[side].mean_pose.astype(np.float32), (frames, 1))
        valid, still = np.ones(frames, bool), np.zeros((frames, 3), np.float32)
        still_hand = skin(side, HandTrack(still, still, pose, betas=BETAS[index][None], valid=valid))
        centre, lowest = still_hand[0].mean(axis=0), still_hand[0, :, 2].min()
        height_m = np.interp(np.arange(frames), [0, 10, frames], [0.08, -DEPTH_M, -DEPTH_M])
        shift = np.stack((0 * height_m + (index - 0.5) * 0.15, 0 * height_m, 0.05 + height_m - lowest), axis=1)
        vertices_m = still_hand - [*centre[:2], 0] + shift[:, None]
        keypoints = vertices_m[:, IDS] + random.normal(0, SHAKE_M, (frames, 1, 3))
        to_object = np.zeros_like(keypoints)
        to_object[..., 2] = 0.05 - keypoints[..., 2]
        hands[side] = GeneratedKeypoints(keypoints, to_object, valid)
    return hands


@pytest.fixture(scope="module")
def scene() -> dict[str, dict]:
    generated = touching()
    fitted = fit_hands(PAIR, BETAS, IDS, generated)
    return {"generated": generated, "fitted": fitted, "refined": refined(generated, fitted)}


def refined(generated: dict, fitted: dict, model: ObjectModel = BOX) -> dict[Side, HandTrack]:
    return refine_hands(PAIR, IDS, generated, fitted, still_object(model, len(generated["left"].is_active)))


def depth_mm(tracks: dict[Side, HandTrack], model: ObjectModel = BOX) -> np.ndarray:
    """(side, frame) exact depth of the deepest vertex; negative outside."""
    index = surface_index(model)
    return np.stack([-1000 * index.nearest(skin(side, tracks[side]), None).distance_m.min(axis=1) for side in SIDES])


def test_a_motion_is_recovered_from_its_keypoints():
    random, truth, generated = np.random.default_rng(1), {}, {}
    for index, side in enumerate(SIDES):
        fingers = PAIR[side].mean_pose.reshape(15, 3) * np.linspace(0, 2, 10)[:, None, None]
        rotation = rotvec_to_rotmat(random.normal(0, 2, (10, 3)))
        pose = HandPose(random.normal(0, 1, (10, 3)), rotation, fingers + random.normal(0, 0.1, fingers.shape))
        truth[side] = pose.track(BETAS[index], np.ones(10, bool), None)
        keypoints = skin(side, truth[side])[:, IDS]
        generated[side] = GeneratedKeypoints(keypoints, np.zeros_like(keypoints), np.ones(10, bool))
    fitted = fit_hands(PAIR, BETAS, IDS, generated)
    for side in SIDES:
        error_m = np.linalg.norm(skin(side, fitted[side]) - skin(side, truth[side]), axis=-1)
        assert np.sqrt((error_m**2).mean()) < 0.0005
        assert np.abs(fitted[side].wrist_m - truth[side].wrist_m).max() < 0.001


@pytest.mark.parametrize("spread", [0.0, 1.0, 2.0])
def test_an_unknown_shape_is_fitted_once_per_hand(spread):
    """Keypoints of a hand of any shape are reproduced; with the mean shape they are not."""
    random, truth, generated = np.random.default_rng(2), {}, {}
    for side in SIDES:
        fingers = PAIR[side].mean_pose.reshape(15, 3) * np.linspace(0, 2, 10)[:, None, None]
        pose = HandPose(random.normal(0, 1, (10, 3)), rotvec_to_rotmat(random.normal(0, 2, (10, 3))), fingers)
        betas = spread * random.normal(0, 1, 10)
        truth[side] = skin(side, pose.track(betas, np.ones(10, bool), None))[:, IDS]
        generated[side] = GeneratedKeypoints(truth[side], np.zeros_like(truth[side]), np.ones(10, bool))

    def miss_m(betas: np.ndarray | None) -> list[float]:
        tracks = fit_hands(PAIR, betas, IDS, generated)
        assert all(track.betas.shape == (1, 10) for track in tracks.values())
        return [float(np.linalg.norm(skin(s, tracks[s])[:, IDS] - truth[s], axis=-1).mean()) for s in SIDES]

    assert max(miss_m(None)) < 0.0005
    if spread:
        assert min(miss_m(np.zeros((2, 10)))) > 3 * max(miss_m(None))


def test_a_bounded_shape_of_a_hand_is_the_fitted_one_and_that_of_no_hand_stays_within_the_bound():
    random, still = np.random.default_rng(4), np.ones(10, bool)
    fingers = np.tile(PAIR.left.mean_pose.reshape(15, 3), (10, 1, 1))
    pose = HandPose(np.zeros((10, 3)), rotvec_to_rotmat(random.normal(0, 2, (10, 3))), fingers)
    points = skin("left", pose.track(random.normal(0, 1, 10), still, None))[:, IDS]
    wrist = points.mean(axis=1, keepdims=True)
    # As a network of few training steps may give.
    shrunken = wrist + (points - wrist) * random.uniform(0.3, 1.3, (1, len(IDS), 1))
    norms = {}
    for name, keypoints_m in (("hand", points), ("no hand", shrunken)):
        generated = {"left": GeneratedKeypoints(keypoints_m, np.zeros_like(keypoints_m), still)}
        fits = [fit_hands(PAIR, None, IDS, generated, bounds_shape=bounds)["left"].betas for bounds in (False, True)]
        norms[name] = [float(np.linalg.norm(betas)) for betas in fits]
    assert norms["hand"][0] == norms["hand"][1] < MAX_SHAPE_NORM
    assert norms["no hand"][1] <= MAX_SHAPE_NORM < norms["no hand"][0]


def test_a_frame_without_the_hand_is_invalid_and_has_finite_numbers():
    generated = touching()["left"]
    generated.keypoints_m[5:9] = np.nan
    fitted = fit_hands(PAIR, BETAS, IDS, {"left": generated})
    assert np.array_equal(np.flatnonzero(~fitted["left"].valid), range(5, 9))
    track = refine_hands(PAIR, IDS, {"left": generated}, fitted, still_object(BOX, FRAMES))["left"]
    assert np.isfinite(skin("left", track)).all()
    assert np.array_equal(track.valid, fitted["left"].valid)


def test_refined_hands_are_outside_of_the_object_and_touch_it(scene):
    before, after = depth_mm(scene["fitted"]), depth_mm(scene["refined"])
    assert before.max() > 10
    assert after.max() < 3
    assert after[:, 12:].min() > -2  # within 2 mm of the surface in all frames in which the generated hand is inside


def test_refinement_uses_one_blas_thread(scene, monkeypatch):
    def watched(*arguments):
        threads.append(max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"))
        return solve_damped(*arguments)

    threads: list[int] = []
    monkeypatch.setattr("hoidata.refinement.refining.STEPS", 1)
    monkeypatch.setattr("hoidata.refinement.banded.solve_damped", watched)
    with threadpool_limits(2, user_api="blas"):
        refined(scene["generated"], scene["fitted"])
    assert set(threads) == {1}


def test_hands_without_errors_stay_at_the_generated_keypoints(scene):
    for side in SIDES:
        error_m = skin(side, scene["refined"][side])[:7, IDS] - scene["generated"][side].keypoints_m[:7]
        assert np.sqrt((error_m**2).sum(-1).mean()) < 0.002


def test_noise_is_smoothed(scene):
    def acceleration(tracks: dict[Side, HandTrack]) -> float:
        return float(np.mean([np.abs(np.diff(skin(side, tracks[side])[12:], 2, axis=0)).mean() for side in SIDES]))

    assert acceleration(scene["refined"]) < 0.5 * acceleration(scene["fitted"])


def test_shape_and_validity_are_kept_and_the_same_input_gives_the_same_bytes(scene):
    again = refined(scene["generated"], fit_hands(PAIR, BETAS, IDS, scene["generated"]))
    for index, side in enumerate(SIDES):
        track = scene["refined"][side]
        assert np.array_equal(track.betas, BETAS[index][None].astype(np.float32))
        assert all(np.array_equal(getattr(track, name), getattr(again[side], name)) for name in track.PER_FRAME)


def test_an_inactive_hand_is_not_moved_out_of_the_object(scene):
    idle = {side: replace(hand, is_active=np.zeros(FRAMES, bool)) for side, hand in scene["generated"].items()}
    assert depth_mm(refined(idle, scene["fitted"]))[:, 14:].min() > 8


@pytest.mark.slow
def test_the_triangulation_of_the_object_has_no_effect(scene):
    vertices_m, faces = BOX.vertices_m, BOX.faces
    for _ in range(4):
        vertices_m, faces, *_ = remesh.subdivide(vertices_m, faces)
    assert len(faces) == 12 * 4**4
    mesh = ObjectModel("box", np.asarray(vertices_m), np.asarray(faces), np.zeros(len(vertices_m), np.uint8))
    finer = refined(scene["generated"], scene["fitted"], mesh)
    for side in SIDES:
        assert np.abs(skin(side, finer[side]) - skin(side, scene["refined"][side])).max() < 1e-4


@pytest.mark.slow
def test_the_start_of_a_motion_does_not_depend_on_its_length(scene):
    longer = {
        side: GeneratedKeypoints(
            *(np.concatenate((a, a[-1:].repeat(40, axis=0))) for a in (h.keypoints_m, h.to_object_m, h.is_active))
        )
        for side, h in scene["generated"].items()
    }
    tracks = refined(longer, fit_hands(PAIR, BETAS, IDS, longer))
    for side in SIDES:
        assert np.abs(skin(side, tracks[side])[:12] - skin(side, scene["refined"][side])[:12]).max() < 5e-4


def test_refinement_against_a_mesh_without_an_inside_is_finite(scene):
    sheet = replace(BOX, faces=BOX.faces[:-4])
    tracks = refined(scene["generated"], scene["fitted"], sheet)
    assert all(np.isfinite(skin(side, tracks[side])).all() for side in SIDES)


@pytest.mark.slow
def test_refined_hands_move_with_the_world_frame(scene):
    position_m = np.tile(np.float32([1.0, 2.0, 3.0]), (FRAMES, 1))
    rotvec = np.tile(np.float32([0.3, -0.4, 1.2]), (FRAMES, 1))
    object_track = ObjectTrack(BOX, rotvec, position_m)
    world = object_track.world_from_object
    carried = {
        side: GeneratedKeypoints(world @ h.keypoints_m, world.turn(h.to_object_m), h.is_active)
        for side, h in scene["generated"].items()
    }
    tracks = refine_hands(PAIR, IDS, carried, fit_hands(PAIR, BETAS, IDS, carried), object_track)
    for side in SIDES:
        expected = world @ skin(side, scene["refined"][side])
        assert np.abs(skin(side, tracks[side]) - expected).max() < 2e-4


def test_inconsistent_arrays_are_refused(scene):
    generated, fitted = scene["generated"], scene["fitted"]
    with pytest.raises(BadInput, match="equally many frames"):
        refine_hands(PAIR, IDS, generated, fitted, still_object(BOX, FRAMES + 1))
    with pytest.raises(BadInput, match="check the caller"):
        fit_hands(PAIR, BETAS, IDS[:-1], generated)
    nowhere = replace(generated["left"], keypoints_m=np.full((FRAMES, len(IDS), 3), np.nan))
    with pytest.raises(BadInput, match="omit this hand"):
        fit_hands(PAIR, BETAS, IDS, {"left": nowhere})


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_a_step_that_is_nan_is_rejected(scene, monkeypatch):
    """A solver that diverges immediately returns the fitted hands."""
    monkeypatch.setattr(
        "hoidata.refinement.banded.solve_damped", lambda blocks, vector, damping: np.full_like(vector, np.nan)
    )
    tracks = refined(scene["generated"], scene["fitted"])
    for side in SIDES:
        np.testing.assert_allclose(skin(side, tracks[side]), skin(side, scene["fitted"][side]), atol=1e-6)
