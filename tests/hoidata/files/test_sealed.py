"""A sealed safetensors file: any changed bit is found, and said of the weights or the header."""

import json

import numpy as np
import pytest
from safetensors.numpy import load, save

from hoidata.errors import BadInput
from hoidata.files.atomic import canonical_json, sha256_bytes
from hoidata.files.sealed import OPEN_SEAL, check_seal, payload_digest, read_metadata, seal_fault, sealed

TENSORS = {"weight": np.arange(3, dtype=np.float32)}


def stored(tmp_path, **info):
    path = tmp_path / "model.safetensors"
    path.write_bytes(sealed(save(TENSORS, {"hoidata": canonical_json({"model": "toy", **info})})))
    return path


def test_a_sealed_file_is_whole_and_reads_as_any_safetensors_file(tmp_path):
    path = stored(tmp_path, seal=OPEN_SEAL)
    assert seal_fault(path) is None
    check_seal(path)
    assert load(path.read_bytes())["weight"].tolist() == [0, 1, 2]
    assert (
        read_metadata(path)["seal"]["payload_sha256"] == payload_digest(path) == sha256_bytes(path.read_bytes()[-12:])
    )


def test_a_flipped_bit_of_any_byte_is_found_and_told_of_the_half_it_is_in(tmp_path):
    path = stored(tmp_path, seal=OPEN_SEAL)
    whole = path.read_bytes()
    start = 8 + int.from_bytes(whole[:8], "little")
    for number in range(len(whole)):
        damaged = bytearray(whole)
        damaged[number] ^= 1 << number % 8
        path.write_bytes(damaged)
        try:
            fault = seal_fault(path)
        except BadInput:
            fault = "header"  # no longer the header of a checkpoint
        # A flipped digest of the weights accuses the weights: which of the two was hit cannot be told.
        assert fault == "weights" if number >= start else fault in ("header", "weights"), number


def test_a_file_written_before_there_were_seals_is_not_accused(tmp_path):
    assert seal_fault(stored(tmp_path)) is None


def test_a_broken_seal_is_refused_with_the_half_that_was_changed(tmp_path):
    path = stored(tmp_path, seal=OPEN_SEAL)
    path.write_bytes(path.read_bytes()[:-1] + b"\xff")
    with pytest.raises(BadInput, match="expected the weights it was written with"):
        check_seal(path)


def test_metadata_that_is_no_object_is_refused(tmp_path):
    path = tmp_path / "model.safetensors"
    path.write_bytes(save(TENSORS, {"hoidata": json.dumps([1])}))
    with pytest.raises(BadInput, match="provenance"):
        read_metadata(path)
