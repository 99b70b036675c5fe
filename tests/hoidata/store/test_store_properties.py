"""Any clip: writing it again gives the same bytes."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hoidata.clips import SIDES, BodyTrack, CameraTrack, Clip, HandTrack, ObjectTrack, SourceContact, SourceFile
from hoidata.clips.quarantine import Quarantined
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.store.info import generated_info
from hoidata.store.store import open_store, write_store
from hoidata.store_check.check import check_store

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
