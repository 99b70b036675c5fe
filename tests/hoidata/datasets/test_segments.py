"""Recordings are cut into clips of one action each by contact, object motion and hinge angle."""

from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips import SIDES, Clip, Side
from hoidata.clips.quarantine import Quarantined
from hoidata.clips.validation import check_clip
from hoidata.contact.settings import ContactSettings
from hoidata.datasets import RawTree, get_adapter
from hoidata.datasets import segments as cutting
from hoidata.datasets.segments import (
    LONGEST_FRAMES,
    MARGIN_FRAMES,
    SHORTEST_FRAMES,
    find_segments,
    object_signals,
    segment_clips,
)
from hoidata.geometry.intervals import Interval
from hoidata.hands import HandPair, load_embedded_hands, track_joints
from hoidata.store.hand_evidence import HandEvidence
from tests.builders import arctic, hoi4d, hot3d, manipnet, oakink2
from tests.builders.clips import build_clip, clip_of, flat_hand, still_object, with_object
from tests.builders.objects import box_model, hinged_box

RAMP = np.linspace(0, 1, 40)


def recording(frames: int, height_m: np.ndarray | None = None, hinge_rad: np.ndarray | None = None) -> Clip:
    """An object that rises to height_m (frame,) with z up, or whose hinge has these angles (frame,)."""
    model = box_model() if hinge_rad is None else hinged_box()
    clip = clip_of("test/s1/long", still_object(model, frames, hinge_rad))
    if height_m is None:
        return clip
    return with_object(clip, translation_m=np.stack([0 * height_m, 0 * height_m, height_m], axis=1).astype(np.float32))


def evidence(frames: int, left: slice | None = None, right: slice | None = None) -> HandEvidence:
    """Hands at 1 cm in these frames and 10 cm away in the others."""
    distance_m: dict[Side, np.ndarray] = {"left": np.full(frames, 0.1), "right": np.full(frames, 0.1)}
    for side, touched in zip(SIDES, (left, right), strict=True):
        distance_m[side][touched or slice(0, 0)] = 0.01
    return HandEvidence(distance_m, 0.02)


def ends(segments: list[Interval]) -> list[tuple[int, int]]:
    return [(segment.start, segment.stop) for segment in segments]


def test_a_recording_without_contact_has_no_segment():
    assert find_segments(recording(200), evidence(200)) == []


def test_a_contact_gets_half_a_second_of_approach_and_release():
    segments = find_segments(recording(300), evidence(300, right=slice(100, 180)))
    assert segments == [Interval(100 - MARGIN_FRAMES, 180 + MARGIN_FRAMES)]
    at_the_ends = find_segments(recording(120), evidence(120, right=slice(5, 110)))
    assert ends(at_the_ends) == [(0, 120)]


def test_a_contact_lost_for_a_third_of_a_second_continues_and_one_lost_for_longer_ends():
    clip, touching = recording(300), evidence(300, right=slice(100, 180))
    touching.distance_m["right"][140:150] = 0.1
    assert len(find_segments(clip, touching)) == 1
    touching.distance_m["right"][140:151] = 0.1
    assert ends(find_segments(clip, touching)) == [(85, 151), (151, 195)]


def test_opening_and_closing_a_hinge_are_two_segments():
    angle = np.concatenate([np.zeros(60), RAMP, np.ones(40), RAMP[::-1], np.zeros(60)])
    segments = find_segments(recording(len(angle), hinge_rad=angle), evidence(len(angle), left=slice(20, 220)))
    opening, closing = (next(s for s in segments if s.start <= frame < s.stop) for frame in (80, 160))
    assert opening.stop <= closing.start
    assert angle[opening.stop - 1] - angle[opening.start] > 0.9
    assert angle[closing.start] - angle[closing.stop - 1] > 0.9


def test_a_hinge_that_reverses_is_cut_where_it_reverses():
    angle = np.concatenate([np.zeros(50), RAMP, RAMP[::-1], np.zeros(50)])
    segments = find_segments(recording(len(angle), hinge_rad=angle), evidence(len(angle), left=slice(0, len(angle))))
    assert min(abs(segment.start - 90) for segment in segments) <= 1


@pytest.mark.parametrize(("rise_m", "is_cut"), [(0.2, True), (0.05, False)])
def test_a_lift_is_cut_at_its_top_if_it_is_high_enough(rise_m, is_cut):
    height_m = rise_m * np.concatenate([np.zeros(5), RAMP, RAMP[::-1], np.zeros(5)])
    segments = find_segments(recording(len(height_m), height_m), evidence(len(height_m), right=slice(0, 90)))
    assert any(abs(segment.start - height_m.argmax()) <= 1 for segment in segments) == is_cut


def test_a_second_hand_that_arrives_begins_a_segment():
    segments = find_segments(recording(140), evidence(140, left=slice(10, 130), right=slice(70, 130)))
    assert ends(segments) == [(0, 70), (70, 140)]


def test_no_segment_is_longer_than_the_models_see_or_shorter_than_a_second_of_contact():
    rng = np.random.default_rng(0)
    for frames in (151, 400, 1000, 1733):
        height_m = np.cumsum(rng.normal(0, 0.004, frames))
        segments = find_segments(recording(frames, height_m), evidence(frames, right=slice(20, frames - 20)))
        lengths = [segment.stop - segment.start for segment in segments]
        assert max(lengths) <= LONGEST_FRAMES
        assert min(lengths) >= SHORTEST_FRAMES
        assert segments[0].start == 5
        assert [segment.stop for segment in segments[:-1]] == [segment.start for segment in segments[1:]]


def test_a_long_contact_is_divided_at_slow_frames():
    speed = np.full(300, 0.01)
    speed[95:105] = 0
    segments = find_segments(recording(300, np.cumsum(speed)), evidence(300, right=slice(0, 300)))
    assert 95 <= segments[0].stop <= 105


def test_noise_of_a_tracker_is_no_motion_and_the_signals_do_not_depend_on_the_world():
    noise_m = np.random.default_rng(0).normal(0, 0.0005, 200)
    signals = object_signals(recording(200, noise_m))
    assert not signals.is_carried.any()
    assert not object_signals(replace(recording(50), gravity=None)).is_carried.any()
    assert object_signals(replace(recording(50), gravity=None)).height_m is None


def test_segments_are_clips_with_the_frames_in_their_ids():
    clip = build_clip(n_frames=400, seed=3)
    clips = list(segment_clips([clip], load_embedded_hands()))
    assert len(clips) > 1
    assert [item.clip_id for item in clips] == [
        f"{clip.clip_id}/{item.source_frames[0] + 1:04d}-{item.source_frames[-1] + 1:04d}" for item in clips
    ]
    assert sum(item.n_frames for item in clips) == 400
    short = build_clip(n_frames=LONGEST_FRAMES)
    assert list(segment_clips([short], load_embedded_hands())) == [short]


def test_a_recording_that_no_hand_comes_near_is_quarantined():
    (reason,) = segment_clips(
        [replace(build_clip(), hands={side: flat_hand(np.full((30, 3), 9.0)) for side in SIDES})], load_embedded_hands()
    )
    assert isinstance(reason, Quarantined)
    assert (reason.expected, reason.got) == ("a hand within 2 cm of the object", "none in any frame")


def test_a_segment_begins_and_ends_with_a_recorded_frame():
    whole = build_clip(n_frames=400, seed=3)
    every_second = replace(whole, source_frames=(np.arange(400) // 2).astype(np.int32))
    clips = list(segment_clips([every_second], load_embedded_hands()))
    assert len(clips) > 1
    for clip in clips:
        position = np.flatnonzero((whole.object.translation_m == clip.object.translation_m[0]).all(axis=1))
        assert set(position % 2) == {0}
        assert clip.recorded[-1]


ADAPTERS = {
    "arctic": (arctic.write_two, True),
    "hoi4d": (hoi4d.write_two, True),
    "hot3d": (hot3d.write_two, False),
    "manipnet": (lambda root: manipnet.write_tree(root, *manipnet.lift_rows(480)), False),
    "oakink2": (oakink2.write_two, True),
}


@pytest.mark.long
@pytest.mark.parametrize("name", ADAPTERS)
def test_adapters_of_long_recordings_cut_them_into_segments(name, tmp_path, monkeypatch):
    """The recordings of these trees are short, so segments are made shorter. Hands touch from 30 cm."""
    longest = 18
    monkeypatch.setattr(cutting, "LONGEST_FRAMES", longest)
    monkeypatch.setattr(cutting, "SHORTEST_FRAMES", 6)
    monkeypatch.setattr(cutting, "ContactSettings", lambda: ContactSettings(threshold_m=0.3))
    write, has_descriptions = ADAPTERS[name]
    write(tmp_path)
    hands, raw = load_embedded_hands(), RawTree(tmp_path)
    keys = get_adapter(name).sequences(tmp_path)
    clips = clips_of(get_adapter(name, clips="segments"), raw, keys, hands)
    assert len(clips) > len(keys)
    assert len({clip.clip_id for clip in clips}) == len(clips)
    for clip in clips:
        check_clip(clip)
        assert clip.n_frames <= longest
        assert clip.verb is None
        assert clip.labelled_hand is None
    again = clips_of(get_adapter(name, clips="segments"), raw, keys, hands)
    assert [clip.clip_id for clip in again] == [clip.clip_id for clip in clips]
    for recording in clips_of(
        get_adapter(name, clips="whole" if has_descriptions else "interactions"), raw, keys, hands
    ):
        parts = [clip for clip in clips if part_of(clip) == part_of(recording)]
        covered = np.isin(recording.source_frames, np.concatenate([[-1], *(clip.source_frames for clip in parts)]))
        near = near_frames(recording, hands)
        assert (near & covered).sum() >= 0.9 * near.sum()


@pytest.mark.parametrize(
    ("name", "descriptions"),
    [("arctic", "description.txt"), ("hoi4d", "action/color.json"), ("oakink2", "program_info/*.json")],
)
def test_only_a_recording_without_a_description_falls_back_to_segments(name, descriptions, tmp_path):
    ADAPTERS[name][0](tmp_path)
    hands, keys = load_embedded_hands(), get_adapter(name).sequences(tmp_path)

    def ids(clips: str) -> list[str]:
        return [clip.clip_id for clip in clips_of(get_adapter(name, clips=clips), RawTree(tmp_path), keys, hands)]

    described = ids("described")
    assert described
    assert ids("described-else-segments") == described
    for path in tmp_path.rglob(descriptions):
        path.unlink()
    assert ids("described-else-segments") == ids("segments") != described


def clips_of(adapter, raw: RawTree, keys: list, hands: HandPair) -> list[Clip]:
    return [item for key in keys for item in adapter.load(raw, key, hands) if isinstance(item, Clip)]


def part_of(clip: Clip) -> tuple[str, str]:
    return clip.sequence, clip.object.model.name


def near_frames(clip: Clip, hands: HandPair) -> np.ndarray:
    """(frame,) bool: a joint is within 30 cm of a vertex of the object."""
    vertices_m = clip.object.points_in_world(clip.object.model.vertices_m, clip.object.model.part)
    joints_m = np.concatenate([track_joints(clip.hands[side], hands[side]) for side in SIDES], axis=1)
    valid = np.repeat(np.stack([clip.hands[side].valid for side in SIDES], axis=1), 21, axis=1)
    distance_m = np.linalg.norm(joints_m[:, :, None] - vertices_m[:, None], axis=-1).min(axis=2)
    return np.any((distance_m < 0.3) & valid, axis=1)
