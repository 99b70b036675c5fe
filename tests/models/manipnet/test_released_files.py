"""The release's weight files: 20 written and read back, four absent ones named, one network in both layouts."""

import os
from pathlib import Path

import numpy as np
import pytest

from hoidata.errors import BadInput
from models.manipnet.features import Relabelled
from models.manipnet.released_files import (
    ABSENT_IDS,
    SHAPES,
    content_id,
    in_our_layout,
    in_released_layout,
    read_released,
    read_whole,
    write_released,
)

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
    for block in (0, 2):
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
