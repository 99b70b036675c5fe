"""Inputs and outputs of the networks do not depend on the origin of a mesh."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from hoidata.batches.dataset import ClipBatch, ClipSample, HoiDataset, collate
from hoidata.batches.frame_selection import FrameSelection
from hoidata.clips.features import OBJECT_POSITION
from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import AnnotatedStore
from models.common.augmentation import augment
from models.common.corpus import Corpus
from models.common.features import Hands, Normaliser, base_middle_m, placed_at
from models.common.sampling import SamplerConfig
from models.common.transformer import TransformerConfig
from models.text2hoi.diffusion import Condition, DiffusionConfig, DiffusionModel, MotionGenerator
from models.text2hoi.diffusion_training import DiffusionLossConfig, DiffusionObjective
from models.text2hoi.motion_representation import MotionRepresentation, MotionRepresentationConfig

BOX_CENTRE = MotionRepresentationConfig(
    knot_frames=4,
    hand_frame="object",
    object_reference_point="box_centre",
    object_rotation="relative_to_start",
)
SHIFT_M = torch.tensor([0.4, -0.3, 0.2])  # shift of the mesh relative to its origin


def moved_origin(sample: ClipSample) -> ClipSample:
    """The same recording with another mesh origin: the mesh is shifted, and its positions in the opposite direction."""
    shift, hinge = SHIFT_M.numpy(), sample.object_model.hinge
    points = replace(sample.points, points_m=sample.points.points_m + shift)
    hinge = None if hinge is None else replace(hinge, origin_m=hinge.origin_m + shift)
    model = replace(sample.object_model, vertices_m=sample.object_model.vertices_m + shift, hinge=hinge)
    objects = placed_at(torch.from_numpy(sample.object), -SHIFT_M).numpy()
    return replace(sample, points=points, object_model=model, object=objects)


def points_of(sample: ClipSample) -> tuple[Tensor, Tensor]:
    return torch.from_numpy(sample.points.points_m), torch.from_numpy(sample.points.part)


def turned_about(point_m: np.ndarray, n_frames: int) -> tuple[Tensor, np.ndarray]:
    """Object features of a rotation by 80 degrees about a point of the object, fixed at (1, 2, 3)."""
    rotation = Rotation.from_rotvec(np.linspace(0, 1.4, n_frames)[:, None] * [0.6, 0, 0.8]).as_matrix()
    origin = np.array([1.0, 2.0, 3.0]) - rotation @ point_m
    features = np.column_stack((origin, rotation[:, :, :2].reshape(-1, 6), np.zeros(n_frames)))
    return torch.from_numpy(features).float(), rotation


def test_an_object_can_be_positioned_by_any_of_its_points_and_back() -> None:
    point = np.array([0.05, -0.1, 0.2])
    objects, rotation = turned_about(point, 30)
    placed = placed_at(objects, torch.from_numpy(point).float())
    np.testing.assert_allclose(placed[:, OBJECT_POSITION].numpy(), np.tile([1, 2, 3], (30, 1)), atol=1e-5)
    assert torch.equal(placed[:, 3:], objects[:, 3:])
    other = placed_at(objects, torch.tensor([1.0, 0.0, 0.0]))[:, OBJECT_POSITION].numpy()
    np.testing.assert_allclose(other, objects[:, :3].numpy() + rotation[:, :, 0], atol=1e-5)
    torch.testing.assert_close(placed_at(placed, -torch.from_numpy(point).float()), objects, atol=1e-6, rtol=0)


def test_the_centre_is_that_of_the_bases_bounding_box() -> None:
    points = torch.tensor([[[0.0, 0, 0], [4, 2, 0], [1, 1, 6], [100, 100, 100]]])
    assert base_middle_m(points, torch.tensor([[0, 0, 0, 1]])).tolist() == [[2, 1, 3]]
    assert base_middle_m(points, torch.tensor([[1, 1, 1, 1]])).tolist() == [[50, 50, 50]]


@pytest.mark.parametrize("hand_frame", ["object", "world"])
def test_control_points_do_not_depend_on_the_mesh_origin(batch: ClipBatch, hand_frame: str) -> None:
    for sample in batch.samples:
        for reference_point, same in (("box_centre", True), ("mesh_origin", False)):
            representation = MotionRepresentation(
                replace(BOX_CENTRE, hand_frame=hand_frame, object_reference_point=reference_point)
            )
            one, other = (representation.encode(recording) for recording in (sample, moved_origin(sample)))
            difference = (one.object - other.object).abs().max(), (one.hands - other.hands)[one.present].abs().max()
            assert bool(max(difference) < 2e-4) is same


def test_an_object_that_rotates_in_place_has_a_fixed_box_centre(batch: ClipBatch) -> None:
    sample = moved_origin(batch.samples[0])
    centre = base_middle_m(*points_of(sample)).numpy()
    objects, _ = turned_about(centre, sample.length)
    turning = replace(sample, object=objects.numpy())
    at_centre, at_origin = (
        MotionRepresentation(replace(BOX_CENTRE, object_reference_point=reference_point))
        .encode(turning)
        .object[:, OBJECT_POSITION]
        .abs()
        .max()
        for reference_point in ("box_centre", "mesh_origin")
    )
    assert at_centre < 1e-4
    assert at_origin > 0.3 * np.linalg.norm(centre)


def test_an_augmented_copy_of_a_rotation_in_place_rotates_in_place(batch: ClipBatch) -> None:
    for sample in map(moved_origin, batch.samples):
        centre = base_middle_m(*points_of(sample))
        objects, _ = turned_about(centre.numpy(), sample.length)
        for number in (1, 2, 3):
            copy = augment(replace(sample, object=objects.numpy()), np.random.default_rng(number), number)
            position = placed_at(torch.from_numpy(copy.object), centre)[:, OBJECT_POSITION]
            assert (position - torch.tensor([1.0, 2.0, 3.0])).abs().max() < 1e-4


def test_recorded_motions_have_no_loss_of_joints_and_distances(annotated: AnnotatedStore) -> None:
    """Recorded motions have zero loss, with shifted mesh origins and one control point per frame."""
    clips = [moved_origin(clip) for clip in HoiDataset(annotated, "train")]
    batch = collate(clips, FrameSelection.drawn([clip.length for clip in clips], 5, 2000, np.random.default_rng(0)))
    motion = replace(BOX_CENTRE, knot_frames=0, object_rotation="absolute")
    network = DiffusionModel(DiffusionConfig(TransformerConfig(32, 1), motion=motion))
    loss = DiffusionLossConfig(joint_weight=1.0)
    objective = DiffusionObjective(
        network,
        loss,
        corpus=Corpus.of(annotated, 0),
        hands=Hands(load_embedded_hands()),
        normaliser=Normaliser.identity(),
        device=torch.device("cpu"),
    )
    target = objective.targets.of(batch)
    terms = objective._geometry((target.hands, target.object), batch, target)
    assert len(batch.entries) > 0
    assert float(terms["joints"]) < 1e-9
    assert float(terms["distance_map"]) < 1e-9
    assert float(terms["relative_orientation"]) < 1e-6


def test_a_generated_motion_does_not_depend_on_the_mesh_origin(batch: ClipBatch) -> None:
    """With the same noise, sentence, contact and network, hands and object points have the same positions."""
    torch.manual_seed(0)
    size = TransformerConfig(width=32, layers=1, heads=2, feed_forward=32)
    network = DiffusionModel(DiffusionConfig(size, motion=BOX_CENTRE, contact_input="tokens")).eval()
    generator = MotionGenerator(network, Normaliser.identity(network.representation.object_features).scaled_to(4.0))
    n, sizes = len(batch), network.representation.sizes(batch.frames.shape[1])
    noise = torch.randn(n, 2, sizes[0], 99), torch.randn(n, sizes[1], network.representation.object_features)
    motions = []
    for shift in (torch.zeros(3), SHIFT_M):
        shifted = replace(batch, points_m=batch.points_m + shift)
        condition = Condition(shifted, batch.text[:, 0], [None] * n, batch.contact)
        hands, objects = generator.sample(condition, SamplerConfig(steps=2), lambda: noise)
        at_old_origin = placed_at(objects, shift)
        start = at_old_origin[:, :1, OBJECT_POSITION]
        motions.append((hands[..., :3] - start[:, None], at_old_origin[..., OBJECT_POSITION] - start))
    for one, other in zip(*motions, strict=True):
        torch.testing.assert_close(one, other, atol=1e-3, rtol=0)
    assert motions[0][1].std(1).max() > 0.05
