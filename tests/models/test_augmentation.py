"""Augmented copies have another path and timing; hands keep their pose relative to the object."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from cachetools import LRUCache

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.clips.features import OBJECT_HINGE, OBJECT_POSITION, OBJECT_ROTATION_6D
from hoidata.geometry.rotations import rotation_angle, rotmat_to_rot6d, rotvec_to_rotmat
from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import AnnotatedStore
from models.common.augmentation import Augmentation, augment, augmented_path, entries_at, warped_moments
from models.common.corpus import BatchSpec, batches
from models.common.features import Hands, object_rotmat, to_object_frame

NUMBERS = range(1, 6)


@pytest.fixture
def clips(annotated: AnnotatedStore) -> list[ClipSample]:
    return list(HoiDataset(annotated, "train"))


@pytest.fixture
def copies(annotated: AnnotatedStore) -> Augmentation:
    return Augmentation(HoiDataset(annotated, "train"), 5)


def rotations(sample: ClipSample) -> np.ndarray:
    return object_rotmat(torch.from_numpy(sample.object)).numpy()


@pytest.mark.parametrize("number", NUMBERS)
def test_joints_of_a_copy_match_its_hand_poses(clips: list[ClipSample], copies: Augmentation, number: int) -> None:
    hands = Hands(load_embedded_hands())
    for clip in clips:
        copy = copies.copy_of(clip.clip_id, number)
        template = None if copy.template_m is None else torch.from_numpy(copy.template_m.astype(np.float32))[None]
        joints = hands.joints(torch.from_numpy(copy.hands)[None], torch.from_numpy(copy.betas)[None], template)[
            0
        ].numpy()
        # Joints are interpolated linearly and angles rotate: they differ by less than a millimetre.
        np.testing.assert_allclose(joints[copy.valid], copy.joints_m[copy.valid], atol=1e-3)


@pytest.mark.parametrize("number", NUMBERS)
def test_hands_keep_their_pose_relative_to_the_object(
    clips: list[ClipSample], copies: Augmentation, number: int
) -> None:
    """In the object's frame, joints of every frame of a copy equal those of the clip at some time."""
    for clip in clips:
        copy = copies.copy_of(clip.clip_id, number)
        local, before = (
            to_object_frame(torch.from_numpy(one.joints_m), torch.from_numpy(one.object).expand(2, -1, -1)).numpy()
            for one in (copy, clip)
        )
        fine = np.linspace(0, clip.length - 1, 40 * clip.length)
        frame = fine.astype(int).clip(max=clip.length - 2)
        dense = before[:, frame] + (fine - frame)[:, None, None] * (before[:, frame + 1] - before[:, frame])
        distance = np.abs(local[:, :, None] - dense[:, None]).max((0, 3, 4)).min(1)
        assert distance.max() < 1e-3
        assert not np.allclose(copy.object, clip.object) or np.ptp(clip.object, axis=0).max() < 1e-6


def test_motionless_parts_stay_motionless_and_the_first_frame_is_unchanged(clips: list[ClipSample]) -> None:
    for clip in clips:
        copy = augment(clip, np.random.default_rng(3), 1)
        for part in (slice(0, 2), slice(2, 3), slice(3, 9), slice(OBJECT_HINGE, OBJECT_HINGE + 1)):
            if np.ptp(clip.object[:, part], axis=0).max() < 1e-7:
                np.testing.assert_allclose(copy.object[:, part], clip.object[:, part], atol=1e-6)
        np.testing.assert_allclose(copy.object[0], clip.object[0], atol=1e-6)
        assert np.ptp(copy.object[:, OBJECT_HINGE]) == pytest.approx(np.ptp(clip.object[:, OBJECT_HINGE]), abs=1e-6)
        ends = [np.linalg.norm(one.object[-1, OBJECT_POSITION]) for one in (copy, clip)]
        assert 0.81 * ends[1] <= ends[0] <= 1.23 * ends[1]


def test_a_path_has_one_horizontal_scale_one_vertical_scale_and_a_yaw() -> None:
    objects = torch.zeros(4, 10)
    objects[1:, OBJECT_POSITION] = torch.eye(3)
    objects[:, OBJECT_ROTATION_6D] = torch.tensor([1.0, 0, 0, 1, 0, 0])
    for seed in range(20):
        x, y, z = augmented_path(objects, np.random.default_rng(seed))[1:, OBJECT_POSITION].numpy()
        assert np.linalg.norm(x) == pytest.approx(np.linalg.norm(y), abs=1e-6)
        assert (x[2], y[2], x @ y) == pytest.approx((0, 0, 0), abs=1e-6)
        assert z == pytest.approx([0, 0, z[2]], abs=1e-6)
        assert all(0.81 < length < 1.23 for length in (np.linalg.norm(x), z[2]))
        assert abs(np.linalg.norm(x) - z[2]) > 1e-4
        assert abs(np.arctan2(x[1], x[0])) < 0.36


def test_a_rotation_is_scaled_about_its_axis(clips: list[ClipSample]) -> None:
    turning = turned(clips[0], 1.0)
    copy = augment(turning, np.random.default_rng(4), 1)
    start, end = rotations(copy)[[0, -1]]
    angle = float(rotation_angle((end @ start.T)[None])[0])
    assert 0.8 < angle < 1.23
    assert abs(angle - 1) > 0.01
    np.testing.assert_allclose((end @ start.T) @ [0, 1, 0], [0, 1, 0], atol=1e-5)
    # Near half a circle the axis is ambiguous, so the rotation is not scaled.
    start, end = rotations(augment(turned(clips[0], 2.9), np.random.default_rng(4), 1))[[0, -1]]
    assert float(rotation_angle((end @ start.T)[None])[0]) == pytest.approx(2.9, abs=1e-4)


def test_distance_entries_are_those_of_the_selected_frames(clips: list[ClipSample]) -> None:
    entries = clips[0].distances
    frames = np.array([0, 3, 3, 7, clips[0].length - 1])
    result = entries_at(entries, frames)
    for number, frame in enumerate(frames):
        for name in ("side", "joint", "point", "distance_m"):
            expected = getattr(entries, name)[entries.frame == frame]
            np.testing.assert_array_equal(getattr(result, name)[result.frame == number], expected)
    assert (np.diff(result.frame) >= 0).all()


def test_warped_time_increases_from_the_first_frame_to_the_last() -> None:
    for seed in range(50):
        moments = warped_moments(90, np.random.default_rng(seed))
        assert moments[[0, -1]] == pytest.approx([0, 89])
        speed = np.diff(moments)
        assert 0.78 < speed.min() < 1 < speed.max() < 1.22


def test_training_samples_copies_and_clips_uniformly_and_resumes_exactly(
    annotated: AnnotatedStore,
) -> None:
    dataset = HoiDataset(annotated, "train")
    stream = batches(dataset, 3, 0, BatchSpec(augmented_copies=3))
    clip_ids = [one.clip_id for _ in range(300) for one in next(stream)[0][1].samples]
    for name in dataset.ids:
        frequencies = [
            clip_ids.count(clip_id) / 300 for clip_id in (name, *(f"{name} copy {number}" for number in (1, 2, 3)))
        ]
        assert sum(frequencies) == pytest.approx(sum(clip_id.startswith(name) for clip_id in clip_ids) / 300)
        assert all(0.15 < frequency < 0.35 for frequency in frequencies), frequencies
    resumed = batches(dataset, 3, 0, BatchSpec(augmented_copies=3), start=299)
    once, twice = (
        next(one)[0][1] for one in (resumed, batches(dataset, 3, 0, BatchSpec(augmented_copies=3), start=299))
    )
    assert [one.clip_id for one in once.samples] == clip_ids[-3:]
    assert torch.equal(once.hands, twice.hands)
    plain = next(batches(dataset, 3, 0))[0][1]
    assert all(one.clip_id in dataset.ids for one in plain.samples)


def test_a_hand_is_valid_if_it_was_in_both_interpolated_frames(clips: list[ClipSample]) -> None:
    valid = clips[0].valid.copy()
    valid[:, 5] = False
    moments = warped_moments(clips[0].length, np.random.default_rng(2))
    copy = augment(replace(clips[0], valid=valid), np.random.default_rng(2), 1)
    lost = (moments > 4) & (moments < 6)
    assert lost.sum() >= 2
    np.testing.assert_array_equal(copy.valid, clips[0].valid[:, :1] & ~lost)


def test_copies_of_a_long_clip_have_fixed_windows(annotated: AnnotatedStore) -> None:
    dataset = HoiDataset(annotated, "train", max_frames=12)
    copies = [Augmentation(dataset, 8).copy_of(dataset.ids[0], number) for number in range(1, 9)]
    assert {one.length for one in copies} == {12}
    assert len({one.start for one in copies}) > 3
    assert all(np.abs(one.object[0, OBJECT_POSITION]).max() < 1e-6 for one in copies)
    again = Augmentation(dataset, 8).copy_of(dataset.ids[0], 2)
    assert again.start == copies[1].start
    np.testing.assert_array_equal(again.hands, copies[1].hands)
    first = Augmentation(HoiDataset(annotated, "train", max_frames=12, crop="start"), 8)
    assert {first.copy_of(dataset.ids[0], number).start for number in range(1, 9)} == {0}


def test_copies_stay_within_the_cache_size_and_are_reproducible(annotated: AnnotatedStore) -> None:
    dataset = HoiDataset(annotated, "train")
    max_bytes = 3 * dataset[0].nbytes
    small = Augmentation(dataset, 9, LRUCache(max_bytes, lambda clip: clip.nbytes))
    first = small.copy_of(dataset.ids[0], 1)
    assert small.copy_of(dataset.ids[0], 1) is first
    for number in range(2, 10):
        small.copy_of(dataset.ids[0], number)
        assert sum(clip.nbytes for clip in small.cache.values()) <= max_bytes
    again = small.copy_of(dataset.ids[0], 1)
    assert again is not first
    np.testing.assert_array_equal(again.hands, first.hands)


def turned(clip: ClipSample, angle_rad: float) -> ClipSample:
    """The clip with an object that rotates uniformly about the y axis; hands are not used."""
    rotvec = np.linspace(0, angle_rad, clip.length)[:, None] * [0.0, 1.0, 0.0]
    objects = clip.object.copy()
    start = rotvec_to_rotmat(np.array([0.7, 0.0, 0.2]))
    objects[:, OBJECT_ROTATION_6D] = rotmat_to_rot6d(rotvec_to_rotmat(rotvec) @ start)
    return replace(clip, object=objects)
