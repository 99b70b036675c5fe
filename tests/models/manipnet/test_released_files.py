"""The release's weight files: 20 written and read back, four absent ones named, one network in both layouts."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hoidata.clips.clip import SIDES
from hoidata.datasets.manipnet.adapter import read_hand_recording
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.surface_index import surface_index
from hoidata.sensors.mano_hand import mano_hand
from models.common.training import TrainingConfig
from models.manipnet.control import recording_control
from models.manipnet.examples import Examples, fit_examples, hand_examples, prepared
from models.manipnet.features import FeatureSettings, Relabelled, released_inputs, released_outputs
from models.manipnet.network import ManipNet, NetworkConfig
from models.manipnet.released_files import (
    ABSENT_IDS,
    SHAPES,
    arrays_of,
    content_id,
    in_our_layout,
    in_released_layout,
    network_of,
    read_released,
    read_whole,
    shapes_of,
    write_released,
)
from tests.builders.manipnet import KEY, POSE, lift_rows, write_skin, write_tree

ROOT = os.environ.get("HOIDATA_MANIPNET", "")


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    made = {name: random.normal(0, 0.05, shape).astype(np.float32) for name, shape in SHAPES.items()}
    return made | {name: np.abs(made[name]) + 0.5 for name in ("Xstd", "Ystd")}


def predicted(arrays: dict[str, np.ndarray], inputs: np.ndarray) -> np.ndarray:
    """The network's formula in float64, from the paper: y = D g + d after two blocks."""
    known = {name: array.astype(np.float64) for name, array in arrays.items()}
    z = np.split((inputs - known["Xmean"]) / known["Xstd"], [192, 192 + 336])
    a = np.concatenate([known[f"Encoder{i}_w0"] @ part + known[f"Encoder{i}_b0"] for i, part in enumerate(z)])
    for block in range(0, sum(name.startswith("DenseRes") for name in known) // 2, 2):
        a = np.maximum(a, 0)
        r = np.maximum(known[f"DenseRes{block}_w0"] @ a + known[f"DenseRes{block}_b0"] + a, 0)
        a = known[f"DenseRes{block + 1}_w0"] @ r + known[f"DenseRes{block + 1}_b0"] + r + a
    return (known["Decoder_w0"] @ a + known["Decoder_b0"]) * known["Ystd"] + known["Ymean"]


def test_twenty_files_are_read_back_bit_for_bit_and_have_the_sizes_of_the_release(arrays, tmp_path):
    write_released(tmp_path / "weights", arrays)
    assert len(list((tmp_path / "weights").iterdir())) == 20
    assert (tmp_path / "weights/DenseRes0_w0.bin").stat().st_size == 9_437_184
    found = read_whole(tmp_path / "weights")
    assert all(np.array_equal(found[name], arrays[name]) for name in SHAPES)


def test_a_network_in_the_released_layout_says_the_same_and_comes_back(arrays):
    random = np.random.default_rng(1)
    order = np.arange(2350)
    order[528:1528] = 528 + random.permutation(1000)
    inputs = Relabelled(order, random.choice([-10.0, -1.0, 1.0, 10.0], 2350))
    outputs = Relabelled(np.arange(214), random.choice([-10.0, 1.0], 214))
    asked = random.normal(size=2350)
    folded = in_released_layout(arrays, inputs, outputs)
    np.testing.assert_allclose(
        predicted(folded, inputs(asked)), outputs(predicted(arrays, asked)), rtol=1e-5, atol=1e-5
    )
    back = in_our_layout(folded, inputs, outputs)
    np.testing.assert_allclose(predicted(back, asked), predicted(arrays, asked), rtol=1e-5, atol=1e-5)


SETTINGS = FeatureSettings(step_s=1 / 60)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> tuple[TrackedHand, list[Examples]]:
    """ManipNet's right hand of 17 joints, and steps of both hands of a recording in its files' form."""
    folder = tmp_path_factory.mktemp("recorded")
    left, right, thing = lift_rows(300)
    for row, (own, other) in enumerate(zip(left, right, strict=True)):
        for hand in (own, other):  # fingers and wrists that move
            hand[3:] = [angle * np.sin(row / 40 + number) for number, angle in enumerate(POSE[3:])]
    raw = write_tree(folder, left, right, thing)
    write_skin(folder)
    recording = read_hand_recording(raw, KEY)
    control, surface = recording_control(recording), surface_index(recording.object.model)
    frames, usable, made = slice(0, 300, 2), np.ones(150, bool), []
    for side in SIDES:
        given = recording.finger_rotmats(side, frames), recording.time_s[frames], usable
        made.append(hand_examples(control, side, recording.tracked_hand(side), *given, surface, SETTINGS))
    return recording.hand, made


def trained(recorded: tuple[TrackedHand, list[Examples]], config: NetworkConfig) -> ManipNet:
    torch.manual_seed(0)
    network = prepared(replace(config, features=SETTINGS), *recorded)
    fit_examples(network, recorded[1], TrainingConfig(20, 32, 1e-3, 0.0), 0)
    return network


def answers(network: ManipNet, examples: list[Examples]) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (row, 2350) of both hands and what the network says of them (row, 214)."""
    rows = np.concatenate([one.inputs for one in examples])
    with torch.no_grad():
        return rows, network(torch.from_numpy(rows)).numpy()


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        NetworkConfig(),
        NetworkConfig(encoder=16, blocks=3),
        NetworkConfig(encoder=16, without=("ambient",)),
        NetworkConfig(encoder=16, without=("long-future",)),
    ],
    ids=["full size", "three blocks", "no ambient", "short trajectory"],
)
def test_a_network_of_17_joints_is_written_as_the_releases_files_and_read_back_says_the_same(
    recorded, config, tmp_path
):
    network, hand = trained(recorded, config), recorded[0]
    config, shapes = network.config, shapes_of(network.config)
    assert (shapes == SHAPES) == (config.encoder == 512)
    write_released(tmp_path / "weights", arrays_of(network, hand), shapes)
    found = read_whole(tmp_path / "weights", shapes)
    assert len(list((tmp_path / "weights").iterdir())) == len(found) == 16 + 4 * config.blocks - 4
    rows, expected = answers(network, recorded[1])
    again = network_of(found, config, hand)
    assert torch.equal(again.kept, network.kept)
    np.testing.assert_allclose(answers(again, recorded[1])[1], expected, rtol=0, atol=1e-5)
    # And as somebody else's code runs them: decimetres and the release's axes in and out, the paper's formula.
    inputs, outputs = released_inputs(hand, config.features), released_outputs(hand)
    for row in range(0, len(rows), 30):
        told = predicted(found, inputs(rows[row].astype(np.float64)))
        np.testing.assert_allclose(outputs.back(told), expected[row], rtol=0, atol=1e-5)


def test_columns_in_another_order_say_something_else(recorded):
    network = trained(recorded, NetworkConfig(encoder=16))
    arrays, (_, expected) = arrays_of(network, recorded[0]), answers(network, recorded[1])
    for name in ("Encoder0_w0", "Encoder1_w0", "Encoder2_w0", "DenseRes0_w0", "DenseRes3_w0", "Decoder_w0"):
        changed = arrays | {name: np.roll(arrays[name], 1, axis=1)}
        said = answers(network_of(changed, network.config, recorded[0]), recorded[1])[1]
        assert np.abs(said - expected).max() > 1e-3, name


def test_a_network_of_another_hand_or_formula_is_refused(recorded):
    network = trained(recorded, NetworkConfig(encoder=16))
    with pytest.raises(BadInput, match="those of the mano hand"):
        arrays_of(network, mano_hand(load_embedded_hands(), "right"))
    with pytest.raises(BadInput, match="kind manipnet"):
        network_of(arrays_of(network, recorded[0]), replace(network.config, kind="resnet"), recorded[0])


def test_files_of_other_sizes_are_refused_by_a_reader_that_was_not_told(recorded, tmp_path):
    network = trained(recorded, NetworkConfig(encoder=16))
    write_released(tmp_path / "weights", arrays_of(network, recorded[0]), shapes_of(network.config))
    with pytest.raises(BadInput, match=r"Encoder0_w0\.bin"):
        read_whole(tmp_path / "weights")


@pytest.mark.parametrize("data", [b"\0" * 100, b"\0" * (4 * 2350 + 4), np.full(2350, np.nan, "<f4").tobytes()])
def test_a_file_of_a_wrong_size_or_with_nan_is_refused_by_name(tmp_path, data):
    (tmp_path / "Xmean.bin").write_bytes(data)
    with pytest.raises(BadInput, match=r"Xmean\.bin"):
        read_released(tmp_path)


def test_a_missing_array_is_not_written_and_an_empty_folder_is_refused(arrays, tmp_path):
    with pytest.raises(BadInput, match="Decoder_b0"):
        write_released(tmp_path / "weights", {name: arrays[name] for name in SHAPES if name != "Decoder_b0"})
    assert not (tmp_path / "weights").exists()
    with pytest.raises(BadInput, match="none of them"):
        read_released(tmp_path)


def test_the_content_id_is_that_of_git(tmp_path):
    (tmp_path / "hello").write_bytes(b"hello\n")
    assert content_id(tmp_path / "hello") == "ce013625030ba8dba906f756967f9e9ca394464a"


@pytest.mark.skipif(not ROOT, reason="HOIDATA_MANIPNET is not set: the weights are not part of this repository")
def test_the_public_files_lack_the_four_matrices_of_the_blocks_which_are_named_with_size_and_content_id():
    found = read_released(Path(ROOT) / "weights")
    assert (len(found.arrays), len(found.absent)) == (16, 4)
    for sentence, (name, known) in zip(found.absent, ABSENT_IDS.items(), strict=True):
        assert sentence == f"{name}.bin (9,437,184 bytes, git content id {known})"
    with pytest.raises(BadInput, match="DenseRes3_w0"):
        read_whole(Path(ROOT) / "weights")
