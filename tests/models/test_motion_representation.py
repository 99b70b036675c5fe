"""The motion representation: splines, hands in the object's frame, relative rotations and whitening."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation
from torch import Tensor

from hoidata.batches.dataset import ClipBatch, ClipSample, HoiDataset
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.store.annotated import AnnotatedStore
from models.common.features import (
    OBJECT_START_6D,
    Normaliser,
    hands_in_object_frame,
    hands_in_world,
    mean_start,
    proper_hands,
    recentred,
    turned_from,
    turned_since_start,
)
from models.common.spline import (
    fit_spline,
    intervals_of,
    projected,
    smooth_root,
    spline_basis,
    stacked_bases,
    unwhiten,
    whiten,
)
from models.text2hoi.motion_representation import MotionRepresentation, MotionRepresentationConfig

OURS = MotionRepresentationConfig(knot_frames=4, hand_frame="object")
ALL_CONFIGS = [
    MotionRepresentationConfig(),
    replace(MotionRepresentationConfig(), hand_frame="object"),
    replace(OURS, hand_frame="world"),
    OURS,
    MotionRepresentationConfig(object_rotation="relative_to_start"),
    MotionRepresentationConfig(object_reference_point="box_centre"),
    MotionRepresentationConfig(whitening_frames=8),
    replace(OURS, object_reference_point="box_centre", object_rotation="relative_to_start", whitening_frames=8),
]


def test_the_basis_is_scipys_uniform_cubic_b_spline() -> None:
    for n_frames, intervals in ((2, 1), (8, 2), (31, 10), (150, 37)):
        positions = np.clip(np.linspace(0, intervals, n_frames), 0, intervals - 1e-12)
        expected = BSpline.design_matrix(positions, np.arange(-3.0, intervals + 4), 3).toarray()
        np.testing.assert_allclose(spline_basis(n_frames, intervals).numpy(), expected, atol=1e-9)


def test_a_cubic_motion_comes_back_exactly_and_frames_that_are_missing_are_filled_in() -> None:
    time = torch.linspace(-1, 1, 40, dtype=torch.float64)
    values = torch.stack((time**3 - time, 2 * time, torch.ones(40)), 1)
    present = torch.ones(40, dtype=torch.bool)
    basis = spline_basis(40, intervals_of(40, 4))
    torch.testing.assert_close(basis @ fit_spline(values, present, intervals_of(40, 4)), values, atol=1e-5, rtol=0)
    present[17:21] = False
    broken = torch.where(present[:, None], values, 1e3)
    torch.testing.assert_close(basis @ fit_spline(broken, present, intervals_of(40, 4)), values, atol=1e-2, rtol=0)


def test_a_projection_keeps_splines_removes_shaking_and_never_sees_padding() -> None:
    smooth = torch.linspace(0, 1, 30)[None, None, :, None].expand(2, 2, 30, 3)
    shaking = smooth + 0.1 * (-1.0) ** torch.arange(30)[:, None]
    result = projected(shaking, [30, 30], 4)
    assert (result - smooth)[:, :, 3:-3].abs().max() < 0.02
    torch.testing.assert_close(projected(smooth, [30, 30], 4), smooth, atol=1e-4, rtol=0)
    padded = smooth.clone()
    padded[1, :, 12:] = 1e6
    padded_result = projected(padded, [30, 12], 4)
    torch.testing.assert_close(padded_result[1, :, :12], smooth[1, :, :12], atol=1e-4, rtol=0)
    assert not padded_result[1, :, 12:].any()


@pytest.mark.parametrize("config", ALL_CONFIGS)
def test_recorded_clips_are_recovered_from_their_control_points(
    batch: ClipBatch, config: MotionRepresentationConfig
) -> None:
    """Wrists and objects within 1 mm, rotations within half a degree, where hands come and go without a jerk."""
    representation = MotionRepresentation(config)
    for sample in map(without_jerks, batch.samples):
        hands, objects = decoded(representation, sample)
        error = (hands - torch.from_numpy(sample.hands))[torch.from_numpy(sample.active_hands)]
        assert error[..., :3].norm(dim=-1).max() < 1e-3
        assert error[..., 3:].abs().max() < 0.0087  # the sine of half a degree
        assert (objects - torch.from_numpy(sample.object)).abs().max() < 1e-3
        encoded = representation.encode(sample)
        assert (encoded.hands.shape[1], len(encoded.object)) == representation.sizes(sample.length)


def without_jerks(sample: ClipSample) -> ClipSample:
    """The clip with hands that leave the object by 10 cm and come back, as a cosine."""
    hands, time = sample.hands.copy(), np.linspace(0, 2 * np.pi, sample.length)
    hands[..., :3] = sample.object[:, :3] + 0.05 * (1 - np.cos(time))[:, None]
    return replace(sample, hands=hands)


def decoded(representation: MotionRepresentation, sample: ClipSample) -> tuple[Tensor, Tensor]:
    encoded = representation.encode(sample)
    hands, objects = representation.features_per_frame(encoded.hands[None], encoded.object[None], [sample.length])
    points = torch.from_numpy(sample.points.points_m)[None], torch.from_numpy(sample.points.part)[None]
    hands, objects = recentred(representation.in_world(hands, objects), representation.at_origin(objects, *points))
    return hands[0], objects[0]


def test_a_hand_that_moves_with_an_object_is_constant_in_the_objects_frame(batch: ClipBatch) -> None:
    sample = batch.samples[0]
    n_frames, generator = sample.length, np.random.default_rng(0)
    objects = sample.object.copy()
    rotation = rotvec_to_rotmat(torch.from_numpy(np.cumsum(generator.normal(0, 0.1, (n_frames, 3)), 0))).float()
    objects[:, 3:9] = rotation[:, :, :2].flatten(1).numpy()
    still_hands = torch.from_numpy(sample.hands[:, :1]).expand(-1, n_frames, -1)
    hands = hands_in_world(proper_hands(still_hands)[None], torch.from_numpy(objects)[None])[0].numpy()
    points = MotionRepresentation(OURS).encode(replace(sample, hands=hands, object=objects)).hands
    assert points.std(1).max() < 1e-4
    assert (
        MotionRepresentation(replace(OURS, hand_frame="world"))
        .encode(replace(sample, hands=hands, object=objects))
        .hands.std(1)
        .max()
        > 0.05
    )


def test_control_points_of_a_missing_hand_are_marked(batch: ClipBatch) -> None:
    sample = batch.samples[0]
    valid = sample.valid.copy()
    valid[:, sample.length // 2 :] = False
    present = MotionRepresentation(OURS).encode(replace(sample, valid=valid)).present
    side = int(sample.active_hands.argmax())
    assert present[side, 0]
    assert not present[side, -1]
    assert not present[1 - side].any()


def test_padding_keeps_the_last_pose() -> None:
    bases = stacked_bases([9, 20], [2, 5], 20, torch.device("cpu"))
    torch.testing.assert_close(bases.sum(-1), torch.ones(2, 20))
    assert torch.equal(bases[0, 8:], bases[0, 8:9].expand(12, -1))


def test_normalisation_skips_inactive_hands_and_can_be_inverted(annotated: AnnotatedStore) -> None:
    representation = MotionRepresentation(OURS)
    encoded = [representation.encode(sample) for sample in HoiDataset(annotated, "train")]
    normaliser = Normaliser.of([(clip.hands, clip.object, clip.present) for clip in encoded])
    left = torch.cat([clip.hands[0][clip.present[0]] for clip in encoded])
    torch.testing.assert_close(normaliser.hand_mean[0], left.mean(0), atol=1e-5, rtol=1e-4)
    hands, objects = normaliser.decode(*normaliser.encode(encoded[0].hands[None], encoded[0].object[None]))
    torch.testing.assert_close(hands[0], encoded[0].hands, atol=1e-5, rtol=0)
    torch.testing.assert_close(objects[0], encoded[0].object, atol=1e-5, rtol=0)


def test_the_two_frames_of_hands_are_each_others_inverse(batch: ClipBatch) -> None:
    in_object_frame = hands_in_object_frame(batch.hands, batch.object)
    in_world = hands_in_world(in_object_frame, batch.object)
    torch.testing.assert_close(in_world[batch.present], batch.hands[batch.present], atol=1e-5, rtol=0)


REPRESENTATION = MotionRepresentation(
    MotionRepresentationConfig(
        knot_frames=4,
        hand_frame="object",
        object_rotation="relative_to_start",
        whitening_frames=8,
    )
)


def turning(n_frames: int, seed: int = 0) -> tuple[Tensor, Rotation]:
    """Object features of a random path with a moving hinge, and its rotations."""
    random = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(np.cumsum(random.normal(0, 0.05, (n_frames, 3)), 0)) * Rotation.random(rng=random)
    return features(rotation, np.cumsum(random.normal(0, 0.01, (n_frames, 3)), 0), random.uniform(0, 1, n_frames))


def features(rotation: Rotation, position_m: np.ndarray, hinge: np.ndarray) -> tuple[Tensor, Rotation]:
    columns = rotation.as_matrix()[:, :, :2].reshape(-1, 6)
    return torch.from_numpy(np.column_stack((position_m, columns, hinge))).float(), rotation


def test_relative_rotations_equal_scipys_and_can_be_inverted() -> None:
    objects, rotation = turning(30)
    rows = turned_since_start(objects)
    expected = (rotation * rotation[0].inv()).as_matrix()[:, :, :2].reshape(-1, 6)
    np.testing.assert_allclose(rows[:, 3:9].numpy(), expected, atol=1e-5)
    mask = torch.ones(1, 30, dtype=torch.bool)
    restored = turned_from(rows[None], mean_start(rows[None], mask))[0]
    torch.testing.assert_close(restored, objects, atol=1e-5, rtol=0)


def test_relative_rotations_do_not_depend_on_the_axes_of_the_mesh() -> None:
    """The same motion of a mesh with other axes: only the first-frame rotation differs."""
    objects, rotation = turning(30)
    other = rotation * Rotation.from_euler("xyz", (80, -30, 140), degrees=True)
    again, _ = features(other, objects[:, :3].numpy(), objects[:, 9].numpy())
    rows, rows_again = turned_since_start(objects), turned_since_start(again)
    torch.testing.assert_close(rows[:, :10], rows_again[:, :10], atol=1e-5, rtol=0)
    assert (rows - rows_again)[:, OBJECT_START_6D].abs().max() > 0.1


def test_the_first_frames_rotation_is_a_mean_over_valid_control_points() -> None:
    rows = turned_since_start(turning(12)[0])[None].repeat(1, 2, 1)
    mask = torch.arange(24)[None] < 12
    broken = torch.where(mask[..., None], rows, 1e3)
    torch.testing.assert_close(mean_start(broken, mask), mean_start(rows, mask), atol=1e-6, rtol=0)


@pytest.mark.parametrize("width", [10, 16])
def test_whitening_can_be_inverted_and_is_zero_at_rest(width: int) -> None:
    rows = torch.randn(2, 40, width, generator=torch.Generator().manual_seed(0))
    new = whiten(rows, 4.0)
    torch.testing.assert_close(unwhiten(new, 4.0), rows, atol=1e-4, rtol=0)
    torch.testing.assert_close(new[..., 10:], rows[..., 10:])
    still = torch.cat((torch.zeros(40, 3), torch.eye(3)[:, :2].reshape(1, 6).expand(40, 6), torch.zeros(40, 1)), 1)
    assert not whiten(still, 4.0).any()


def test_smooth_motion_becomes_white_noise() -> None:
    """Whitening converts samples of the smoothness prior, from an independent generator, into white noise."""
    position = np.arange(30)
    covariance = 0.25 * (0.7 * np.exp(-((position[:, None] - position) ** 2) / (2 * 4.0**2)) + 0.3 * np.eye(30))
    sampled = np.random.default_rng(0).multivariate_normal(np.zeros(30), covariance, 40_000)
    rows = torch.from_numpy(sampled).float()[..., None].repeat(1, 1, 10)
    rows[..., (3, 6)] += 1
    result_covariance = np.cov(whiten(rows, 4.0)[..., 0].numpy().T)
    np.testing.assert_allclose(result_covariance, np.eye(30), atol=0.04)


def test_whitening_does_not_depend_on_padding() -> None:
    assert torch.equal(smooth_root(50, 4.0)[:20, :20], smooth_root(20, 4.0))


def test_whitening_raises_the_weight_of_a_shake_relative_to_a_lift() -> None:
    """Up by 17 cm in a second and, the same path, 3 cm up and down three times a second."""
    time = np.linspace(0, 4, 61)
    lift = 0.17 * np.clip(time, 0, 1) ** 2 * (3 - 2 * np.clip(time, 0, 1))
    shake = 0.03 * np.sin(2 * np.pi * 3 * time) * (time > 1)
    still = np.zeros(61)

    def shake_ratio(whitening: bool) -> float:
        rows = [features(Rotation.identity(61), np.column_stack((still, still, z)), still)[0] for z in (lift, shake)]
        one, other = ((whiten(points, 4.0) if whitening else points)[:, 2].square().sum() for points in rows)
        return float(other / one)

    assert shake_ratio(True) > 10 * shake_ratio(False)


def test_a_motion_is_the_same_in_a_batch_with_a_longer_one(batch: ClipBatch) -> None:
    encoded = [REPRESENTATION.encode(sample) for sample in batch.samples[:2]]
    counts = [sample.length for sample in batch.samples[:2]]
    assert counts[0] != counts[1]
    longest = max(len(clip.object) for clip in encoded), max(clip.hands.shape[1] for clip in encoded)
    objects = torch.stack(
        [torch.cat((clip.object, torch.full((longest[0] - len(clip.object), 16), 9.0))) for clip in encoded]
    )
    hands = torch.stack(
        [torch.cat((clip.hands, torch.full((2, longest[1] - clip.hands.shape[1], 99), 9.0)), 1) for clip in encoded]
    )
    together = REPRESENTATION.features_per_frame(hands, objects, counts)
    for index, (clip, count) in enumerate(zip(encoded, counts, strict=True)):
        alone = REPRESENTATION.features_per_frame(clip.hands[None], clip.object[None], [count])
        torch.testing.assert_close(together[1][index, :count], alone[1][0], atol=1e-5, rtol=0)


def test_first_frame_rotations_have_one_scale(batch: ClipBatch) -> None:
    encoded = [REPRESENTATION.encode(sample) for sample in batch.samples]
    normaliser = Normaliser.of([(clip.hands, clip.object, clip.present) for clip in encoded])
    rows = torch.cat([clip.object for clip in encoded])
    assert normaliser.object_scale.shape == (16,)
    expected = max(float(rows[:, 10:].double().var(0, correction=0).mean()) ** 0.5, 0.05)
    torch.testing.assert_close(normaliser.object_scale[10:], torch.full((6,), expected), atol=1e-5, rtol=0)
