"""A mirrored clip is what the other hand would have recorded on the mirrored object."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hoidata.batches.dataset import HoiDataset
from hoidata.batches.mirror import Mirror, mirrored_object, swap_hands
from hoidata.clips.features import OBJECT_HINGE
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import load_embedded_hands
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.store.annotated import AnnotatedStore
from models.common.corpus import Wanted, batches
from models.common.features import Hands, object_rotmat

S = np.array([-1.0, 1.0, 1.0])


@pytest.fixture
def pair(annotated: AnnotatedStore):
    """A clip and its mirror image, in a corpus where all of its sentences are known of either hand."""
    samples = list(HoiDataset(annotated, "train"))
    known = {swap_hands(words): row for one in samples for words, row in zip(one.sentences, one.text, strict=True)}
    mirror = Mirror(Mirror.of(samples).text | known)
    return samples[0], mirror.mirrored(samples[0]), mirror


def test_joints_of_mirrored_angles_are_mirrored_joints_of_the_other_hand(pair) -> None:
    sample, other, _ = pair
    hands = Hands(load_embedded_hands())
    for one in (sample, other):
        betas, template = torch.from_numpy(one.betas)[None], one.template_m
        shape = betas, None if template is None else torch.from_numpy(template.astype(np.float32))[None]
        joints = hands.joints(torch.from_numpy(one.hands)[None], *shape)[0].numpy()
        there = one.valid[..., None, None] & np.ones_like(joints, bool)
        np.testing.assert_allclose(joints[there], one.joints_m[there], atol=2e-4)
    np.testing.assert_allclose(other.joints_m, sample.joints_m[::-1] * S, atol=1e-7)


def test_distances_and_contact_belong_to_the_other_hand_and_stay_as_far(pair) -> None:
    sample, other, _ = pair
    np.testing.assert_array_equal(other.contact, sample.contact[::-1])
    rows = other.distances.select(slice(0, 200))
    angles = other.object[rows.frame, OBJECT_HINGE] if other.object_model.hinge else None
    turn = object_rotmat(torch.from_numpy(other.object)).numpy()[rows.frame]
    points = other.points.points_m[rows.point][:, None]
    moved = [
        articulate(p, np.array([part]), other.object_model.hinge, None if angles is None else angles[row : row + 1])[0]
        for row, (p, part) in enumerate(zip(points, other.points.part[rows.point], strict=True))
    ]
    world = np.einsum("nij,nj->ni", turn, np.concatenate(moved)) + other.object[rows.frame, :3]
    distance = np.linalg.norm(other.joints_m[rows.side, rows.frame, rows.joint] - world, axis=1)
    np.testing.assert_allclose(distance, rows.distance_m, atol=2e-4)


def test_twice_in_the_mirror_is_the_clip(pair) -> None:
    sample, other, mirror = pair
    back = mirror.mirrored(other)
    for name in ("hands", "object", "joints_m", "valid", "active_hands", "betas", "text", "contact"):
        np.testing.assert_array_equal(getattr(back, name), getattr(sample, name), err_msg=name)
    assert (back.hand_type, back.sentences) == (sample.hand_type, sample.sentences)
    assert other.hand_type != sample.hand_type or sample.hand_type == "both"
    assert not np.array_equal(other.object, sample.object)


def test_a_hinge_opens_as_far_in_the_mirror() -> None:
    random = np.random.default_rng(0)
    axis = random.normal(size=3)
    points, part = random.normal(size=(20, 3)), np.arange(20) % 2
    hinge = Hinge(axis / np.linalg.norm(axis), random.normal(size=3))
    model = ObjectModel("box", points, np.array([[0, 2, 4]]), part.astype(np.uint8), hinge)
    other, angles = mirrored_object(model), np.array([0.0, 0.4, -1.1])
    moved = articulate(other.vertices_m, part, other.hinge, angles)
    np.testing.assert_allclose(moved, articulate(points, part, hinge, angles) * S, atol=1e-7)
    normals = [np.cross(*np.diff(m.vertices_m[m.faces[0]], axis=0)) for m in (model, other)]
    np.testing.assert_allclose(normals[1], normals[0] * S, atol=1e-7)
    spin = rotmat_to_rotvec(np.asarray(other.hinge.turn(np.array([0.4])).rotation)[0])
    np.testing.assert_allclose(spin, -0.4 * hinge.axis * S, atol=1e-7)


def test_what_has_a_handedness_or_unknown_words_is_left_as_it_is(pair) -> None:
    sample, _, mirror = pair
    assert Mirror.of([replace(sample, verb="screw")]).mirrored(replace(sample, verb="screw")) is None
    assert mirror.mirrored(replace(sample, clip_id="other", verb="screw")) is None
    if sample.hand_type != "both":
        assert Mirror.of([sample]).mirrored(sample) is None


@pytest.mark.parametrize(
    ("said", "other"),
    [
        ("The left hand gives a left shoe to the right hand.", "The right hand gives a left shoe to the left hand."),
        ("Lift a mug with both hands.", "Lift a mug with both hands."),
    ],
)
def test_only_hands_change_sides_in_a_sentence(said: str, other: str) -> None:
    assert (swap_hands(said), swap_hands(other)) == (other, said)


def test_a_training_meets_about_half_of_its_clips_in_the_mirror(annotated: AnnotatedStore) -> None:
    dataset = HoiDataset(annotated, "train")
    mirror = Mirror.of(dataset)
    able = {one.clip_id: mirror.mirrored(one) is not None for one in dataset}
    stream = batches(dataset, 3, 0, Wanted(mirror=True))
    drawn = [one.clip_id for _ in range(100) for one in next(stream)[0][1].samples]
    shares = {name: drawn.count(f"{name} in a mirror") / 100 for name in able}
    assert any(able.values())
    assert all(0.35 < share < 0.65 if able[name] else share == 0 for name, share in shares.items()), shares
    again = batches(dataset, 3, 0, Wanted(mirror=True), start=99)
    assert [one.clip_id for one in next(again)[0][1].samples] == drawn[-3:]
