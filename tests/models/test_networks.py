"""What the networks promise: masks shut things out, everything learns, the sampler does what its equations say."""

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
from hoidata.store.annotated import AnnotatedStore
from models.common.features import Hands, Normaliser
from models.common.point_net import PointNetConfig
from models.common.sampling import add_noise, alphas_cumprod
from models.common.transformer import (
    Block,
    Encoder,
    TransformerConfig,
    agent_codes,
    attention_mask_of,
    packed,
    sinusoid,
)
from models.text2hoi.diffusion import SAME_OBJECT, Condition, DiffusionConfig, DiffusionModel
from models.text2hoi.diffusion_training import DiffusionObjective
from models.text2hoi.length import LengthConfig, LengthModel, length_loss
from models.text2hoi.motion_code import MotionCodeConfig
from models.text2hoi.refiner import CoarseMotion, RefinerConfig, RefinerModel, Surface

SMALL = TransformerConfig(
    width=32, layers=2, heads=2, feed_forward=64, dropout=0.0, norm_first=True, frames_per_token=2
)
POINT_NET = PointNetConfig(widths=(16, 32, 64), heads=(32, 16))


def diffusion_model(**changes) -> DiffusionModel:
    torch.manual_seed(0)
    config = DiffusionConfig(SMALL, POINT_NET, contact_input="tokens", frames_to_go=True, told=True)
    return DiffusionModel(replace(config, **changes)).eval()


def condition_of(batch: ClipBatch, model: DiffusionModel) -> Condition:
    return Condition.of(batch, model.object_feature(batch.points_m), batch.text[:, 0], batch.contact)


def coarse_of(batch: ClipBatch) -> CoarseMotion:
    surface = Surface.of(Hands(load_embedded_hands()), batch.objects, 24, torch.device("cpu"))
    return surface.coarse(batch, batch.hands, batch.object, batch.contact_map, batch.present)


SWITCHES = {
    "paper": {},
    "tokens of frames": {"transformer": replace(SMALL, frames_per_token=5)},
    "splines": {"motion": MotionCodeConfig(knot_frames=4, object_knots=2)},
    "object frame": {"motion": MotionCodeConfig(hand_frame="object")},
    "place of the middle": {"motion": MotionCodeConfig(hand_frame="object", object_place="box")},
    "turns since the start": {"motion": MotionCodeConfig(object_turn="since start")},
    "whitened": {"motion": MotionCodeConfig(knot_frames=4, whitening_frames=8)},
    "contact tokens": {"contact_input": "tokens"},
    "verbs": {"text_input": "verbs", "verbs": 5},
    "condition everywhere": {"condition_everywhere": True},
    "frames to go": {"frames_to_go": True},
    "signal scale": {"signal_scale": 0.2},
    "object's size not told": {"scale_input": False},
    "gate": {"input_gate": True},
    "modulated": {"transformer": replace(SMALL, modulated=True)},
    "told": {"told": True},
}


def rows_of(batch: ClipBatch, model: DiffusionModel) -> tuple[Tensor, Tensor]:
    coded = [model.code.encode(sample) for sample in batch.samples]
    hands = pad_sequence([own.hands.transpose(0, 1) for own in coded], batch_first=True).transpose(1, 2)
    return hands, pad_sequence([own.object for own in coded], batch_first=True)


@pytest.mark.parametrize("switch", SWITCHES)
def test_padding_and_absent_hands_change_no_output(batch: ClipBatch, switch: str) -> None:
    torch.manual_seed(0)
    model = DiffusionModel(replace(DiffusionConfig(SMALL, POINT_NET), **SWITCHES[switch])).eval()
    condition, steps = condition_of(batch, model), torch.tensor([10, 500, 900])
    hands, objects = rows_of(batch, model)
    there, moving = model.code.rows(batch.counts, torch.device("cpu"))
    with torch.no_grad():
        before = model(hands, objects, steps, condition)
        hands[~batch.active_hands] = 100.0
        hands.transpose(1, 2)[~there] = -50.0
        objects[~moving] = 50.0
        idle = condition.contact | ~condition.active_hands[..., None]
        after = model(hands, objects, steps, replace(condition, contact=idle))
    present = there[:, None] & batch.active_hands[..., None]
    assert torch.equal(before[0][present], after[0][present])
    assert torch.equal(before[1][moving], after[1][moving])


def test_each_switch_changes_its_part_of_the_weights_only() -> None:
    """Names of weights that are new, gone or of another shape when one switch is on."""
    known = shapes(DiffusionConfig(SMALL, POINT_NET))
    parts = {
        "paper": set(),
        "tokens of frames": {"hands_in", "object_in", "hands_out", "object_out"},
        "splines": {"object_in", "object_out"},
        "object frame": set(),
        "place of the middle": set(),
        "turns since the start": {"object_in", "object_out"},
        "whitened": set(),
        "contact tokens": {"object_condition_in", "points_in"},
        "verbs": {"text_in"},
        "condition everywhere": set(),
        "frames to go": {"to_go_in"},
        "signal scale": set(),
        "object's size not told": {"object_condition_in"},
        "gate": {"gate_in"},
        "modulated": {"encoder"},
        "told": {"extent_in"},
    }
    for switch, changes in SWITCHES.items():
        found = shapes(replace(DiffusionConfig(SMALL, POINT_NET), **changes))
        unlike = {name for name in known | found if known.get(name) != found.get(name)}
        assert {name.split(".")[0] for name in unlike} == parts[switch], switch


def shapes(config: DiffusionConfig) -> dict[str, tuple[int, ...]]:
    return {name: tuple(weight.shape) for name, weight in DiffusionModel(config).named_parameters()}


def modulated_block() -> Block:
    torch.manual_seed(0)
    block = Block(replace(SMALL, modulated=True)).eval()
    for weight in block.modulations.parameters():
        nn.init.normal_(weight, std=0.3)
    return block


def test_a_modulated_block_is_adaptive_layer_norm() -> None:
    """Peebles and Xie 2023, by hand: each half reads scale * norm(x) + shift, and what it adds is scaled."""
    block, x, condition = modulated_block(), torch.randn(2, 7, 32), torch.randn(2, 1, 32)
    mask, found = torch.ones(2, 7, dtype=torch.bool), x
    halves = [(block.norm_attention, lambda y: block.attend(y, mask)), (block.norm_feed_forward, block.feed_forward)]
    for (norm, half), modulation in zip(halves, block.modulations, strict=True):
        _, narrow, _, last = modulation.layers
        said = nn.functional.silu(nn.functional.silu(condition) @ narrow.weight.T + narrow.bias) @ last.weight.T
        scale, shift, share = (said + last.bias).split(32, -1)
        read = norm(found) * (1 + scale) + shift
        found = found + (1 + share) * half(read)
    torch.testing.assert_close(block(x, mask, condition), found)


def test_modulation_starts_as_none_and_then_hears_the_condition() -> None:
    torch.manual_seed(0)
    plain, block = Block(SMALL).eval(), Block(replace(SMALL, modulated=True))
    block.eval().load_state_dict(plain.state_dict(), strict=False)
    x, mask, condition = torch.randn(2, 7, 32), torch.ones(2, 7, dtype=torch.bool), torch.randn(2, 1, 32)
    torch.testing.assert_close(block(x, mask, condition), plain(x, mask))
    heard = modulated_block()
    assert (heard(x, mask, condition) - heard(x, mask, condition + 1)).abs().max() > 0.01


def test_modulation_behind_a_norm_is_refused() -> None:
    with pytest.raises(BadInput, match="norm_first"):
        Encoder(replace(SMALL, norm_first=False, modulated=True), has_condition=True)


def test_modulation_without_a_condition_is_refused_when_the_network_is_built() -> None:
    with pytest.raises(BadInput, match="modulated: false"):
        RefinerModel(RefinerConfig(transformer=replace(SMALL, modulated=True)))


def test_the_gate_lets_in_what_the_timestep_says(batch: ClipBatch) -> None:
    """Shut for every step, noised rows change nothing; open, they do."""
    model = diffusion_model(input_gate=True)
    condition, steps = condition_of(batch, model), torch.tensor([10, 500, 900])
    hands, objects = rows_of(batch, model)
    assert model.gate_in is not None
    nn.init.zeros_(model.gate_in.weight)
    found = []
    for open_by in (0.0, -1.0):
        nn.init.constant_(model.gate_in.bias, open_by)
        with torch.no_grad():
            pair = [model(hands, moved, steps, condition)[1] for moved in (objects, objects + 1)]
        found.append(float((pair[0] - pair[1]).abs().max()))
    assert found[0] > 1e-3
    assert found[1] == 0


def test_what_is_told_of_an_object_changes_the_motion(batch: ClipBatch) -> None:
    model = diffusion_model()
    hands, objects = rows_of(batch, model)
    steps, told = torch.tensor([10, 500, 900]), condition_of(batch, model)

    def moved_by(other: Condition) -> float:
        with torch.no_grad():
            return float((model(hands, objects, steps, told)[1] - model(hands, objects, steps, other)[1]).abs().max())

    assert moved_by(replace(told, object=told.object + 1)) > 1e-3
    assert moved_by(replace(told, points_m=told.points_m + 0.05)) > 1e-4


def test_a_summary_is_told_of_no_object_but_those_in_training(batch: ClipBatch) -> None:
    """Told of one that was never seen, it would say the name of some other object."""
    model = diffusion_model(object_dropout=0.5, objects=1, scale_input=False, contact_input="tokens")
    hands, objects = rows_of(batch, model)
    steps, told = torch.tensor([10, 500, 900]), condition_of(batch, model)

    def answers(known: torch.Tensor, condition: Condition) -> torch.Tensor:
        model.learn_objects(known)
        with torch.no_grad():
            return model(hands, objects, steps, condition)[1]

    there, elsewhere = told.object[:1], told.object[:1] + 1
    seen = (told.object - there).norm(dim=-1) < 1e-3 * there.norm()
    moved = (answers(there, told) - answers(elsewhere, told)).abs().amax((1, 2))
    assert (moved > 1e-4).equal(seen)
    untold = replace(told, object=told.object * 3)
    assert answers(elsewhere, untold).equal(answers(elsewhere, told))


def test_a_summary_that_is_left_out_of_a_step_changes_nothing_and_touched_points_still_do(batch: ClipBatch) -> None:
    model = diffusion_model(contact_input="tokens", scale_input=False)
    hands, objects = rows_of(batch, model)
    steps, told = torch.tensor([10, 500, 900]), condition_of(batch, model)

    def answers(condition: Condition, keep: list[float]) -> torch.Tensor:
        with torch.no_grad():
            return model(hands, objects, steps, condition, torch.tensor([keep]).expand(3, -1))[1]

    other, bare = replace(told, object=told.object + 1), replace(told, contact=torch.zeros_like(told.contact))
    assert answers(other, [1.0, 1.0, 0.0]).equal(answers(told, [1.0, 1.0, 0.0]))
    assert not answers(other, [1.0, 1.0, 1.0]).equal(answers(told, [1.0, 1.0, 1.0]))
    assert not answers(bare, [1.0, 1.0, 0.0]).equal(answers(told, [1.0, 1.0, 0.0]))


@pytest.mark.parametrize(("share", "least", "most"), [(0.0, 0.85, 0.95), (0.5, 0.4, 0.5), (1.0, 0.0, 0.0)])
def test_an_objects_summary_is_left_out_in_a_share_of_the_steps(
    annotated: AnnotatedStore, share: float, least: float, most: float
) -> None:
    model = diffusion_model(object_dropout=share, condition_dropout=0.1, scale_input=False)
    objective = DiffusionObjective.__new__(DiffusionObjective)
    objective.network = model
    kept = objective.kept(4000, torch.Generator().manual_seed(0)).float()
    assert kept[:, 0].mean() == pytest.approx(0.9, abs=0.02)
    assert kept[:, 1].mean() == pytest.approx(0.9, abs=0.02)
    assert least <= kept[:, 2].mean() <= most
    assert not (kept[:, 2] > kept[:, 1]).any()  # who is told of no touched points is told of no object


def test_positions_are_told_by_sines_from_one_a_frame_down_to_a_ten_thousandth() -> None:
    """Vaswani et al. 2017, Sec. 3.5, number by number; the agents' codes are rows far apart of the same table."""
    found, width = sinusoid(torch.tensor([0, 7, 1666]), 6), 6
    for row, position in enumerate((0, 7, 1666)):
        angles = [position / 10_000 ** (2 * pair / width) for pair in range(width // 2)]
        expected = [math.sin(angle) for angle in angles] + [math.cos(angle) for angle in angles]
        assert found[row].tolist() == pytest.approx(expected, abs=1e-4)
    torch.testing.assert_close(agent_codes(6, torch.device("cpu"))[1], found[2])
    assert (torch.pdist(agent_codes(32, torch.device("cpu"))) > 1).all()


def test_a_token_is_attended_to_if_any_of_its_frames_is_there() -> None:
    there = torch.arange(7) < torch.tensor([[0], [1], [4], [7]])
    assert attention_mask_of(there, 3).tolist() == [[False] * 3, [True, False, False], [True, True, False], [True] * 3]


def test_normalised_rows_have_no_mean_and_come_back(batch: ClipBatch) -> None:
    own = Normaliser.of(list(zip(batch.hands, batch.object, batch.present, strict=True)))
    hands, objects = own.encode(batch.hands, batch.object)
    assert float(hands.transpose(0, 1)[batch.present.transpose(0, 1)].mean(0).abs().max()) < 1e-3
    for found, given in zip(own.decode(hands, objects), (batch.hands, batch.object), strict=True):
        torch.testing.assert_close(found, given, atol=1e-5, rtol=1e-4)


def test_tokens_nobody_attends_to_change_nothing_when_they_are_left_out() -> None:
    torch.manual_seed(0)
    encoder, x = Encoder(SMALL).eval(), torch.randn(3, 20, 32)
    mask = torch.rand(3, 20, generator=torch.Generator().manual_seed(0)) < 0.4
    mask[:, 0] = True
    wide = torch.cat((mask, torch.ones(3, 1, dtype=torch.bool)), 1)
    with torch.no_grad():
        found = encoder(x, mask)
        one_at_a_time = torch.cat(
            [
                encoder(x[row : row + 1, own], torch.ones(1, int(own.sum()), dtype=torch.bool))[0]
                for row, own in enumerate(mask)
            ]
        )
    torch.testing.assert_close(found[mask], one_at_a_time, atol=1e-5, rtol=1e-4)
    assert packed(torch.randn(3, 21, 32), wide)[0].shape[1] == int(wide.sum(1).max())


def test_a_clip_gives_the_same_alone_as_padded_in_a_batch(annotated: AnnotatedStore, batch: ClipBatch) -> None:
    model = diffusion_model()
    alone = collate([batch.samples[0]])
    with torch.no_grad():
        many = model(batch.hands, batch.object, torch.full((3,), 300), condition_of(batch, model))
        one = model(alone.hands, alone.object, torch.full((1,), 300), condition_of(alone, model))
    length, side = batch.samples[0].length, int(batch.active_hands[0].float().argmax())
    torch.testing.assert_close(many[0][0, side, :length], one[0][0, side], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(many[1][0, :length], one[1][0], atol=1e-5, rtol=1e-4)


def test_hand_flags_length_text_and_contact_are_seen(batch: ClipBatch) -> None:
    model, steps = diffusion_model(), torch.full((3,), 300)
    condition = condition_of(batch, model)
    changes = {
        "text": condition.text + 1,
        "contact": ~condition.contact,
        "active_hands": torch.ones_like(condition.active_hands),
    }
    with torch.no_grad():
        before = model(batch.hands, batch.object, steps, condition)[1]
        for name, value in changes.items():
            after = model(batch.hands, batch.object, steps, replace(condition, **{name: value}))[1]
            assert (before - after)[batch.frames].abs().max() > 1e-4, name


def test_the_raw_contact_map_of_the_paper_is_an_option(batch: ClipBatch) -> None:
    model = diffusion_model(contact_input="map", frames_to_go=False)
    hands, objects = model(batch.hands, batch.object, torch.zeros(3, dtype=torch.long), condition_of(batch, model))
    assert hands.shape == batch.hands.shape
    assert objects.shape == batch.object.shape


def test_a_refiner_starts_as_the_identity_and_every_parameter_learns(batch: ClipBatch) -> None:
    torch.manual_seed(0)
    model = RefinerModel(RefinerConfig(SMALL, view="object", surface_input=True, output="residual"))
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


@pytest.mark.parametrize("view", ["world", "object"])
def test_refined_hands_do_not_depend_on_padding_or_absent_hands(
    batch: ClipBatch, view: Literal["world", "object"]
) -> None:
    torch.manual_seed(0)
    model = RefinerModel(RefinerConfig(SMALL, view=view)).eval()
    torch.nn.init.normal_(model.hands_out[0].weight, std=0.1)
    torch.nn.init.normal_(model.hands_out[1].weight, std=0.1)
    coarse = coarse_of(batch)
    noise = noise_like(coarse, 0)
    other = replace(coarse, hands=torch.where(coarse.present[..., None], coarse.hands, noise))
    with torch.no_grad():
        assert torch.equal(model(coarse)[batch.present], model(other)[batch.present])


def test_an_object_is_known_up_to_a_hundredth_however_many_there_are() -> None:
    """Distances by a matrix product, as of more than 25 rows by default, would be off by more than that."""
    model = diffusion_model(object_dropout=0.5, objects=60, scale_input=False)
    drawn = torch.Generator().manual_seed(0)
    known, away = (torch.randn(60, POINT_NET.widths[-1], generator=drawn) for _ in range(2))
    model.learn_objects(known)
    step = away / away.norm(dim=-1, keepdim=True) * SAME_OBJECT * known.norm(dim=-1).mean()
    assert bool((model._known(known + 0.9999 * step) == 1).all())
    assert bool((model._known(known + 1.0001 * step) == 0).all())


@pytest.mark.parametrize("other", [{"contact_input": "map"}, {"scale_input": True}])
def test_what_object_dropout_would_hide_as_well_is_refused(other: dict) -> None:
    with pytest.raises(BadInput, match="object_dropout: 0"):
        diffusion_model(**{"object_dropout": 0.5, "scale_input": False, **other})


def noise_like(coarse: CoarseMotion, seed: int) -> Tensor:
    return torch.randn(coarse.hands.shape, generator=torch.Generator().manual_seed(seed))


def test_noise_is_mixed_as_in_the_papers_first_equation() -> None:
    signal = torch.tensor([0.81, 0.36])
    noised = add_noise(torch.ones(2, 3), torch.full((2, 3), 2.0), torch.tensor([0, 1]), signal)
    torch.testing.assert_close(noised[:, 0], torch.tensor([0.9 + 2 * 0.19**0.5, 0.6 + 2 * 0.8]))


def fitted(parameters, loss, steps: int = 150, rate: float = 3e-3) -> float:
    optimiser = torch.optim.Adam(parameters, lr=rate)
    found = torch.zeros(())
    for _ in range(steps):
        optimiser.zero_grad()
        found = loss()
        found.backward()
        optimiser.step()
    return float(found.detach())


def two_clips(batch: ClipBatch) -> ClipBatch:
    return collate(list(batch.samples[:2]))


def test_the_length_model_overfits_two_clips_and_keeps_its_noise(batch: ClipBatch) -> None:
    torch.manual_seed(0)
    two = two_clips(batch)
    model = LengthModel(LengthConfig(width=64, drawn_by="spread", told=True))
    lengths, given = torch.tensor([40, 120]), (two.text[:, 0], two.active_hands, torch.zeros(2, 1))
    fitted(model.parameters(), lambda: length_loss(*model.moments(*given), lengths)["total"], rate=5e-3)
    torch.testing.assert_close(
        model.expected_frames(two.text[:, 0], two.active_hands), lengths.float(), atol=2.0, rtol=0
    )
    drawn = model.sample(
        two.text[:1, 0].expand(200, -1), two.active_hands[:1].expand(200, -1), torch.Generator().manual_seed(0)
    )
    assert drawn.float().std() > 0.5
    assert drawn.min() >= 8


@pytest.mark.slow
def test_the_generator_overfits_two_clips(batch: ClipBatch) -> None:
    two = two_clips(batch)
    model = diffusion_model().train()
    normaliser = Normaliser.of(list(zip(two.hands, two.object, two.present, strict=True)))
    hands, objects = normaliser.encode(two.hands, two.object)
    signal, generator = alphas_cumprod(), torch.Generator().manual_seed(0)
    condition = condition_of(two, model)

    def loss() -> Tensor:
        steps = torch.randint(1000, (2,), generator=generator)
        noised = [add_noise(x, torch.randn(x.shape, generator=generator), steps, signal) for x in (hands, objects)]
        clean = model(noised[0], noised[1], steps, condition)
        return (clean[0] - hands)[two.present].square().mean() + (clean[1] - objects)[two.frames].square().mean()

    first = float(loss().detach())
    assert fitted(model.parameters(), loss, 200) < 0.1 * first
