"""What stands for a motion: splines that come back as the motion, hands that keep still on what they hold."""

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
    proper_hands,
    recentred,
)
from models.common.spline import fit_spline, intervals_of, projected, settled, spline_basis, stacked_bases
from models.text2hoi.motion_code import (
    MotionCode,
    MotionCodeConfig,
    _still_hinge,
    mean_start,
    smooth_root,
    turned_from,
    turned_since_start,
    unwhiten,
    whiten,
)

OURS = MotionCodeConfig(knot_frames=4, object_knots=2, hand_frame="object")
EVERY_CODE = [
    MotionCodeConfig(),
    replace(MotionCodeConfig(), hand_frame="object"),
    replace(OURS, hand_frame="world"),
    OURS,
    MotionCodeConfig(object_turn="since start"),
    MotionCodeConfig(object_place="box"),
    MotionCodeConfig(whitening_frames=8),
    replace(OURS, object_place="box", object_turn="since start", whitening_frames=8),
]


def test_the_basis_is_scipys_uniform_cubic_b_spline() -> None:
    for n_frames, intervals in ((2, 1), (8, 2), (31, 10), (150, 37)):
        place = np.clip(np.linspace(0, intervals, n_frames), 0, intervals - 1e-12)
        expected = BSpline.design_matrix(place, np.arange(-3.0, intervals + 4), 3).toarray()
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
    found = projected(shaking, [30, 30], 4)
    assert (found - smooth)[:, :, 3:-3].abs().max() < 0.02
    torch.testing.assert_close(projected(smooth, [30, 30], 4), smooth, atol=1e-4, rtol=0)
    padded = smooth.clone()
    padded[1, :, 12:] = 1e6
    kept = projected(padded, [30, 12], 4)
    torch.testing.assert_close(kept[1, :, :12], smooth[1, :, :12], atol=1e-4, rtol=0)
    assert not kept[1, :, 12:].any()


@pytest.mark.parametrize("config", EVERY_CODE)
def test_recorded_clips_come_back_from_their_rows(batch: ClipBatch, config: MotionCodeConfig) -> None:
    """Wrists and objects within 1 mm, rotations within half a degree, where hands come and go without a jerk."""
    code = MotionCode(config)
    for sample in map(without_jerks, batch.samples):
        hands, objects = decoded(code, sample)
        apart = (hands - torch.from_numpy(sample.hands))[torch.from_numpy(sample.active_hands)]
        assert apart[..., :3].norm(dim=-1).max() < 1e-3
        assert apart[..., 3:].abs().max() < 0.0087  # the sine of half a degree
        assert (objects - torch.from_numpy(sample.object)).abs().max() < 1e-3
        coded = code.encode(sample)
        assert (coded.hands.shape[1], len(coded.object)) == code.sizes(sample.length)


def without_jerks(sample: ClipSample) -> ClipSample:
    """The clip with hands that leave the object by 10 cm and come back, as a cosine."""
    hands, time = sample.hands.copy(), np.linspace(0, 2 * np.pi, sample.length)
    hands[..., :3] = sample.object[:, :3] + 0.05 * (1 - np.cos(time))[:, None]
    return replace(sample, hands=hands)


def decoded(code: MotionCode, sample: ClipSample) -> tuple[Tensor, Tensor]:
    coded = code.encode(sample)
    hands, objects = code.curves(coded.hands[None], coded.object[None], [sample.length])
    points = torch.from_numpy(sample.points.points_m)[None], torch.from_numpy(sample.points.part)[None]
    hands, objects = recentred(code.in_world(hands, objects), code.at_origin(objects, *points))
    return hands[0], objects[0]


def test_a_hand_that_holds_a_moving_object_is_constant_in_the_objects_frame(batch: ClipBatch) -> None:
    sample = batch.samples[0]
    n_frames, generator = sample.length, np.random.default_rng(0)
    objects = sample.object.copy()
    turn = rotvec_to_rotmat(torch.from_numpy(np.cumsum(generator.normal(0, 0.1, (n_frames, 3)), 0))).float()
    objects[:, 3:9] = turn[:, :, :2].flatten(1).numpy()
    held = torch.from_numpy(sample.hands[:, :1]).expand(-1, n_frames, -1)
    hands = hands_in_world(proper_hands(held)[None], torch.from_numpy(objects)[None])[0].numpy()
    rows = MotionCode(OURS).encode(replace(sample, hands=hands, object=objects)).hands
    assert rows.std(1).max() < 1e-4
    assert (
        MotionCode(replace(OURS, hand_frame="world"))
        .encode(replace(sample, hands=hands, object=objects))
        .hands.std(1)
        .max()
        > 0.05
    )


def test_rows_of_a_hand_that_is_missing_for_a_while_are_marked(batch: ClipBatch) -> None:
    sample = batch.samples[0]
    valid = sample.valid.copy()
    valid[:, sample.length // 2 :] = False
    present = MotionCode(OURS).encode(replace(sample, valid=valid)).present
    side = int(sample.active_hands.argmax())
    assert present[side, 0]
    assert not present[side, -1]
    assert not present[1 - side].any()


def test_padding_keeps_the_last_pose() -> None:
    bases = stacked_bases([9, 20], [2, 5], 20, torch.device("cpu"))
    torch.testing.assert_close(bases.sum(-1), torch.ones(2, 20))
    assert torch.equal(bases[0, 8:], bases[0, 8:9].expand(12, -1))


def test_normalisation_of_rows_leaves_out_hands_that_do_not_act_and_comes_back(annotated: AnnotatedStore) -> None:
    code = MotionCode(OURS)
    coded = [code.encode(sample) for sample in HoiDataset(annotated, "train")]
    normaliser = Normaliser.of([(own.hands, own.object, own.present) for own in coded])
    left = torch.cat([own.hands[0][own.present[0]] for own in coded])
    torch.testing.assert_close(normaliser.hand_mean[0], left.mean(0), atol=1e-5, rtol=1e-4)
    hands, objects = normaliser.decode(*normaliser.encode(coded[0].hands[None], coded[0].object[None]))
    torch.testing.assert_close(hands[0], coded[0].hands, atol=1e-5, rtol=0)
    torch.testing.assert_close(objects[0], coded[0].object, atol=1e-5, rtol=0)


def test_the_two_frames_of_hands_are_each_others_inverse(batch: ClipBatch) -> None:
    there = hands_in_object_frame(batch.hands, batch.object)
    back = hands_in_world(there, batch.object)
    torch.testing.assert_close(back[batch.present], batch.hands[batch.present], atol=1e-5, rtol=0)


def brought_to_rest(rows: Tensor, reach: float = 0.004) -> Tensor:
    return settled(rows, torch.ones(len(rows), dtype=torch.bool), torch.full((rows.shape[1],), reach), around=4)


def test_rows_that_stay_in_one_place_come_to_rest_and_a_path_keeps_its_way() -> None:
    path = torch.cat((torch.zeros(12), torch.linspace(0, 0.2, 6)[1:], torch.full((12,), 0.2)))[:, None].repeat(1, 3)
    noise = 0.001 * torch.randn(path.shape, generator=torch.Generator().manual_seed(0))
    found = brought_to_rest(path + noise)
    crawl = [float(rows[:8].diff(dim=0).norm(dim=-1).mean()) for rows in (path + noise, found)]
    assert crawl[1] < 0.2 * crawl[0]
    assert float((found - path).norm(dim=-1).max()) < 0.005
    there = torch.arange(len(path)) < 12
    everywhere = settled(path + noise, there, torch.full((3,), 0.004), around=4)
    torch.testing.assert_close(everywhere[:12], brought_to_rest((path + noise)[:12]))


@pytest.mark.parametrize("cm_s", [1, 2, 3, 4, 5, 6, 8, 12, 30])
def test_a_slow_way_does_not_come_out_as_steps(cm_s: float) -> None:
    """Two seconds of it, a row every fifteenth of a second. With differences of neighbours 5 cm/s came out as 15."""
    step = cm_s / 1500
    way = torch.cat((torch.zeros(15), torch.arange(1, 31) * step, torch.full((15,), 30 * step)))[:, None]
    found = brought_to_rest(way)
    speed = found.diff(dim=0)[20:40]
    assert 0.65 * step < float(speed.min())
    assert float(speed.max()) < 1.05 * step
    assert float((found - way).abs().max()) < 0.004


def test_a_shake_keeps_its_size() -> None:
    """3.5 Hz, 3 cm from end to end, a row every fifteenth of a second."""
    rows = 0.015 * torch.sin(2 * torch.pi * 3.5 / 15 * torch.arange(60))[:, None]
    torch.testing.assert_close(brought_to_rest(rows)[2:-2], rows[2:-2], atol=1e-3, rtol=0)


CODE = MotionCode(
    MotionCodeConfig(
        knot_frames=4, object_knots=2, hand_frame="object", object_turn="since start", whitening_frames=8, rest_m=0.004
    )
)


def turning(n_frames: int, seed: int = 0) -> tuple[Tensor, Rotation]:
    """Object features of a path with a hinge that moves, and its rotations."""
    random = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(np.cumsum(random.normal(0, 0.05, (n_frames, 3)), 0)) * Rotation.random(rng=random)
    return features(rotation, np.cumsum(random.normal(0, 0.01, (n_frames, 3)), 0), random.uniform(0, 1, n_frames))


def features(rotation: Rotation, position_m: np.ndarray, hinge: np.ndarray) -> tuple[Tensor, Rotation]:
    columns = rotation.as_matrix()[:, :, :2].reshape(-1, 6)
    return torch.from_numpy(np.column_stack((position_m, columns, hinge))).float(), rotation


def test_the_turn_is_that_of_scipy_and_the_features_come_back() -> None:
    thing, rotation = turning(30)
    rows = turned_since_start(thing)
    turn = (rotation * rotation[0].inv()).as_matrix()[:, :, :2].reshape(-1, 6)
    np.testing.assert_allclose(rows[:, 3:9].numpy(), turn, atol=1e-5)
    there = torch.ones(1, 30, dtype=torch.bool)
    back = turned_from(rows[None], mean_start(rows[None], there))[0]
    torch.testing.assert_close(back, thing, atol=1e-5, rtol=0)


def test_a_turn_does_not_depend_on_how_the_mesh_lies_in_its_own_frame() -> None:
    """The same motion of a mesh whose front is called otherwise: only what is said of the start differs."""
    thing, rotation = turning(30)
    other = rotation * Rotation.from_euler("xyz", (80, -30, 140), degrees=True)
    again, _ = features(other, thing[:, :3].numpy(), thing[:, 9].numpy())
    rows, rows_again = turned_since_start(thing), turned_since_start(again)
    torch.testing.assert_close(rows[:, :10], rows_again[:, :10], atol=1e-5, rtol=0)
    assert (rows - rows_again)[:, OBJECT_START_6D].abs().max() > 0.1


def test_the_start_is_a_mean_of_a_motions_own_rows() -> None:
    rows = turned_since_start(turning(12)[0])[None].repeat(1, 2, 1)
    there = torch.arange(24)[None] < 12
    broken = torch.where(there[..., None], rows, 1e3)
    torch.testing.assert_close(mean_start(broken, there), mean_start(rows, there), atol=1e-6, rtol=0)


@pytest.mark.parametrize("width", [10, 16])
def test_whitened_rows_come_back_and_a_rest_is_nothing_new(width: int) -> None:
    rows = torch.randn(2, 40, width, generator=torch.Generator().manual_seed(0))
    new = whiten(rows, 4.0)
    torch.testing.assert_close(unwhiten(new, 4.0), rows, atol=1e-4, rtol=0)
    torch.testing.assert_close(new[..., 10:], rows[..., 10:])
    still = torch.cat((torch.zeros(40, 3), torch.eye(3)[:, :2].reshape(1, 6).expand(40, 6), torch.zeros(40, 1)), 1)
    assert not whiten(still, 4.0).any()


def test_smooth_rows_become_white() -> None:
    """Rows drawn with the covariance the docstring names, by an independent generator, have none afterwards."""
    place = np.arange(30)
    covariance = 0.25 * (0.7 * np.exp(-((place[:, None] - place) ** 2) / (2 * 4.0**2)) + 0.3 * np.eye(30))
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(30), covariance, 40_000)
    rows = torch.from_numpy(drawn).float()[..., None].repeat(1, 1, 10)
    rows[..., (3, 6)] += 1
    found = np.cov(whiten(rows, 4.0)[..., 0].numpy().T)
    np.testing.assert_allclose(found, np.eye(30), atol=0.04)


def test_rows_do_not_depend_on_how_many_follow() -> None:
    assert torch.equal(smooth_root(50, 4.0)[:20, :20], smooth_root(20, 4.0))


def test_a_shake_counts_more_beside_a_lift_than_it_did() -> None:
    """Up by 17 cm in a second and, the same path, 3 cm up and down three times a second."""
    time = np.linspace(0, 4, 61)
    lift = 0.17 * np.clip(time, 0, 1) ** 2 * (3 - 2 * np.clip(time, 0, 1))
    shake = 0.03 * np.sin(2 * np.pi * 3 * time) * (time > 1)
    still = np.zeros(61)

    def share(whitening: bool) -> float:
        rows = [features(Rotation.identity(61), np.column_stack((still, still, z)), still)[0] for z in (lift, shake)]
        one, other = ((whiten(row, 4.0) if whitening else row)[:, 2].square().sum() for row in rows)
        return float(other / one)

    assert share(True) > 10 * share(False)


def test_a_motion_is_the_same_beside_a_longer_one(batch: ClipBatch) -> None:
    coded = [CODE.encode(sample) for sample in batch.samples[:2]]
    counts = [sample.length for sample in batch.samples[:2]]
    assert counts[0] != counts[1]
    longest = max(len(own.object) for own in coded), max(own.hands.shape[1] for own in coded)
    objects = torch.stack(
        [torch.cat((own.object, torch.full((longest[0] - len(own.object), 16), 9.0))) for own in coded]
    )
    hands = torch.stack(
        [torch.cat((own.hands, torch.full((2, longest[1] - own.hands.shape[1], 99), 9.0)), 1) for own in coded]
    )
    together = CODE.curves(*CODE.settled(hands, objects, counts), counts)
    for row, (own, count) in enumerate(zip(coded, counts, strict=True)):
        alone = CODE.curves(*CODE.settled(own.hands[None], own.object[None], [count]), [count])
        torch.testing.assert_close(together[1][row, :count], alone[1][0], atol=1e-5, rtol=0)


def test_each_kind_of_number_is_normalised_for_itself(batch: ClipBatch) -> None:
    coded = [CODE.encode(sample) for sample in batch.samples]
    made = Normaliser.of([(own.hands, own.object, own.present) for own in coded])
    rows = torch.cat([own.object for own in coded])
    assert made.object_scale.shape == (16,)
    expected = max(float(rows[:, 10:].double().var(0, correction=0).mean()) ** 0.5, 0.05)
    torch.testing.assert_close(made.object_scale[10:], torch.full((6,), expected), atol=1e-5, rtol=0)


def test_a_wobble_of_millimetres_comes_to_rest(batch: ClipBatch) -> None:
    sample = batch.samples[0]
    thing = np.repeat(sample.object[:1], sample.length, 0)
    shaky = CODE.encode(replace(sample, object=thing))
    random = torch.Generator().manual_seed(0)
    rows = shaky.object + 0.002 * torch.randn(shaky.object.shape, generator=random)
    counts = [sample.length]
    before = CODE.curves(shaky.hands[None], rows[None], counts)[1][0, :, :3]
    after = CODE.curves(*CODE.settled(shaky.hands[None], rows[None], counts), counts)[1][0, :, :3]
    assert after.diff(dim=0).norm(dim=-1).max() < 0.5 * before.diff(dim=0).norm(dim=-1).max()


def test_a_hinge_comes_to_rest_though_the_object_moves(batch: ClipBatch) -> None:
    sample = next(own for own in batch.samples if own.object[:, :3].std(0).max() > 0.01)
    rows, counts = CODE.encode(sample).object, [sample.length]
    wobble = 0.005 * torch.randn(len(rows), generator=torch.Generator().manual_seed(0))
    shaky = torch.cat((rows[:, :9], (rows[:, 9] + wobble)[:, None], rows[:, 10:]), 1)
    hands = CODE.encode(sample).hands[None]
    before, after = (
        CODE.curves(*both, counts)[1][0] for both in ((hands, shaky[None]), CODE.settled(hands, shaky[None], counts))
    )
    assert after[:, 9].diff(dim=0).abs().max() < 0.2 * before[:, 9].diff(dim=0).abs().max()
    assert float((after - before)[:, :3].norm(dim=-1).max()) < 0.004


def test_an_object_that_is_pushed_slowly_keeps_its_way() -> None:
    """Three seconds, 4 cm/s in the middle; asked of fewer frames it counts half as rest, and is off by 4 mm."""
    way_m = np.interp(np.arange(90), [20, 70], [0, 50 * 0.04 / 30])
    still = np.zeros(90)
    thing, _ = features(Rotation.identity(90), np.column_stack((way_m, still, still)), still)
    knots = intervals_of(90, 4)
    rows = CODE._whitened(fit_spline(turned_since_start(thing), torch.ones(90), knots * CODE.config.object_knots))
    hands = torch.zeros(1, 2, knots + 3, 99)
    after = CODE.curves(*CODE.settled(hands, rows[None], [90]), [90])[1][0, :, 0].numpy()
    assert np.abs(after - way_m).max() < 0.0015
    assert np.diff(after).max() < 1.5 * np.diff(way_m).max()


def test_a_hinge_that_hardly_moves_stands_still_and_one_that_opens_opens(batch: ClipBatch) -> None:
    sample = batch.samples[0]
    for range_rad, still in ((0.03, True), (0.4, False)):
        thing = sample.object.copy()
        thing[:, 9] = np.linspace(0.2, 0.2 + range_rad, len(thing))
        coded, counts = CODE.encode(replace(sample, object=thing)), [sample.length]
        angle = CODE.curves(*CODE.settled(coded.hands[None], coded.object[None], counts), counts)[1][0, :, 9]
        assert float(angle.max() - angle.min()) == pytest.approx(0 if still else range_rad, abs=0.01 * range_rad + 1e-6)
        assert float(angle.mean()) == pytest.approx(0.2 + range_rad / 2, abs=0.002)


def test_padding_does_not_keep_a_hinge_from_standing_still() -> None:
    there = torch.tensor([[True, True, True, False]])
    found = _still_hinge(torch.tensor([[0.20, 0.22, 0.21, 9.0]]), there)
    torch.testing.assert_close(found[0, :3], torch.full((3,), 0.21))


def test_a_lid_that_opens_does_not_tremble_before_and_after() -> None:
    """It rests, opens by half a radian in half a second, and rests: tremble of some thousandths of a radian goes."""
    angle, still = np.interp(np.arange(90), [38, 52], [0, 0.5]), np.zeros((90, 3))
    thing, _ = features(Rotation.identity(90), still, angle)
    knots = intervals_of(90, 4)
    rows = fit_spline(turned_since_start(thing), torch.ones(90), knots * CODE.config.object_knots)
    rows[:, 9] += 0.004 * torch.randn(len(rows), generator=torch.Generator().manual_seed(0))
    hands, rows = torch.zeros(1, 2, knots + 3, 99), CODE._whitened(rows)[None]
    before = CODE.curves(hands, rows, [90])[1][0, :, 9]
    after = CODE.curves(*CODE.settled(hands, rows, [90]), [90])[1][0, :, 9]
    for rest in (slice(2, 26), slice(64, 88)):
        assert after[rest].diff().abs().max() < 0.3 * before[rest].diff().abs().max()
    assert float((after - torch.from_numpy(angle).float()).abs().max()) < 0.05
