"""Where an object is: what a network sees and makes does not depend on where a mesh has its origin."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from hoidata.batches.dataset import ClipBatch, ClipSample, HoiDataset, collate
from hoidata.batches.sight import Sight
from hoidata.clips.features import OBJECT_POSITION
from hoidata.hands import load_embedded_hands
from hoidata.store.annotated import AnnotatedStore
from models.common.augmentation import augment
from models.common.corpus import Corpus
from models.common.features import Hands, Normaliser, base_middle_m, placed_at
from models.common.point_net import PointNetConfig
from models.common.sampling import SamplerConfig
from models.common.transformer import TransformerConfig
from models.text2hoi.diffusion import Condition, DiffusionConfig, DiffusionModel, MotionGenerator
from models.text2hoi.diffusion_training import DiffusionLossConfig, DiffusionObjective
from models.text2hoi.motion_code import MotionCode, MotionCodeConfig

MIDDLE = MotionCodeConfig(
    knot_frames=4, object_knots=2, hand_frame="object", object_place="box", object_turn="since start"
)
ELSEWHERE_M = torch.tensor([0.4, -0.3, 0.2])  # where the origin of the same mesh was before it was moved


def moved_origin(sample: ClipSample) -> ClipSample:
    """The same recording of a mesh whose origin lies elsewhere: all of the mesh by so much, positions the other way."""
    shift, hinge = ELSEWHERE_M.numpy(), sample.object_model.hinge
    points = replace(sample.points, points_m=sample.points.points_m + shift)
    hinge = None if hinge is None else replace(hinge, origin_m=hinge.origin_m + shift)
    model = replace(sample.object_model, vertices_m=sample.object_model.vertices_m + shift, hinge=hinge)
    thing = placed_at(torch.from_numpy(sample.object), -ELSEWHERE_M).numpy()
    return replace(sample, points=points, object_model=model, object=thing)


def points_of(sample: ClipSample) -> tuple[Tensor, Tensor]:
    return torch.from_numpy(sample.points.points_m), torch.from_numpy(sample.points.part)


def turned_about(point_m: np.ndarray, n_frames: int) -> tuple[Tensor, np.ndarray]:
    """Object features of a turn by 80 degrees about a point of the object that stands still at (1, 2, 3)."""
    rotation = Rotation.from_rotvec(np.linspace(0, 1.4, n_frames)[:, None] * [0.6, 0, 0.8]).as_matrix()
    origin = np.array([1.0, 2.0, 3.0]) - rotation @ point_m
    rows = np.column_stack((origin, rotation[:, :, :2].reshape(-1, 6), np.zeros(n_frames)))
    return torch.from_numpy(rows).float(), rotation


def test_an_object_is_placed_at_any_of_its_points_and_back() -> None:
    point = np.array([0.05, -0.1, 0.2])
    thing, rotation = turned_about(point, 30)
    placed = placed_at(thing, torch.from_numpy(point).float())
    np.testing.assert_allclose(placed[:, OBJECT_POSITION].numpy(), np.tile([1, 2, 3], (30, 1)), atol=1e-5)
    assert torch.equal(placed[:, 3:], thing[:, 3:])
    other = placed_at(thing, torch.tensor([1.0, 0.0, 0.0]))[:, OBJECT_POSITION].numpy()
    np.testing.assert_allclose(other, thing[:, :3].numpy() + rotation[:, :, 0], atol=1e-5)
    torch.testing.assert_close(placed_at(placed, -torch.from_numpy(point).float()), thing, atol=1e-6, rtol=0)


def test_the_middle_is_that_of_the_box_about_the_base() -> None:
    points = torch.tensor([[[0.0, 0, 0], [4, 2, 0], [1, 1, 6], [100, 100, 100]]])
    assert base_middle_m(points, torch.tensor([[0, 0, 0, 1]])).tolist() == [[2, 1, 3]]
    assert base_middle_m(points, torch.tensor([[1, 1, 1, 1]])).tolist() == [[50, 50, 50]]


@pytest.mark.parametrize("hand_frame", ["object", "world"])
def test_rows_do_not_depend_on_where_a_mesh_has_its_origin(batch: ClipBatch, hand_frame: str) -> None:
    for sample in batch.samples:
        for place, same in (("box", True), ("origin", False)):
            code = MotionCode(replace(MIDDLE, hand_frame=hand_frame, object_place=place))
            one, other = (code.encode(own) for own in (sample, moved_origin(sample)))
            apart = (one.object - other.object).abs().max(), (one.hands - other.hands)[one.present].abs().max()
            assert bool(max(apart) < 2e-4) is same


def test_an_object_that_is_turned_in_one_place_stays_there(batch: ClipBatch) -> None:
    sample = moved_origin(batch.samples[0])
    middle = base_middle_m(*points_of(sample)).numpy()
    thing, _ = turned_about(middle, sample.length)
    turning = replace(sample, object=thing.numpy())
    at_middle, at_origin = (
        MotionCode(replace(MIDDLE, object_place=place)).encode(turning).object[:, OBJECT_POSITION].abs().max()
        for place in ("box", "origin")
    )
    assert at_middle < 1e-4
    assert at_origin > 0.3 * np.linalg.norm(middle)


def test_an_augmented_copy_of_a_turn_in_one_place_is_one(batch: ClipBatch) -> None:
    for sample in map(moved_origin, batch.samples):
        middle = base_middle_m(*points_of(sample))
        thing, _ = turned_about(middle.numpy(), sample.length)
        for number in (1, 2, 3):
            own = augment(replace(sample, object=thing.numpy()), np.random.default_rng(number), number)
            place = placed_at(torch.from_numpy(own.object), middle)[:, OBJECT_POSITION]
            assert (place - torch.tensor([1.0, 2.0, 3.0])).abs().max() < 1e-4


def test_recorded_rows_lose_nothing_in_joints_and_distances(annotated: AnnotatedStore) -> None:
    """Rows of every frame, of meshes whose origin lies elsewhere: what is compared is of one place."""
    clips = [moved_origin(clip) for clip in HoiDataset(annotated, "train")]
    seen = collate(clips, Sight.drawn([clip.length for clip in clips], 5, 2000, np.random.default_rng(0)))
    motion = replace(MIDDLE, knot_frames=0, object_knots=1, object_turn="absolute")
    network = DiffusionModel(DiffusionConfig(TransformerConfig(32, 1), motion=motion))
    loss = DiffusionLossConfig(joint_weight=1.0)
    given = Corpus.of(annotated, 0), Hands(load_embedded_hands()), Normaliser.nothing(), torch.device("cpu")
    objective = DiffusionObjective(network, loss, *given)
    target = objective.targets.of(seen)
    found = objective._geometry((target.hands, target.object), seen, target)
    assert len(seen.entries) > 0
    assert float(found["joints"]) < 1e-9
    assert float(found["distance_map"]) < 1e-9
    assert float(found["relative_orientation"]) < 1e-6


def test_a_motion_made_is_the_same_wherever_the_mesh_has_its_origin(batch: ClipBatch) -> None:
    """Noise, words, touched points and network the same: hands lie where they lay, and so do points of the object."""
    torch.manual_seed(0)
    size = TransformerConfig(width=32, layers=1, heads=2, feed_forward=32)
    told = {"contact_input": "tokens", "scale_input": False}
    network = DiffusionModel(DiffusionConfig(size, PointNetConfig((8, 8, 16), (8, 8), False), MIDDLE, **told)).eval()
    generator = MotionGenerator(network, Normaliser.nothing(network.code.object_features).spread_to(4.0))
    n, rows = len(batch), network.code.sizes(batch.frames.shape[1])
    noise = torch.randn(n, 2, rows[0], 99), torch.randn(n, rows[1], network.code.object_features)
    made = []
    for shift in (torch.zeros(3), ELSEWHERE_M):
        here = replace(batch, points_m=batch.points_m + shift)
        condition = Condition.of(here, batch.text.new_zeros(n, 16), batch.text[:, 0], batch.contact)
        hands, objects = generator.sample(condition, SamplerConfig(steps=2), noise, torch.Generator())
        at_old_origin = placed_at(objects, shift)
        start = at_old_origin[:, :1, OBJECT_POSITION]
        made.append((hands[..., :3] - start[:, None], at_old_origin[..., OBJECT_POSITION] - start))
    for one, other in zip(*made, strict=True):
        torch.testing.assert_close(one, other, atol=1e-3, rtol=0)
    assert made[0][1].std(1).max() > 0.05
