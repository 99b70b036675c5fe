"""Properties of the networks: masks exclude padding, all parameters learn, modules follow their equations."""

import math
from dataclasses import replace
from typing import Literal

import pytest
import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from hoidata.batches.dataset import ClipBatch, collate
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from models.common.features import Hands
from models.common.point_net import PointNetConfig
from models.common.transformer import (
    Block,
    Encoder,
    TransformerConfig,
    agent_codes,
    attention_mask_of,
    packed,
    sinusoid,
)
from models.text2hoi.diffusion import Condition, DiffusionConfig, DiffusionModel
from models.text2hoi.length import LengthConfig, LengthModel, length_loss
from models.text2hoi.motion_representation import MotionRepresentationConfig
from models.text2hoi.refiner import CoarseMotion, NoisedHands, RefinerConfig, RefinerModel, Surface, refine

SMALL = TransformerConfig(
    width=32, layers=2, heads=2, feed_forward=64, dropout=0.0, norm_first=True, frames_per_token=2
)
POINT_NET = PointNetConfig(widths=(16, 32, 64), heads=(32, 16))
VERBS = ("lift", "open", "pass")


def diffusion_model(**changes) -> DiffusionModel:
    torch.manual_seed(0)
    config = DiffusionConfig(SMALL, POINT_NET, contact_input="tokens", frames_to_go=True, verbs=VERBS)
    return DiffusionModel(replace(config, **changes)).eval()


def condition_of(batch: ClipBatch) -> Condition:
    return Condition(batch, batch.text[:, 0], [sample.verb for sample in batch.samples], batch.contact)


def coarse_of(batch: ClipBatch) -> CoarseMotion:
    surface = Surface.of(Hands(load_embedded_hands()), batch.objects, torch.device("cpu"))
    return surface.coarse(batch, batch.hands, batch.object, batch.contact_map, batch.present)


SETTINGS = {
    "paper": {},
    "tokens of frames": {"transformer": replace(SMALL, frames_per_token=5)},
    "splines": {"motion": MotionRepresentationConfig(knot_frames=4)},
    "object frame": {"motion": MotionRepresentationConfig(hand_frame="object")},
    "box centre as position": {
        "motion": MotionRepresentationConfig(hand_frame="object", object_reference_point="box_centre")
    },
    "rotation since the start": {"motion": MotionRepresentationConfig(object_rotation="relative_to_start")},
    "whitened": {"motion": MotionRepresentationConfig(knot_frames=4, whitening_frames=8)},
    "contact tokens": {"contact_input": "tokens"},
    "verbs": {"verbs": VERBS},
    "frames to go": {"frames_to_go": True},
    "signal scale": {"signal_scale": 0.2},
    "adaptive norm": {"transformer": replace(SMALL, adaptive_norm=True)},
}


def points_of(batch: ClipBatch, model: DiffusionModel) -> tuple[Tensor, Tensor]:
    clips = [model.representation.encode(sample) for sample in batch.samples]
    hands = pad_sequence([clip.hands.transpose(0, 1) for clip in clips], batch_first=True).transpose(1, 2)
    return hands, pad_sequence([clip.object for clip in clips], batch_first=True)


@pytest.mark.parametrize("setting", SETTINGS)
def test_padding_and_absent_hands_change_no_output(batch: ClipBatch, setting: str) -> None:
    torch.manual_seed(0)
    model = DiffusionModel(replace(DiffusionConfig(SMALL, POINT_NET), **SETTINGS[setting])).eval()
    condition, steps = condition_of(batch), torch.tensor([10, 500, 900])
    hands, objects = points_of(batch, model)
    hand_mask, object_mask = model.representation.valid_masks(batch.counts, torch.device("cpu"))
    with torch.no_grad():
        before = model(hands, objects, steps, condition)
        hands[~batch.active_hands] = 100.0
        hands.transpose(1, 2)[~hand_mask] = -50.0
        objects[~object_mask] = 50.0
        idle = condition.contact | ~batch.active_hands[..., None]
        after = model(hands, objects, steps, replace(condition, contact=idle))
    present = hand_mask[:, None] & batch.active_hands[..., None]
    assert torch.equal(before[0][present], after[0][present])
    assert torch.equal(before[1][object_mask], after[1][object_mask])


@pytest.mark.parametrize("name", ["contact_map", "scale"])
@pytest.mark.parametrize("is_zero", [False, True])
def test_an_input_that_is_zero_changes_no_output(batch: ClipBatch, name: str, is_zero: bool) -> None:
    torch.manual_seed(0)
    model = DiffusionModel(DiffusionConfig(SMALL, POINT_NET, zero_inputs=(name,) if is_zero else ())).eval()
    condition, steps = condition_of(batch), torch.tensor([10, 500, 900])
    other_batch = replace(batch, points_m=batch.points_m * 2, scale_m=batch.scale_m * 2)
    other = replace(condition, **({"batch": other_batch} if name == "scale" else {"contact": ~condition.contact}))
    with torch.no_grad():
        outputs = [model(*points_of(batch, model), steps, one)[1] for one in (condition, other)]
    assert torch.equal(*outputs) == is_zero


def test_position_codes_that_are_zero_are_equal_for_all_frames_or_agents() -> None:
    for zero_inputs in ((), ("frame_codes",), ("agent_codes",), ("frame_codes", "agent_codes")):
        model = DiffusionModel(DiffusionConfig(SMALL, POINT_NET, zero_inputs=zero_inputs))
        codes = model._codes(torch.tensor([40]), [4, 4, 4], (0, 1))[0].unflatten(0, (3, 4))  # by agent and frame
        assert torch.allclose(codes, codes[:, :1], atol=1e-6) == ("frame_codes" in zero_inputs)
        assert torch.allclose(codes, codes[:1], atol=1e-6) == ("agent_codes" in zero_inputs)


def test_each_setting_changes_only_its_part_of_the_weights() -> None:
    """Names of the weights that one setting adds, removes or reshapes."""
    paper_shapes = shapes(DiffusionConfig(SMALL, POINT_NET))
    parts = {
        "paper": set(),
        "tokens of frames": {"hands_in", "object_in", "hands_out", "object_out"},
        "splines": {"object_in", "object_out"},
        "object frame": set(),
        "box centre as position": set(),
        "rotation since the start": {"object_in", "object_out"},
        "whitened": {"object_in", "object_out"},  # by its splines
        "contact tokens": {"object_net", "object_condition_in", "points_in"},
        "verbs": {"verb_in"},
        "frames to go": {"to_go_in"},
        "signal scale": set(),
        "adaptive norm": {"encoder"},
    }
    for setting, changes in SETTINGS.items():
        changed_shapes = shapes(replace(DiffusionConfig(SMALL, POINT_NET), **changes))
        different = {
            name for name in paper_shapes | changed_shapes if paper_shapes.get(name) != changed_shapes.get(name)
        }
        assert {name.split(".")[0] for name in different} == parts[setting], setting


def shapes(config: DiffusionConfig) -> dict[str, tuple[int, ...]]:
    return {name: tuple(weight.shape) for name, weight in DiffusionModel(config).named_parameters()}


def block_with_adaptive_norm() -> Block:
    torch.manual_seed(0)
    block = Block(replace(SMALL, adaptive_norm=True)).eval()
    for weight in block.modulations.parameters():
        nn.init.normal_(weight, std=0.3)
    return block


def test_the_block_follows_adaptive_layer_norm() -> None:
    """Peebles and Xie 2023, written out: each half reads scale * norm(x) + shift, and its output is scaled."""
    block, x, condition = block_with_adaptive_norm(), torch.randn(2, 7, 32), torch.randn(2, 1, 32)
    mask, expected = torch.ones(2, 7, dtype=torch.bool), x
    halves = [(block.norm_attention, lambda y: block.attend(y, mask)), (block.norm_feed_forward, block.feed_forward)]
    for (norm, half), modulation in zip(halves, block.modulations, strict=True):
        _, narrow, _, last = modulation.layers
        modulation_values = (
            nn.functional.silu(nn.functional.silu(condition) @ narrow.weight.T + narrow.bias) @ last.weight.T
        )
        scale, shift, gate = (modulation_values + last.bias).split(32, -1)
        modulated = norm(expected) * (1 + scale) + shift
        expected = expected + (1 + gate) * half(modulated)
    torch.testing.assert_close(block(x, mask, condition), expected)


def test_adaptive_norm_starts_as_the_identity_and_then_reads_the_condition() -> None:
    torch.manual_seed(0)
    plain, block = Block(SMALL).eval(), Block(replace(SMALL, adaptive_norm=True))
    block.eval().load_state_dict(plain.state_dict(), strict=False)
    x, mask, condition = torch.randn(2, 7, 32), torch.ones(2, 7, dtype=torch.bool), torch.randn(2, 1, 32)
    torch.testing.assert_close(block(x, mask, condition), plain(x, mask))
    heard = block_with_adaptive_norm()
    assert (heard(x, mask, condition) - heard(x, mask, condition + 1)).abs().max() > 0.01


def test_adaptive_norm_without_pre_norm_is_refused() -> None:
    with pytest.raises(BadInput, match="norm_first"):
        Encoder(replace(SMALL, norm_first=False, adaptive_norm=True), has_condition=True)


def test_adaptive_norm_without_a_condition_is_refused() -> None:
    with pytest.raises(BadInput, match="adaptive_norm: false"):
        RefinerModel(RefinerConfig(transformer=replace(SMALL, adaptive_norm=True)))


def test_position_codes_follow_the_transformer_paper() -> None:
    """Vaswani et al. 2017, Sec. 3.5, number by number; the agents' codes are distant positions of the same table."""
    codes, width = sinusoid(torch.tensor([0, 7, 1666]), 6), 6
    for index, position in enumerate((0, 7, 1666)):
        angles = [position / 10_000 ** (2 * pair / width) for pair in range(width // 2)]
        expected = [math.sin(angle) for angle in angles] + [math.cos(angle) for angle in angles]
        assert codes[index].tolist() == pytest.approx(expected, abs=1e-4)
    torch.testing.assert_close(agent_codes(6, torch.device("cpu"))[1], codes[2])
    assert (torch.pdist(agent_codes(32, torch.device("cpu"))) > 1).all()


def test_a_token_is_attended_to_if_any_of_its_frames_is_valid() -> None:
    valid_frames = torch.arange(7) < torch.tensor([[0], [1], [4], [7]])
    assert attention_mask_of(valid_frames, 3).tolist() == [
        [False] * 3,
        [True, False, False],
        [True, True, False],
        [True] * 3,
    ]


def test_packing_removes_masked_tokens_without_changing_the_others() -> None:
    torch.manual_seed(0)
    encoder, x = Encoder(SMALL).eval(), torch.randn(3, 20, 32)
    mask = torch.rand(3, 20, generator=torch.Generator().manual_seed(0)) < 0.4
    mask[:, 0] = True
    wide = torch.cat((mask, torch.ones(3, 1, dtype=torch.bool)), 1)
    with torch.no_grad():
        together = encoder(x, mask)
        alone = torch.cat(
            [
                encoder(x[index : index + 1, valid], torch.ones(1, int(valid.sum()), dtype=torch.bool))[0]
                for index, valid in enumerate(mask)
            ]
        )
    torch.testing.assert_close(together[mask], alone, atol=1e-5, rtol=1e-4)
    assert packed(torch.randn(3, 21, 32), wide)[0].shape[1] == int(wide.sum(1).max())


@pytest.mark.parametrize("contact_input", ["map", "tokens"])
def test_text_verb_contact_hands_and_object_change_the_motion(
    batch: ClipBatch, contact_input: Literal["map", "tokens"]
) -> None:
    model, steps = diffusion_model(contact_input=contact_input), torch.full((3,), 300)
    condition = condition_of(batch)
    changes = {
        "text": {"text": condition.text + 1},
        "verb": {"verbs": ["pass", "open", "lift"]},
        "contact": {"contact": ~condition.contact},
        "hands": {"batch": replace(batch, active_hands=torch.ones_like(batch.active_hands))},
        "object": {"batch": replace(batch, points_m=batch.points_m * torch.tensor([1.0, 0.5, 2.0]))},
    }
    with torch.no_grad():
        before = model(batch.hands, batch.object, steps, condition)[1]
        for name, values in changes.items():
            after = model(batch.hands, batch.object, steps, replace(condition, **values))[1]
            assert (before - after)[batch.frames].abs().max() > 1e-4, name


def test_a_verb_that_is_not_in_training_adds_nothing(batch: ClipBatch) -> None:
    model, condition = diffusion_model(), condition_of(batch)
    none, strange = (model.encode_condition(replace(condition, verbs=[verb] * 3)) for verb in (None, "juggle"))
    assert torch.equal(none.token, strange.token)
    lift = model.encode_condition(replace(condition, verbs=["lift"] * 3)).token
    torch.testing.assert_close(lift - none.token, model.verb_in.weight[:, 0].expand(3, 1, -1))


def test_a_refiner_starts_as_the_identity_and_every_parameter_learns(batch: ClipBatch) -> None:
    torch.manual_seed(0)
    model = RefinerModel(RefinerConfig(SMALL, output="residual"))
    coarse = coarse_of(batch)
    torch.testing.assert_close(model(coarse)[batch.present], batch.hands[batch.present], atol=1e-5, rtol=0)
    optimiser = torch.optim.SGD(model.parameters(), lr=0.1)
    for _ in range(2):
        optimiser.zero_grad()
        (model(coarse)[batch.present] - batch.hands[batch.present] - 0.1).square().sum().backward()
        optimiser.step()
    without = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    # A key bias shifts all scores of a query alike, so a softmax gives it no gradient; it lives inside a larger tensor.
    assert without == []


class Constant(RefinerModel):
    """A diffusion refiner that takes all hands for the same, and keeps what it is given to denoise."""

    clean: Tensor
    noised: list[NoisedHands]

    def corrected(self, coarse: CoarseMotion, noised: NoisedHands | None = None) -> Tensor:
        assert noised is not None
        self.noised.append(noised)
        return self.clean.expand_as(noised.hands)


def test_a_diffusion_refiner_denoises_coarse_hands_from_the_middle_of_the_schedule(batch: ClipBatch) -> None:
    model, coarse = Constant(RefinerConfig(SMALL, output="diffusion")), coarse_of(batch)
    model.clean, model.noised = batch.hands[0, 0, 0], []
    noise = noise_like(coarse, 0)
    refined = refine(model, coarse, lambda: noise)
    assert [int(noised.steps[0]) for noised in model.noised] == list(range(499, 0, -25))
    angle, start = (500 / 1000 + 0.008) / 1.008 * math.pi / 2, 0.008 / 1.008 * math.pi / 2
    signal = math.cos(angle) / math.cos(start)
    expected = signal * coarse.hands + math.sqrt(1 - signal**2) * noise
    torch.testing.assert_close(model.noised[0].hands, expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(refined[batch.present], model.clean.expand_as(refined)[batch.present], atol=1e-5, rtol=0)


def test_a_diffusion_refiner_reads_coarse_and_noised_hands_and_their_timestep(batch: ClipBatch) -> None:
    torch.manual_seed(0)
    model, coarse = RefinerModel(RefinerConfig(SMALL, output="diffusion")).eval(), coarse_of(batch)
    steps, other = torch.full((len(batch),), 10), replace(coarse, joints_m=coarse.joints_m + 0.1)
    noised = NoisedHands(coarse.hands, steps)
    moved, later = replace(noised, hands=coarse.hands + 0.1), replace(noised, steps=steps * 9)
    first, *others = (
        model(*inputs)[batch.present]
        for inputs in ((coarse, noised), (coarse, moved), (coarse, later), (other, noised))
    )
    assert not any(torch.allclose(first, hands) for hands in others)


@pytest.mark.parametrize("output", ["hands", "residual", "diffusion"])
def test_refined_hands_do_not_depend_on_padding_or_absent_hands(
    batch: ClipBatch, output: Literal["hands", "residual", "diffusion"]
) -> None:
    torch.manual_seed(0)
    model = RefinerModel(RefinerConfig(SMALL, output=output)).eval()
    torch.nn.init.normal_(model.hands_out[0].weight, std=0.1)
    torch.nn.init.normal_(model.hands_out[1].weight, std=0.1)
    coarse = coarse_of(batch)
    noise = noise_like(coarse, 0)
    other = replace(coarse, hands=torch.where(coarse.present[..., None], coarse.hands, noise))
    noised = [NoisedHands(part.hands, torch.full((len(batch),), 10)) for part in (coarse, other)]
    inputs = zip((coarse, other), noised if output == "diffusion" else (None, None), strict=True)
    with torch.no_grad():
        first, second = (model(*pair)[batch.present] for pair in inputs)
    assert torch.equal(first, second)


def noise_like(coarse: CoarseMotion, seed: int) -> Tensor:
    return torch.randn(coarse.hands.shape, generator=torch.Generator().manual_seed(seed))


def test_the_length_model_overfits_two_clips_and_keeps_its_variance(batch: ClipBatch) -> None:
    torch.manual_seed(0)
    two, verbs = collate(list(batch.samples[:2])), ["lift", "pass"]
    model = LengthModel(LengthConfig(width=64, sampled_from="gaussian", verbs=VERBS))
    lengths, inputs = torch.tensor([40, 120]), (two.text[:, 0], verbs, torch.zeros(2, 1))
    optimiser = torch.optim.Adam(model.parameters(), lr=5e-3)
    for _ in range(150):
        optimiser.zero_grad()
        length_loss(*model.moments(*inputs), lengths)["total"].backward()
        optimiser.step()
    torch.testing.assert_close(model.expected_frames(two.text[:, 0], verbs), lengths.float(), atol=2.0, rtol=0)
    samples = model.sample(two.text[:1, 0].expand(200, -1), ["lift"] * 200, torch.Generator().manual_seed(0))
    assert samples.float().std() > 0.5
    assert samples.min() >= 8
    other = model.expected_frames(two.text[:1, 0], ["pass"])
    assert abs(float(other - model.expected_frames(two.text[:1, 0], ["lift"]))) > 1
