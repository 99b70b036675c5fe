"""What stands for a motion: splines that come back as the motion, hands that keep still on what they hold."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline
from torch import Tensor

from hoidata.batches.dataset import ClipBatch, ClipSample, HoiDataset
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.store.annotated import AnnotatedStore
from models.common.features import Normaliser, hands_in_object_frame, hands_in_world, proper_hands, recentred
from models.common.spline import fit_spline, intervals_of, projected, settled, spline_basis, stacked_bases
from models.text2hoi.motion_code import MotionCode, MotionCodeConfig

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
