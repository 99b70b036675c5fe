"""ManipNet's network has the paper's layers."""

import numpy as np
import pytest
import torch

from models.manipnet.network import DenseBlock, ManipNet, NetworkConfig
from models.manipnet.training import step_loss

SMALL = NetworkConfig(pose=6, trajectory=5, sensors=7, output=4, encoder=8)


def numpy_block(block: DenseBlock, a: np.ndarray) -> np.ndarray:
    """Sec. 6.2 as printed, for an input after its ReLU."""
    state = {name: value.double().numpy() for name, value in block.state_dict().items()}
    h1 = a @ state["first.weight"].T + state["first.bias"] + a
    r = np.where(h1 > 0, h1, 0)
    return r @ state["second.weight"].T + state["second.bias"] + r + a


def test_full_size_has_the_papers_number_of_parameters() -> None:
    # By hand: 2350 x 512 + 3 x 512, four times 1536 x 1536 + 1536, 214 x 1536 + 214.
    network = ManipNet(NetworkConfig())
    assert sum(parameter.numel() for parameter in network.parameters()) == 10_976_982


def test_the_block_is_the_printed_equation() -> None:
    torch.manual_seed(0)
    block = DenseBlock(12, 0.7).eval()
    torch.nn.init.normal_(block.first.bias)
    a = torch.rand(5, 12)
    assert np.allclose(block(a).detach().numpy(), numpy_block(block, a.double().numpy()), atol=1e-5)


def test_the_network_is_the_printed_one() -> None:
    torch.manual_seed(0)
    network = ManipNet(NetworkConfig(pose=6, trajectory=5, sensors=7, output=4, joints=8)).eval()
    network.learn_normalisation(
        torch.randn(50, 18) * 3 + 1, torch.randn(50, 4) * 2 - 1, (torch.zeros(18), torch.zeros(4))
    )
    inputs = torch.randn(3, 18)
    z = ((inputs - network.input_mean) / network.input_scale).double().numpy()
    state = {name: value.double().numpy() for name, value in network.state_dict().items()}
    pieces = np.split(z, [6, 11], axis=1)
    a = np.concatenate(
        [piece @ state[f"encoders.{i}.weight"].T + state[f"encoders.{i}.bias"] for i, piece in enumerate(pieces)],
        axis=1,
    )
    for block in network.blocks:
        a = numpy_block(block, np.maximum(a, 0))
    y = a @ state["decoder.weight"].T + state["decoder.bias"]
    expected = y * state["output_scale"] + state["output_mean"]
    assert np.allclose(network(inputs).detach().numpy(), expected, atol=1e-5)


def test_dropout_acts_on_the_inputs_of_every_linear_layer() -> None:
    network, zero_fractions = ManipNet(SMALL).train(), []
    for layer in network.modules():
        if isinstance(layer, torch.nn.Linear):
            layer.register_forward_pre_hook(
                lambda layer, inputs: zero_fractions.append((inputs[0] == 0).float().mean())
            )
    network.normalised(torch.randn(4000, 18))
    # Dropout removes 30 % of the encoders' inputs; after a ReLU there are more zeros.
    assert len(zero_fractions) == 8
    assert min(zero_fractions) > 0.28
    assert max(zero_fractions[:3]) < 0.32


def test_an_input_that_hardly_varies_is_scaled_by_the_floor() -> None:
    network = ManipNet(SMALL)
    inputs = torch.randn(100, 18)
    inputs[:, 3] = 0.5 + 1e-4 * inputs[:, 3]
    network.learn_normalisation(inputs, torch.randn(100, 4), (torch.full((18,), 0.05), torch.zeros(4)))
    assert network.input_scale[3] == 0.05
    assert network.input_scale[4] > 0.5


def test_the_loss_is_the_mean_square_of_normalised_errors() -> None:
    torch.manual_seed(0)
    network, inputs, targets = ManipNet(SMALL).eval(), torch.randn(3, 18), torch.randn(3, 4)
    network.learn_normalisation(inputs, 5 * targets + 2, (torch.zeros(18), torch.zeros(4)))
    errors = (network(inputs) - targets).detach().numpy() / network.output_scale.numpy()
    assert step_loss(network, inputs, targets).item() == pytest.approx(np.mean(errors**2), rel=1e-5)
