"""Packing clips between runs preserves every bit of every field and refuses types that clips do not contain."""

import json
from dataclasses import dataclass, fields, is_dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from hoidata.clips.clip import BodyTrack, CameraTrack, Clip, SourceContact, SourceFile
from hoidata.clips.quarantine import Quarantined
from hoidata.conversion.finished import Packer, unpack
from hoidata.objects.model import ObjectModel


def round_trip(value):
    shared_arrays: dict[str, np.ndarray] = {}

    def share(array: np.ndarray) -> str:
        shared_arrays[str(len(shared_arrays))] = array
        return str(len(shared_arrays) - 1)

    packer = Packer(share)
    text = json.dumps(packer.pack(value))
    assert packer.shared == set(shared_arrays)
    return unpack(json.loads(text), packer.arrays, shared_arrays.__getitem__), shared_arrays


def bits(value):
    """A value with every number as its bytes, type and shape."""
    if is_dataclass(value):
        return type(value), [(item.name, bits(getattr(value, item.name))) for item in fields(value)]
    if isinstance(value, np.ndarray | np.generic):
        return type(value), value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, dict):
        return [(key, bits(item)) for key, item in value.items()]
    if isinstance(value, tuple | list):
        return type(value), [bits(item) for item in value]
    return type(value), repr(value)


def full_clip(make_clip) -> Clip:
    clip, rng = make_clip(n_frames=7, articulated=True), np.random.default_rng(1)
    return replace(
        clip,
        other_objects=(make_clip(n_frames=7).object,),
        camera=CameraTrack(
            name="cam4",
            rotvec=rng.random((7, 3)),
            position_m=rng.random((7, 3)),
            images=np.arange(7, dtype=np.int32),
            intrinsics=rng.random(6),
        ),
        body=BodyTrack(rng.random((7, 3)), rng.random((7, 3)), rng.random((7, 63)), rng.random((7, 9))),
        source_contact=SourceContact(np.zeros(3, np.int32), np.arange(3, dtype=np.int32), np.full(3, 22, np.uint8)),
        sources=(SourceFile("s1/mug.npz", 12, "ab" * 32), SourceFile("mug.obj", 1 << 40, "cd" * 32)),
        fit_error_m=0.1 + 0.2,
        gravity_note="é",
    )


def test_a_round_trip_preserves_every_bit_of_a_clip(make_clip):
    clips = [
        full_clip(make_clip),
        replace(make_clip(), gravity=None),
        Quarantined("a", where="b", expected="c", got="d", remedy="é"),
    ]
    back, _ = round_trip(clips)
    assert bits(back) == bits(clips)


def test_meshes_and_personal_hands_are_shared_and_one_object_only_once(make_clip):
    clip = full_clip(make_clip)
    right = replace(clip.hands["right"], template_m=np.random.default_rng(0).random((778, 3)))
    clips = [replace(clip, hands={**clip.hands, "right": right}), clip.take(slice(1, 3)), clip.take(slice(2, 5))]
    back, shared_arrays = round_trip(clips)
    assert bits(back) == bits(clips)
    assert len(shared_arrays) == 3 + 3 + 1  # vertices, faces and parts of two objects; one template


@given(
    arrays.arrays(
        st.sampled_from(["<f4", "<f8", ">f8", "<i4", "|u1", "|b1", "<i8"]),
        arrays.array_shapes(min_dims=0, max_dims=3, min_side=0),
    )
)
def test_a_round_trip_preserves_any_array_of_numbers_including_nan(array):
    back, _ = round_trip([array, array])
    assert bits(back) == bits([np.asarray(array)] * 2)


@given(st.floats() | st.integers() | st.booleans() | st.text() | st.none() | st.tuples(st.floats(), st.text()))
def test_a_round_trip_preserves_plain_values(value):
    assert bits(round_trip(value)[0]) == bits(value)


def test_a_round_trip_preserves_the_type_of_numpy_scalars():
    values = (np.float32(0.1), np.float64(0.1), np.int32(7), np.bool_(True))
    assert bits(round_trip(values)[0]) == bits(values)


@dataclass(frozen=True)
class Tracks:
    pass


class SpecialModel(ObjectModel):
    pass


@pytest.mark.parametrize("value", [Tracks(), {1, 2}, np.array([None]), b"bytes", SpecialModel("a", *[np.zeros(1)] * 3)])
def test_other_types_are_refused(value):
    with pytest.raises(TypeError, match="cannot be part of a clip"):
        Packer(lambda array: "").pack(value)
