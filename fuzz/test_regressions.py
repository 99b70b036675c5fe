"""Regression tests of inputs found by fuzzing: each must raise a clear error."""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hoidata.datasets import RawTree
from hoidata.datasets.manipnet import adapter as manipnet
from hoidata.errors import BadInput
from hoidata.files.arrays import read_npz
from hoidata.objects.mesh import load_mesh
from hoidata.store.mapped import map_npz
from hoidata.store.store import open_store
from pipelines.lineage.manifests import read_manifest
from pipelines.stages.adapters import ConvertSettings
from pipelines.stages.base import load_settings, registered_root


def archive(content: bytes, kind: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", kind) as target:
        target.writestr("a.npy", content)
    return stream.getvalue()


def npy(header: str, body: bytes = bytes(32)) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + body


def shaped(shape: str, descr: str = "<f8") -> bytes:
    return npy(f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}}}\n")


def patched(data: bytes, mark: bytes, offset: int, replacement: bytes) -> bytes:
    """Overwrite bytes at an offset from the last mark (PK12: the zip's directory)."""
    position = data.rindex(mark) + offset
    return data[:position] + replacement + data[position + len(replacement) :]


GOOD = archive(shaped("(4,)"))
PACKED = archive(shaped("(4,)") + np.random.default_rng(0).bytes(400), zipfile.ZIP_DEFLATED)
ARCHIVES = {
    "unclosed header (TokenError)": archive(npy("{'descr': '<f8', 'shape': (\n")),
    "empty header (IndexError)": archive(npy("()")),
    "huge shape (MemoryError)": archive(shaped("(1000000000000,)")),
    "huge shape of texts without characters (MemoryError)": archive(shaped("(2147483648, 65535)", "<U0")),
    "endless shape (OverflowError)": archive(shaped("(99999999999999999999,)")),
    "shape of flags (TypeError)": archive(shaped("(None,)")),
    "impossible text (SystemError)": archive(shaped("()", "<U1")[:-32] + b"\xff\xff\xff\x7f"),
    "zip of version 7.5 (NotImplementedError)": patched(GOOD, b"PK\x01\x02", 6, b"\x4b"),
    "encrypted (RuntimeError)": patched(patched(GOOD, b"PK\x01\x02", 8, b"\x01"), b"PK\x03\x04", 6, b"\x01"),
    "strong encryption (NotImplementedError)": patched(GOOD, b"PK\x01\x02", 8, b"\x40"),
    "damaged stream (zlib.error)": patched(PACKED, b"PK\x03\x04", 60, b"\xff" * 30),
}


@pytest.mark.parametrize("kind", ARCHIVES)
@pytest.mark.parametrize("read", [read_npz, map_npz])
def test_damaged_archives_are_bad_input(tmp_path: Path, kind: str, read: Callable) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(ARCHIVES[kind])
    if read is map_npz and kind.startswith(("encrypted", "strong")):
        pytest.skip("a memory map does not read the flags of a member")
    with pytest.raises(BadInput, match=r"a\.npz"):
        read(path)


def test_a_corner_beyond_64_bits_is_bad_input(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999\n")
    with pytest.raises(BadInput, match=r"a\.obj:4"):
        load_mesh(tmp_path / "a.obj")


@pytest.mark.parametrize("number", ["1e308", "-1e200", "1e999"])
def test_coordinates_beyond_all_units_are_bad_input_without_a_warning(tmp_path: Path, number: str) -> None:
    (tmp_path / "a.obj").write_text(f"v {number} 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    rows = f"end_header\n{number} 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    (tmp_path / "a.ply").write_text(head + "element face 1\nproperty list uchar int vertex_index\n" + rows)
    for name in ("a.obj", "a.ply"):
        with pytest.raises(BadInput, match=r"coordinates up to|finite"):
            load_mesh(tmp_path / name)


SIGNALLING_NAN = bytes.fromhex("0100807f")


@pytest.mark.parametrize("column", [0, 9])
def test_a_signalling_nan_in_a_mesh_is_bad_input_without_a_warning(tmp_path: Path, column: int) -> None:
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 3\n" + "".join(f"property float {c}\n" for c in "xyz")
    numbers = [np.float32(number).tobytes() for number in (0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 2)]
    numbers[column] = SIGNALLING_NAN
    rows = b"".join([*numbers[:9], b"\x03", *numbers[9:]])
    head += "element face 1\nproperty list uchar float vertex_index\nend_header\n"
    (tmp_path / "a.ply").write_bytes(head.encode() + rows)
    with pytest.raises(BadInput, match=r"finite|whole number"):
        load_mesh(tmp_path / "a.ply")


def test_a_capsule_end_too_large_for_a_number_is_bad_input(tmp_path: Path) -> None:
    path = tmp_path / manipnet.HAND_REFERENCE
    path.parent.mkdir(parents=True)
    ends = [{"joint": joint, "end_local": [10**400, 0, 0]} for joint in manipnet.TIP_JOINTS]
    path.write_text(json.dumps({"capsules": ends}))
    with pytest.raises(BadInput, match="hand_reference"):
        manipnet._read_tips(RawTree(tmp_path))


@pytest.mark.parametrize("text", ["[" * 100_000, "\udcff", "5", ""])
def test_a_manifest_nested_without_end_or_of_other_bytes_is_bad_input(tmp_path: Path, text: str) -> None:
    (tmp_path / "grab.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(BadInput, match=r"grab\.json"):
        read_manifest(tmp_path / "grab.json")


@pytest.mark.parametrize("model", [5, "x", None, [1], True, 1.5])
def test_a_store_whose_hand_model_is_no_entry_is_bad_input(tmp_path: Path, model: object) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"schema_version": "1.1.0", "hand_model": model}))
    with pytest.raises(BadInput, match="hand_model"):
        open_store(tmp_path)


@pytest.mark.parametrize("text", ["a = ", "[roots]\ngrab = 5\n", "roots = 5\n", "\udcff", "[roots]\ngrab = '\0'\n"])
def test_settings_that_are_no_toml_are_bad_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOIDATA_GRAB", raising=False)
    Path("hoidata.toml").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(BadInput, match=r"hoidata\.toml"):
        registered_root("grab")


@pytest.mark.parametrize(
    "text", ["a: [", "*a", "- 1", "", "\udcff", "!!python/object/apply:os.system ['true']", "a\tb: {"]
)
def test_params_that_are_no_sections_are_bad_input(tmp_path: Path, text: str) -> None:
    (tmp_path / "params.yaml").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(BadInput, match=r"params\.yaml"):
        load_settings(ConvertSettings, "convert", tmp_path / "params.yaml")
