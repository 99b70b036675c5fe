"""Hands for an object motion without a recording: repeatable, with the given object, as files and a page."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from hoidata.batches.requests import ObjectPoints, Request, Trajectories
from hoidata.clips.clip import SIDES
from hoidata.clips.features import object_features
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands, track_vertices
from hoidata.metrics.verdict import verdict
from hoidata.object_paths import ObjectPath, keyframed_path, parse_keyframes
from hoidata.objects.model import articulate
from hoidata.objects.surface_index import surface_index
from hoidata.sensors.part_bps import BasisSettings, hand_keypoints
from models.bimart.family import BimArtSampler
from models.bimart.hands import HandSamplingOptions, SampledHands, hands_for
from models.bimart.network import ContactModel, MotionModel
from models.bimart.sampler import BimArt
from models.bimart.scene import FeatureConfig, Scene
from pipelines.pages.hands_page import ARRAYS, MAPS_OVER_TIME, write_hands
from tests.builders.objects import hinged_box
from tests.models.bimart.test_sampling import FAST, TINY

pytestmark = pytest.mark.slow

PAIR = load_embedded_hands()
FEATURES = FeatureConfig(BasisSettings(16), keypoints=24, window_frames=16, state="local", max_distance_m=0.2)


@pytest.fixture(scope="module")
def sampler() -> BimArtSampler:
    """Untrained networks whose output has the size of hands."""
    torch.manual_seed(0)
    config = replace(TINY, features=FEATURES)
    contact, motion = ContactModel(config), MotionModel(config)
    ids = hand_keypoints(PAIR.right, FEATURES.keypoints)
    points_m = np.concatenate([PAIR[side].template_m[ids] + [0, 0, 0.03] for side in SIDES]).ravel()
    with torch.no_grad():
        motion.mean[: len(points_m)] = torch.from_numpy(points_m)
        motion.scale.fill_(0.003)
        motion.keypoint_ids.copy_(torch.from_numpy(ids))
        contact.mean.fill_(0.02)
        contact.scale.fill_(0.005)
    model = BimArt(contact.eval(), motion.eval(), FAST, torch.device("cpu"))
    return BimArtSampler(model, PAIR, synthetic=True)


@pytest.fixture(scope="module")
def path() -> ObjectPath:
    keys = b"time_s,z_cm,hinge_deg\n0,0,0\n0.1,0,0\n0.5,5,0\n0.9,5,20\n1,5,20\n"
    return keyframed_path(hinged_box(), parse_keyframes(keys, "keys.csv"), (-0.1, 1.0))


@pytest.fixture(scope="module")
def motions(sampler, path) -> list[SampledHands]:
    return hands_for(sampler, path.track, HandSamplingOptions(seed=3, samples=2, words="box"))


def test_the_object_track_is_unchanged_and_both_hands_are_in_all_frames(motions, path):
    for motion in motions:
        assert motion.clip.object is path.track
        assert motion.clip.object_words == "box"
        assert all(motion.clip.hands[side].valid.all() for side in SIDES)
        assert motion.clip.synthetic


def test_a_sample_is_repeatable_and_does_not_depend_on_the_number_of_samples(sampler, path, motions):
    alone = hands_for(sampler, path.track, HandSamplingOptions(seed=3))[0]
    for side in SIDES:
        first, repeated, other = (motion.clip.hands[side] for motion in (motions[0], alone, motions[1]))
        assert all(np.array_equal(getattr(first, name), getattr(repeated, name)) for name in first.PER_FRAME)
        assert not np.array_equal(first.wrist_m, other.wrist_m)


def test_only_the_requested_hand_is_sampled(sampler, path):
    left = hands_for(sampler, path.track, HandSamplingOptions(hand="left"))[0]
    assert left.clip.hands["left"].valid.all()
    assert not left.clip.hands["right"].valid.any()
    assert list(left.standing.touching) == ["left"]
    assert np.isinf(left.reached_m[1]).all()
    assert np.isinf(left.target_m[1]).all()
    assert np.isfinite(left.target_m[0]).all()


def test_contact_measures_equal_those_of_the_hand_meshes(motions):
    motion, index = motions[0], surface_index(hinged_box())
    object_track = motion.clip.object
    for side_index, side in enumerate(SIDES):
        vertices_m = track_vertices(motion.clip.hands[side], PAIR[side])
        points = object_track.points_in_world(motion.points.points_m, motion.points.part)
        frame = 20
        assert motion.reached_m[side_index, frame] == pytest.approx(
            KDTree(vertices_m[frame]).query(points[frame])[0], abs=1e-5
        )
        vertices_object_m = object_track.world_from_object.inverse() @ vertices_m.astype(np.float64)
        distance = index.distance_m(vertices_object_m, object_track.hinge_rad).min(axis=1)
        assert np.array_equal(motion.standing.touching[side], distance < 0.005)
    assert motion.standing.deepest_m.max() < motion.unrefined_measures.deepest_m.max()


def test_target_distances_of_a_frame_are_those_of_the_nearest_points_of_the_contact_map(sampler, path):
    (motion,) = hands_for(sampler, path.track, HandSamplingOptions(seed=3))
    track, frame = path.track, 20
    wrists = np.zeros((2, track.n_frames, 9), np.float32), np.zeros((2, track.n_frames), bool)
    features = object_features(track, np.eye(3), track.translation_m[0].astype(np.float64))
    request = Request(
        "m",
        object=track.model,
        points=ObjectPoints(motion.points.points_m, motion.points.normals, motion.points.part),
        text=np.zeros(512, np.float32),
        active_hands=np.ones(2, bool),
        n_frames=track.n_frames,
        seed=motion.seed,
        trajectories=Trajectories(*wrists, features),
    )
    (sampled,) = sampler.sample_motions([request])
    scene = Scene.of(track.model, features, FEATURES.basis)
    exists = scene.point_exists
    places_m = (scene.object_from_canonical @ scene.object_point_m.astype(np.float64))[frame, exists]
    points = motion.points
    posed_m = articulate(points.points_m, points.part, track.model.hinge, track.hinge_rad)[frame]
    apart = np.linalg.norm(posed_m[:, None] - places_m, axis=-1)
    for side in range(2):
        maps = sampled.contact_m.reshape(track.n_frames, 2, -1)[frame, side, exists]
        is_nearest = apart < apart.min(axis=1, keepdims=True) + 1e-6  # several basis points may have one vertex
        agrees = np.isclose(motion.target_m[side, frame][:, None], maps, rtol=2e-3, atol=1e-5)
        assert (agrees & is_nearest).any(axis=1).all()
    assert not np.array_equal(motion.target_m[:, frame], motion.target_m[:, 2])


def test_too_short_a_motion_is_bad_input(sampler, path):
    with pytest.raises(BadInput, match="give a longer motion"):
        hands_for(sampler, path.track.take(slice(0, 5)))


@pytest.mark.long
def test_files_and_page_are_repeatable_and_each_array_is_documented(motions, path, tmp_path):
    def written(folder: str) -> list[Path]:
        digests = {"checkpoints/bimart-motion/model.safetensors": "ab" * 32}
        return write_hands(
            tmp_path / folder,
            motions,
            PAIR,
            path.steps,
            digests,
            [("object's motion", "a <script>")],
            [verdict(motion.clip, PAIR) for motion in motions],
            ["so"],
        )

    first, again = written("a"), written("b")
    names = ["motion.npz", "motion.glb", "motion-1.npz", "motion-1.glb", "index.html"]
    assert [file.name for file in first] == names
    assert [file.read_bytes() for file in first] == [file.read_bytes() for file in again]
    with np.load(first[0]) as arrays:
        assert set(arrays.files) == set(ARRAYS)
        shape = 2, path.track.n_frames, len(arrays["contact_points_m"])
        assert arrays["contact_distance_m"].shape == arrays["target_distance_m"].shape == shape
        assert np.array_equal(arrays["target_distance_m"], motions[0].target_m)
        assert np.array_equal(arrays["object_hinge_axis"], path.track.model.hinge.axis)
    page = first[-1].read_text(encoding="utf-8")
    assert page.count('<figure class="player') == 2 * (2 + 2 * (2 + MAPS_OVER_TIME))
    assert "keyframes 2 to 3" in page
    assert page.count("does not pierce") >= 2
    assert "a &lt;script&gt;" in page
    assert "http" not in page.split("<main")[1].split("<script")[0]
