"""ManipNet's retrieval baseline: nearest training frames by brute force, and means of rotations."""

import numpy as np
from scipy.spatial.transform import Rotation

from models.manipnet.family import NearestFrames, mean_rotmats
from models.manipnet.features import FeatureSettings
from tests.builders.sensing import random_rotations, small_hand


def test_poses_are_those_of_the_nearest_training_frames_in_scaled_inputs() -> None:
    hand, random = small_hand(), np.random.default_rng(0)
    inputs = random.normal(size=(30, 336 + 1000)).astype(np.float32)
    inputs[:, 0] *= 1000  # without scaling, this input alone would decide
    inputs[:, 1] *= 1e-6  # below the least standard deviation, 1 mm
    fingers = random_rotations(30 * (hand.n_joints - 1), 0.5, 1).reshape(30, -1, 3, 3)
    halves = [slice(0, 20), slice(20, 30)]
    frames = NearestFrames.of(hand, FeatureSettings(), [inputs[part] for part in halves], [fingers[p] for p in halves])
    std = inputs.std(axis=0)
    std[1] = 0.001
    query = inputs[[3, 27]] + random.normal(size=(2, 1336)).astype(np.float32) * std
    distances = np.linalg.norm((query[:, None] - inputs) / std, axis=-1)
    np.testing.assert_array_equal(frames.nearest(query, 10), distances.argsort(axis=1)[:, :10])
    np.testing.assert_array_equal(frames.poses(query, 1), fingers[distances.argmin(axis=1)])
    np.testing.assert_allclose(frames.poses(query, 10)[1], mean_rotmats(fingers[distances[1].argsort()[:10]]))


def test_the_mean_of_opposite_rotations_is_the_identity() -> None:
    turns = Rotation.from_rotvec([[0.3, 0, 0], [-0.3, 0, 0]]).as_matrix()
    np.testing.assert_allclose(mean_rotmats(turns[:, None]), np.eye(3)[None], atol=1e-12)
