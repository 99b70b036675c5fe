"""Hand test, contact maps and distance maps against plane geometry, brute force, world motion and hinges."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips import SIDES, Clip, ObjectTrack
from hoidata.contact.maps import contact_maps, distance_entries, find_active_hands, touched_frames
from hoidata.contact.proximity import ProximityIndex
from hoidata.contact.stage import contact_store
from hoidata.errors import BadInput
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.objects.sampling import SampledPoints
from tests.builders.clips import MIRROR, clip_of, in_another_world, mirror_image, with_hand
from tests.builders.objects import sampled
from tests.builders.stores import write_clips

FRAMES, POINTS = 12, 300
Joints = dict[str, np.ndarray]


@pytest.fixture(params=[False, True], ids=["rigid", "articulated"])
def scene(request: pytest.FixtureRequest) -> tuple[Clip, Joints, SampledPoints]:
    """A cloud of points that moves (and folds), and joints that wander through it."""
    random = np.random.default_rng(5)
    points = random.uniform(-0.08, 0.08, (POINTS, 3)).astype(np.float32)
    part = (points[:, 0] > 0).astype(np.uint8) if request.param else np.zeros(POINTS, np.uint8)
    hinge = Hinge(np.array([0.0, 0.6, 0.8]), np.array([0.01, -0.02, 0.03])) if request.param else None
    model = ObjectModel(name="cloud", vertices_m=points, faces=np.arange(POINTS).reshape(-1, 3), part=part, hinge=hinge)
    angle = np.linspace(-2.0, 1.5, FRAMES) if request.param else None
    track = ObjectTrack(model, random.normal(size=(FRAMES, 3)), random.normal(size=(FRAMES, 3)), angle)
    clip = clip_of("toy/s1/1", track)
    around = articulate(points, part, hinge, angle)
    centre = (track.world_from_object @ around).mean(axis=1)
    joints = {side: centre[:, None] + random.normal(0, 0.07, (FRAMES, 21, 3)) for side in SIDES}
    return clip, joints, sampled(points, part)


def brute_force(clip: Clip, joints: np.ndarray, points: SampledPoints) -> np.ndarray:
    """(frame, point, joint) distances in the world, float64."""
    track = clip.object
    local = articulate(points.points_m.astype(np.float64), points.part, track.model.hinge, track.hinge_rad)
    rotation = Rotation.from_rotvec(track.rotvec).as_matrix()
    world = np.einsum("fij,fpj->fpi", rotation, np.broadcast_to(local, (FRAMES, POINTS, 3)))
    world = world + track.translation_m[:, None]
    return np.linalg.norm(world[:, :, None] - joints[:, None], axis=3)


def test_distance_maps_equal_brute_force(scene: tuple[Clip, Joints, SampledPoints]) -> None:
    clip, joints, points = scene
    entries = distance_entries(clip, joints, ProximityIndex(points))
    for side in SIDES:
        truth = brute_force(clip, joints[side], points)
        assert (truth < 0.02).sum() > 100
        found = entries[side]
        assert len(found) == (truth < 0.02).sum()
        np.testing.assert_allclose(
            found["distance_m"], truth[found["frame"], found["point"], found["joint"]], atol=1e-8
        )


def test_contact_maps_equal_brute_force(scene: tuple[Clip, Joints, SampledPoints]) -> None:
    clip, joints, points = scene
    entries = distance_entries(clip, joints, ProximityIndex(points))
    maps = contact_maps(entries, POINTS)
    for side in SIDES:
        near = brute_force(clip, joints[side], points).min(axis=2)
        np.testing.assert_array_equal(maps[side], (near < 0.02).any(axis=0))
        np.testing.assert_array_equal(touched_frames(entries[side], POINTS), (near < 0.02).sum(axis=0))


def test_hand_evidence_equals_brute_force(scene: tuple[Clip, Joints, SampledPoints]) -> None:
    clip, joints, points = scene
    evidence = find_active_hands(clip, joints, ProximityIndex(points))
    for side in SIDES:
        truth = brute_force(clip, joints[side], points).min(axis=(1, 2))
        np.testing.assert_allclose(evidence.distance_m[side], truth, atol=1e-12)
        assert evidence.closest_m(side) == pytest.approx(truth.min())


def test_nothing_changes_when_the_world_turns_and_shifts(scene: tuple[Clip, Joints, SampledPoints]) -> None:
    clip, joints, points = scene
    rotation, shift = Rotation.from_rotvec((0.4, -1.1, 0.7)), np.array([1.0, -2.0, 0.5])
    other_clip = in_another_world(clip, rotation, shift)
    other_joints = {
        side: rotation.apply(side_joints.reshape(-1, 3)).reshape(side_joints.shape) + shift
        for side, side_joints in joints.items()
    }
    index = ProximityIndex(points)
    before, after = distance_entries(clip, joints, index), distance_entries(other_clip, other_joints, index)
    for side in SIDES:
        for column in ("frame", "point", "joint"):
            np.testing.assert_array_equal(before[side][column], after[side][column])
        np.testing.assert_allclose(before[side]["distance_m"], after[side]["distance_m"], atol=1e-8)


def test_a_joint_exactly_at_the_threshold_gives_no_entry() -> None:
    model = ObjectModel("dot", np.eye(3), np.array([[0, 1, 2]]), np.zeros(3, np.uint8))
    still = ObjectTrack(model, np.zeros((3, 3)), np.zeros((3, 3)))
    joints = np.array([0.02, np.nextafter(0.02, 0), np.nextafter(0.02, 1)])[:, None, None] * np.eye(3)[0]
    found = ProximityIndex(sampled(np.zeros((1, 3)))).entries(joints, np.ones(3, bool), still, 0.02)
    assert found["frame"].tolist() == [1]


def test_in_a_mirror_left_and_right_change_places(scene: tuple[Clip, Joints, SampledPoints]) -> None:
    """The mirror turns x: the object's rotation and hinge run the other way round, each hand becomes the other one."""
    clip, joints, points = scene
    other_joints = {"left": joints["right"] * MIRROR, "right": joints["left"] * MIRROR}
    other_points = replace(points, points_m=(points.points_m * MIRROR).astype(np.float32))
    before = distance_entries(clip, joints, ProximityIndex(points))
    after = distance_entries(mirror_image(clip), other_joints, ProximityIndex(other_points))
    maps, other_maps = contact_maps(before, POINTS), contact_maps(after, POINTS)
    for side, opposite in zip(SIDES, reversed(SIDES), strict=True):
        for column in ("frame", "point", "joint"):
            np.testing.assert_array_equal(before[side][column], after[opposite][column])
        np.testing.assert_allclose(before[side]["distance_m"], after[opposite]["distance_m"], atol=1e-8)
        np.testing.assert_array_equal(maps[side], other_maps[opposite])
    assert not np.array_equal(maps["left"], maps["right"])


def test_a_cut_clip_has_the_entries_of_its_own_frames_only(scene: tuple[Clip, Joints, SampledPoints]) -> None:
    clip, joints, points = scene
    index = ProximityIndex(points)
    whole = distance_entries(clip, joints, index)["left"]
    part = distance_entries(clip.take(slice(3, 7)), {side: joints[side][3:7] for side in SIDES}, index)["left"]
    expected = whole[(whole["frame"] >= 3) & (whole["frame"] < 7)]
    np.testing.assert_array_equal(part["point"], expected["point"])
    np.testing.assert_array_equal(part["frame"], expected["frame"] - 3)


@pytest.fixture
def plane() -> tuple[Clip, SampledPoints]:
    """A flat square of points, 1/256 m apart (exact in float32), at rest in the plane z = 0."""
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20), [0]), -1).reshape(-1, 3) / 256
    model = ObjectModel("plate", grid, np.arange(399).reshape(-1, 3), np.zeros(400, np.uint8))
    return clip_of("toy/s1/1", ObjectTrack(model, np.zeros((2, 3)), np.zeros((2, 3)))), sampled(grid)


def hovering(left_m: float, right_m: float) -> Joints:
    """One joint of each hand above the middle point of the plate, in the second frame only."""
    joints = {side: np.full((2, 21, 3), 1.0) for side in SIDES}
    for side, height in (("left", left_m), ("right", right_m)):
        joints[side][1, 16] = (10 / 256, 10 / 256, height)
    return joints


@pytest.mark.parametrize(
    ("left_m", "right_m", "hand_type"),
    [(0.0199, 0.0201, "left"), (0.0201, 0.0199, "right"), (0.0199, 0.0199, "both"), (0.0201, 0.0201, None)],
)
def test_a_hand_acts_below_2_cm_and_not_above(plane, left_m: float, right_m: float, hand_type: str | None) -> None:
    clip, points = plane
    evidence = find_active_hands(clip, hovering(left_m, right_m), ProximityIndex(points))
    assert evidence.hand_type == hand_type
    assert evidence.closest_m("left") == pytest.approx(left_m)


def test_another_threshold_needs_no_new_distances(plane) -> None:
    clip, points = plane
    evidence = find_active_hands(clip, hovering(0.012, 0.027), ProximityIndex(points))
    judged = [replace(evidence, threshold_m=threshold).hand_type for threshold in (0.01, 0.02, 0.03)]
    assert judged == [None, "left", "both"]


def test_an_invalid_frame_is_no_evidence(plane) -> None:
    clip, points = plane
    clip = with_hand(clip, "left", valid=np.array([True, False]))
    joints, index = hovering(0.01, 0.01), ProximityIndex(points)
    assert find_active_hands(clip, joints, index).hand_type == "right"
    assert len(distance_entries(clip, joints, index)["left"]) == 0


def test_a_joint_on_a_point_counts_with_distance_zero(plane) -> None:
    clip, points = plane
    entries = distance_entries(clip, hovering(0.0, 1.0), ProximityIndex(points))["left"]
    assert entries["distance_m"].min() == 0
    near = [(a, b) for a in range(-9, 10) for b in range(-9, 10) if (a * a + b * b) / 256**2 < 0.02**2]
    assert len(entries) == len(near)


def test_a_clip_too_long_to_count_is_refused(plane) -> None:
    clip, points = plane
    long = replace(clip, source_frames=np.zeros(40_000, np.int32))
    with pytest.raises(BadInput, match="at most 32767 frames"):
        distance_entries(long, {}, ProximityIndex(points))


def test_a_clip_that_either_hand_touches_counts_as_touched(make_clip, tmp_path) -> None:
    left, right, neither = (
        make_clip(4, hand, clip_id=f"toy/s1/{n}") for n, hand in enumerate(("left", "right", "left"))
    )
    neither = with_hand(neither, "left", wrist_m=neither.hands["left"].wrist_m + np.float32(1))
    clips = write_clips(tmp_path / "clips", [left, right, neither])
    counts = contact_store(clips, tmp_path / "contact", points=64)
    assert (counts["clips"], counts["clips_without_contact"]) == (3, 1)
