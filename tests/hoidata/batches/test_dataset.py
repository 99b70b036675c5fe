"""Clips as samples: the model frame and back, crops, padding, collate."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch

from hoidata.batches.dataset import HoiDataset, collate
from hoidata.batches.frame_selection import FrameSelection
from hoidata.clips import SIDES, Clip, ObjectTrack
from hoidata.clips.features import upright
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.objects.sampling import SampledPoints, sample_points
from hoidata.store.distances import DistanceEntries
from tests.builders.clips import clip_of, random_hand
from tests.builders.objects import box_model

GRAVITY = np.array([0.0, -1.0, 0.0])


def make_clip(number: int, frames: int) -> Clip:
    draws = np.random.default_rng(number)
    model = box_model((0.05, 0.06, 0.07))
    track = ObjectTrack(model, draws.normal(size=(frames, 3)), draws.normal(size=(frames, 3)) + 5)
    valid = np.arange(frames) != 2
    hands = {side: replace(random_hand(frames, number + shift), valid=valid) for shift, side in enumerate(SIDES)}
    return clip_of(f"toy/s1/{number}", track, hands, gravity=GRAVITY)


@dataclass
class Clips:
    """Clips in memory with what annotation would add: the right hand acts, and touches point f in frame f."""

    clips: dict[str, Clip]
    sampled: dict[str, SampledPoints] = field(default_factory=dict)
    contact_threshold_m: float = 0.02

    def ids(self, split: str) -> list[str]:
        return list(self.clips) if split == "train" else []

    def clip(self, clip_id: str) -> Clip:
        return self.clips[clip_id]

    def joints(self, clip_id: str, side: str) -> np.ndarray:
        return track_joints(self.clips[clip_id].hands[side], load_embedded_hands()[side])

    def hand_type(self, clip_id: str) -> str:
        return "right"

    def verb(self, clip_id: str) -> str | None:
        return self.clips[clip_id].verb

    def sentences(self, clip_id: str) -> list[str]:
        return ["a", "b", "c", "d"]

    def text_embedding(self, clip_id: str) -> np.ndarray:
        return np.zeros((4, 512), np.float32)

    def object_key(self, clip_id: str) -> str:
        return "box"

    def points(self, object_key: str) -> SampledPoints:
        if object_key not in self.sampled:
            self.sampled[object_key] = sample_points(next(iter(self.clips.values())).object.model)
        return self.sampled[object_key]

    def distances(self, clip_id: str) -> DistanceEntries:
        frames = np.arange(self.clips[clip_id].n_frames)
        both = [np.concatenate((frames, frames)) for _ in range(3)]
        side = np.repeat([0, 1], len(frames))
        return DistanceEntries(
            side=side,
            frame=both[0],
            joint=both[1] % 21,
            point=both[2],
            distance_m=np.full(2 * len(frames), 0.01, np.float32),
        )


@pytest.fixture(scope="module")
def clips() -> Clips:
    return Clips({f"toy/s1/{number}": make_clip(number, frames) for number, frames in enumerate((30, 12, 45))})


def test_the_shape_of_a_hand_is_the_mean_over_frames_in_which_it_is_tracked():
    clip = make_clip(1, 6)
    betas = np.repeat(clip.hands["left"].betas, 6, axis=0) + np.arange(6)[:, None]
    betas[2] = 0  # not tracked: what an adapter fills in
    clip = replace(clip, hands={side: replace(track, betas=betas) for side, track in clip.hands.items()})
    sample = HoiDataset(Clips({"toy/s1/1": clip}), "train").whole("toy/s1/1")
    assert sample.betas == pytest.approx(np.stack([betas[[0, 1, 3, 4, 5]].mean(axis=0)] * 2).astype(np.float32))


@pytest.mark.parametrize(
    ("valid", "shown"),
    [("11111", [0, 1, 2, 3, 4]), ("00101", [2, 2, 2, 2, 4]), ("01000", [1, 1, 1, 1, 1]), ("00000", [0, 1, 2, 3, 4])],
)
def test_a_hand_holds_its_last_tracked_pose_and_keeps_the_mask(valid, shown):
    flags = np.array([flag == "1" for flag in valid])
    track = replace(random_hand(5, betas_rows=5), valid=flags)
    filled = track.with_last_valid_pose()
    for name in ("wrist_m", "global_orient", "hand_pose", "betas"):
        np.testing.assert_array_equal(getattr(filled, name), getattr(track, name)[shown])
    np.testing.assert_array_equal(filled.valid, flags)


def test_a_sample_goes_back_to_the_world_it_came_from(clips: Clips) -> None:
    for crop in ("start", "random"):
        sample = HoiDataset(clips, "train", 20, crop, seed=1)[0]
        clip = clips.clip(sample.clip_id).take(slice(sample.start, sample.start + sample.length))
        rotation, origin = sample.world_from_model[:3, :3], sample.world_from_model[:3, 3]
        untracked = 2 - sample.start  # of make_clip; the pose of the frame before is repeated
        shown = [frame - (frame == untracked) for frame in range(sample.length)]
        for number, side in enumerate(("left", "right")):
            world = sample.hands[number, :, :3] @ rotation.T + origin
            np.testing.assert_allclose(world, clip.hands[side].wrist_m[shown], atol=1e-5)
            joints = track_joints(clip.hands[side], load_embedded_hands()[side])[shown]
            np.testing.assert_allclose(sample.joints_m[number] @ rotation.T + origin, joints, atol=1e-5)
        np.testing.assert_allclose(sample.object[:, :3] @ rotation.T + origin, clip.object.translation_m, atol=1e-5)
        turned = rotation.T @ rotvec_to_rotmat(clip.object.rotvec)
        np.testing.assert_allclose(sample.object[:, 3:9], turned[:, :, :2].reshape(-1, 6), atol=1e-5)


def test_the_model_frame_is_upright_with_the_object_at_zero(clips: Clips) -> None:
    sample = HoiDataset(clips, "train")[0]
    np.testing.assert_allclose(sample.object[0, :3], 0, atol=1e-6)
    np.testing.assert_allclose(sample.world_from_model[:3, :3].T @ GRAVITY, [0, 0, -1], atol=1e-9)


def test_contact_and_distances_are_restricted_to_the_crop_and_to_acting_hands(clips: Clips) -> None:
    sample = HoiDataset(clips, "train").whole("toy/s1/0").crop(5, 10)
    assert np.flatnonzero(sample.contact_map).tolist() == list(range(5, 15))
    assert not sample.contact[0].any()
    assert set(sample.distances.side) == {1}
    assert sample.distances.frame.tolist() == list(range(10))
    assert sample.start == 5


def test_the_contact_stages_threshold_decides_what_is_touched_whole_and_cropped(clips: Clips) -> None:
    """Every entry lies 1 cm away: nothing is closer than half of that."""
    strict = HoiDataset(replace(clips, contact_threshold_m=0.005), "train")
    assert not strict.whole("toy/s1/0").contact_map.any()
    assert not strict.whole("toy/s1/0").crop(5, 10).contact_map.any()
    assert collate([strict.whole("toy/s1/0"), strict.whole("toy/s1/1")]).contact_threshold_m == 0.005
    with pytest.raises(BadInput, match="one contact threshold"):
        collate([strict.whole("toy/s1/0"), HoiDataset(clips, "train").whole("toy/s1/1")])


def test_random_crops_repeat_with_the_seed_and_reach_the_last_window(clips: Clips) -> None:
    def starts(seed: int) -> list[int]:
        dataset = HoiDataset(clips, "train", 28, seed=seed)
        crops = []
        for epoch in range(30):
            dataset.set_epoch(epoch)
            crops.append(dataset[0].start)
        return crops

    assert starts(1) == starts(1)
    assert starts(1) != starts(2)
    assert set(starts(1)) == {0, 1, 2}


def test_collate_pads_with_zeros_and_masks_what_is_missing(clips: Clips) -> None:
    samples = list(HoiDataset(clips, "train"))
    batch = collate(samples, FrameSelection(np.tile(np.arange(45), (3, 1))))
    assert batch.hands.shape == (3, 2, 45, 99)
    assert batch.lengths.tolist() == [30, 12, 45]
    assert batch.frames.sum(1).tolist() == [30, 12, 45]
    assert not batch.hands.transpose(1, 2)[~batch.frames].any()
    assert not batch.present[:, 0].any()
    assert batch.present[1, 1].tolist() == [frame < 12 and frame != 2 for frame in range(45)]
    assert torch.equal(batch.contact_map[1].nonzero()[:, 0], torch.arange(12))
    clip, side, frame, joint, point = batch.entries.T
    assert torch.equal(torch.bincount(clip), batch.lengths)
    assert torch.equal(point, frame)
    assert torch.equal(joint, frame % 21)
    assert (side == 1).all()
    assert len(collate(samples).entries) == 0


def test_a_batch_reads_only_the_entries_of_the_frames_it_chose(clips: Clips) -> None:
    samples = list(HoiDataset(clips, "train"))
    frames = np.array([[0, 29], [3, 4], [7, 44]])
    clip, side, frame_index, joint, point = collate(samples, FrameSelection(frames)).entries.T
    assert point.tolist() == frames.flatten().tolist()
    assert (clip.tolist(), frame_index.tolist()) == ([0, 0, 1, 1, 2, 2], [0, 1] * 3)
    assert (joint.tolist(), set(side.tolist())) == ((point % 21).tolist(), {1})


def test_every_clip_shows_a_frame_of_each_interval_and_every_entry_is_drawn_alike(clips: Clips) -> None:
    samples, random = list(HoiDataset(clips, "train")), np.random.default_rng(0)
    sight = FrameSelection.drawn([30, 12, 45], 4, 3, random)
    edges = np.array([[30], [12], [45]]) * np.arange(5) // 4
    assert ((edges[:, :-1] <= sight.frames) & (sight.frames <= edges[:, 1:])).all()
    drawn = [collate(samples, FrameSelection(sight.frames, 3, random)).entries for _ in range(400)]
    assert {len(entries) for entries in drawn} == {3}
    counts = np.unique(torch.cat(drawn)[:, [0, 2]].numpy(), axis=0, return_counts=True)[1]
    assert len(counts) == 12  # each of the 12 frames has one entry, expected 100 times
    assert (abs(counts - 100) < 40).all()


def test_a_batch_moves_to_a_device_with_all_its_tensors(clips: Clips) -> None:
    batch = collate(list(HoiDataset(clips, "train"))).to("meta")
    assert batch.hands.device.type == batch.entries.device.type == "meta"


def test_personal_templates_come_along_or_are_refused_in_a_mixture(clips: Clips) -> None:
    pair = load_embedded_hands()
    whole = clips.clip("toy/s1/0")
    hands = {side: replace(track, template_m=pair[side].template_m) for side, track in whole.hands.items()}
    personal = HoiDataset(Clips({"toy/s1/0": replace(whole, hands=hands)}), "train")[0]
    assert personal.template_m is not None
    batch = collate([personal])
    assert batch.template_m is not None
    expected = np.stack([pair.left.template_m, pair.right.template_m])[None]
    np.testing.assert_allclose(batch.template_m.numpy(), expected, atol=1e-6)
    with pytest.raises(BadInput, match="mixture"):
        collate([personal, HoiDataset(clips, "train")[1]])


@pytest.mark.parametrize("gravity", [(0, 0, -1), (0, 0, 1), (0, -1, 0), (1, 2, -3), None])
def test_upright_is_a_rotation_that_turns_gravity_down(gravity: tuple | None) -> None:
    rotation = upright(None if gravity is None else np.array(gravity))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    if gravity is None or gravity == (0, 0, -1):
        np.testing.assert_array_equal(rotation, np.eye(3))
    else:
        np.testing.assert_allclose(rotation @ gravity / np.linalg.norm(gravity), [0, 0, -1], atol=1e-12)
