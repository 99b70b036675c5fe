"""Properties of any clip: writing it again gives the same bytes, and no geometry depends on the world frame."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hoidata.clips import SIDES, BodyTrack, CameraTrack, Clip, HandTrack, ObjectTrack, SourceContact, SourceFile
from hoidata.clips.quarantine import Quarantined
from hoidata.contact.maps import distance_entries
from hoidata.contact.proximity import ProximityIndex
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.objects.sampling import sample_points
from hoidata.store.info import generated_info
from hoidata.store.store import open_store, write_store
from hoidata.store_check.check import check_store
from tests.builders.clips import in_another_world

TETRAHEDRON_M = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def mesh(name: str, size: float, hinged: bool) -> ObjectModel:
    hinge = Hinge(np.array([0.0, 0.6, 0.8]), np.array([0.01, 0.0, 0.02])) if hinged else None
    return ObjectModel(
        name=name, vertices_m=TETRAHEDRON_M * size, faces=FACES, part=np.array([0, 0, 1, hinged], np.uint8), hinge=hinge
    )


@st.composite
def any_clip(draw: st.DrawFn) -> Clip:
    """A clip of random numbers, with or without each optional field."""
    flags = st.booleans()
    n = draw(st.integers(1, 7))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    def rows(columns: int) -> np.ndarray:
        return rng.normal(size=(n, columns)).astype(np.float32)

    def hand() -> HandTrack:
        betas = rng.normal(size=(draw(st.sampled_from((1, n))), 10)).astype(np.float32)
        template = rng.random((778, 3)).astype(np.float32) * np.float32(0.2) if draw(flags) else None
        return HandTrack(
            wrist_m=rows(3),
            global_orient=rows(3),
            hand_pose=4 * rows(45),
            betas=betas,
            valid=rng.random(n) < 0.7,
            template_m=template,
        )

    def track() -> ObjectTrack:
        hinged = draw(flags)
        model = mesh(draw(st.sampled_from(("mug", "box"))), draw(st.sampled_from((1.0, 1.25))), hinged)
        return ObjectTrack(model, rows(3), rows(3), 9 * rows(1)[:, 0] if hinged else None)

    def contact() -> SourceContact:
        touched = np.argwhere(rng.random((n, 4)) < draw(st.sampled_from((0.0, 0.4)))).astype(np.int32)
        return SourceContact(touched[:, 0], touched[:, 1], rng.integers(0, 256, len(touched)).astype(np.uint8))

    def camera() -> CameraTrack:
        intrinsics = rng.random(6) * 500 if draw(flags) else None
        return CameraTrack(
            name="cam",
            rotvec=rows(3),
            position_m=rows(3),
            images=rng.integers(0, 9999, n).astype(np.int32),
            intrinsics=intrinsics,
        )

    def body() -> BodyTrack:
        return BodyTrack(
            transl_m=rows(3),
            global_orient=rows(3),
            body_pose=rows(63),
            face_pose=rows(9),
            expression=rows(10) if draw(flags) else None,
        )

    gravity, fitted, number = draw(flags), draw(flags), draw(st.integers(0, 4))
    direction = rng.normal(size=3)
    return Clip(
        clip_id=f"any/s{number}/é {number}",
        dataset="any",
        subject=f"s{number}",
        sequence=draw(st.text(st.characters(codec="utf-8"), max_size=5)),
        hands={side: hand() for side in SIDES},
        object=track(),
        source_frames=np.cumsum(rng.integers(1, 5, n)).astype(np.int32),
        gravity=direction / np.linalg.norm(direction) if gravity else None,
        verb=draw(st.sampled_from((None, "lift", ""))),
        object_words="mug",
        labelled_hand=draw(st.sampled_from((None, "left", "right", "both"))),
        other_objects=tuple(track() for _ in range(draw(st.integers(0, 2)))),
        source_from_world=np.vstack((rng.normal(size=(3, 4)), (0, 0, 0, 1))),
        sources=tuple(SourceFile(f"f{k}", k, f"{k:064x}") for k in draw(st.lists(st.integers(0, 3), unique=True))),
        source_fps=draw(st.sampled_from((30.0, 59.94, 120.0))),
        gravity_note=draw(st.sampled_from(("estimated", "" if gravity else "not said"))),
        hands_from="keypoints" if fitted else "parameters",
        fit_error_m=float(rng.random()) if fitted else None,
        camera=camera() if draw(flags) else None,
        body=body() if draw(flags) else None,
        source_contact=contact() if draw(flags) else None,
    )


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(clips=st.lists(any_clip(), max_size=5), frames_per_shard=st.sampled_from((1, 8, 1000)))
def test_writing_what_was_read_gives_the_same_bytes_and_a_sound_store(clips, frames_per_shard):
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr("hoidata.store.writing.FRAMES_PER_SHARD", frames_per_shard)
        first, second = Path(folder) / "first", Path(folder) / "second"
        write_store(first, clips, generated_info("any"))
        assert check_store(first) == []
        store = open_store(first)
        left_out = [Quarantined(**values) for values in store.quarantine.to_dict("records")]
        write_store(second, [*left_out, *map(store.clip, store.ids)], store.info)
        assert contents(second) == contents(first)
        assert len(store) + len(left_out) == len(clips)


def surface_m(clip: Clip, frame: int) -> np.ndarray:
    """World vertices of the articulated object at one frame, by SciPy."""
    model, track = clip.object.model, clip.object
    points = np.array(model.vertices_m)
    if model.hinge is not None and track.hinge_rad is not None:
        rotation = Rotation.from_rotvec(model.hinge.axis * float(track.hinge_rad[frame]))
        moving = model.part == 1
        points[moving] = rotation.apply(points[moving] - model.hinge.origin_m) + model.hinge.origin_m
    return Rotation.from_rotvec(track.rotvec[frame]).apply(points) + track.translation_m[frame]


def joint_distances_m(clip: Clip) -> np.ndarray:
    """(side, frame, joint) distance of every joint to the nearest vertex."""
    joints = np.stack([track_joints(clip.hands[side], load_embedded_hands()[side]) for side in SIDES])
    frames = range(clip.n_frames)
    return np.stack([cKDTree(surface_m(clip, frame)).query(joints[:, frame])[0] for frame in frames], axis=1)


def through_store(clip: Clip, folder: Path) -> Clip:
    write_store(folder, [clip], generated_info("any"))
    return open_store(folder).clip(clip.clip_id)


def pixels(clip: Clip, points_m: np.ndarray) -> np.ndarray:
    """World points (frame, 3) as the clip's camera sees them: x / z, y / z."""
    assert clip.camera is not None
    points_camera_m = Rotation.from_rotvec(clip.camera.rotvec).inv().apply(points_m - clip.camera.position_m)
    return points_camera_m[:, :2] / points_camera_m[:, 2:]


@pytest.fixture
def seen_clip(make_clip: Callable[..., Clip]) -> Clip:
    """An articulated object in both hands, a further object, points_camera_m by a moving camera two metres behind."""
    clip = make_clip(12, "both", articulated=True, seed=4)
    path = np.linspace((0.1, 0.2, -1.2), (0.2, 0.1, -1.1), 12).astype(np.float32)
    camera = CameraTrack("cam0", np.full((12, 3), 0.05, np.float32), path, np.arange(12, dtype=np.int32))
    return replace(clip, camera=camera, other_objects=(make_clip(12, seed=5).object,))


@pytest.fixture
def points(seen_clip: Clip) -> ProximityIndex:
    return ProximityIndex(sample_points(seen_clip.object.model, 128))


def touching(clip: Clip, points: ProximityIndex, threshold_m: float) -> dict[str, set[tuple[int, ...]]]:
    """Per hand the (frame, joint, point) closer than the threshold."""
    joints = {side: track_joints(clip.hands[side], load_embedded_hands()[side]) for side in SIDES}
    entries = distance_entries(clip, joints, points, threshold_m)
    return {side: set(entries[side][["frame", "joint", "point"]].tolist()) for side in SIDES}


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), reach_m=st.sampled_from((0.0, 0.5, 5.0)))
def test_distances_and_contact_do_not_depend_on_the_world_frame(seen_clip, points, seed, reach_m):
    rng = np.random.default_rng(seed)
    rotation, shift_m = Rotation.random(rng=rng), rng.uniform(-reach_m, reach_m, 3)
    with tempfile.TemporaryDirectory() as folder:
        one = through_store(seen_clip, Path(folder) / "one")
        two = through_store(in_another_world(seen_clip, rotation, shift_m), Path(folder) / "two")
    np.testing.assert_allclose(joint_distances_m(two), joint_distances_m(one), atol=5e-6)
    # Float32 places a few micrometres apart may fall on either side of the threshold, no others.
    first, second = (touching(clip, points, 0.02) for clip in (one, two))
    first_nearly, second_nearly = (touching(clip, points, 0.02 + 1e-5) for clip in (one, two))
    for side in SIDES:
        assert first[side]
        assert first[side] <= second_nearly[side]
        assert second[side] <= first_nearly[side]


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1))
def test_the_source_the_image_and_the_fall_do_not_depend_on_the_world_frame(seen_clip, seed):
    rng = np.random.default_rng(seed)
    rotation, shift_m = Rotation.random(rng=rng), rng.uniform(-1, 1, 3)
    with tempfile.TemporaryDirectory() as folder:
        one = through_store(seen_clip, Path(folder) / "one")
        two = through_store(in_another_world(seen_clip, rotation, shift_m), Path(folder) / "two")
    in_source = [np.c_[clip.hands["left"].wrist_m, np.ones(12)] @ clip.source_from_world.T for clip in (one, two)]
    np.testing.assert_allclose(in_source[1], in_source[0], atol=1e-6)
    for point in ("object", "left", "right"):
        places = [c.object.translation_m if point == "object" else c.hands[point].wrist_m for c in (one, two)]
        np.testing.assert_allclose(pixels(two, places[1]), pixels(one, places[0]), atol=1e-6)
    falls = [Rotation.from_rotvec(c.object.rotvec).inv().apply(c.gravity) for c in (one, two)]
    np.testing.assert_allclose(falls[1], falls[0], atol=1e-6)
