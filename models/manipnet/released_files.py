"""The release's 20 weight files: little-endian float32 without header, matrices (outputs, inputs) row by row.

Four of them, the matrices of the blocks, are in no public copy; their sizes and git content ids are known, so whoever
has them can check. A 17-joint network is written and read as these files, normalisation among them.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hoidata.errors import BadInput
from hoidata.files import atomic_folder
from models.manipnet.features import Relabelled

N_INPUTS, N_OUTPUTS, N_HIDDEN, N_BLOCK = 2350, 214, 512, 1536
ENCODED = (192, 336, 1822)  # pose, trajectory, sensors
SHAPES: dict[str, tuple[int, ...]] = {
    "Xmean": (N_INPUTS,),
    "Xstd": (N_INPUTS,),
    "Ymean": (N_OUTPUTS,),
    "Ystd": (N_OUTPUTS,),
    **{f"Encoder{i}_w0": (N_HIDDEN, size) for i, size in enumerate(ENCODED)},
    **{f"Encoder{i}_b0": (N_HIDDEN,) for i in range(len(ENCODED))},
    **{f"DenseRes{i}_w0": (N_BLOCK, N_BLOCK) for i in range(4)},
    **{f"DenseRes{i}_b0": (N_BLOCK,) for i in range(4)},
    "Decoder_w0": (N_OUTPUTS, N_BLOCK),
    "Decoder_b0": (N_OUTPUTS,),
}
# Of the four no public copy has: what ``git hash-object`` gives for the true ones.
ABSENT_IDS = {
    "DenseRes0_w0": "fc40eccf92bec56912eb6bd281ed107253ab5d45",
    "DenseRes1_w0": "be9a66a5605f6766a02b68f5bc34d2c01744d93d",
    "DenseRes2_w0": "fbeebef19ece3903966918ff44d06f5446ba6d6d",
    "DenseRes3_w0": "e11041cd4943303264bbe09ad089b7344283e12c",
}


class ReleasedFiles(NamedTuple):
    """arrays: by name without ``.bin``, float32. absent: one sentence per file that is not there, in order."""

    arrays: dict[str, np.ndarray]
    absent: tuple[str, ...]


def read_released(folder: str | Path) -> ReleasedFiles:
    """The files of a folder. Raises BadInput for a wrong size, for numbers that are not finite, or an empty folder."""
    arrays, absent = {}, []
    for name, shape in SHAPES.items():
        path = Path(folder) / f"{name}.bin"
        if path.is_file():
            arrays[name] = _read(path, shape)
        else:
            absent.append(_sentence(name, shape))
    if not arrays:
        raise BadInput(folder, f"files {next(iter(SHAPES))}.bin to {list(SHAPES)[-1]}.bin", "none of them")
    return ReleasedFiles(arrays, tuple(absent))


def read_whole(folder: str | Path) -> dict[str, np.ndarray]:
    """All 20 arrays. Raises BadInput as :func:`read_released` does, and where some are absent, naming them."""
    found = read_released(folder)
    if found.absent:
        remedy = "give a folder with all of them: as released, the network cannot be run"
        raise BadInput(folder, f"{len(SHAPES)} files", f"without {'; '.join(found.absent)}", remedy)
    return found.arrays


def write_released(folder: str | Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write the 20 files as the folder, whole or not at all. Raises BadInput for other names, shapes or numbers."""
    if set(arrays) != set(SHAPES):
        raise BadInput(folder, f"arrays {', '.join(SHAPES)}", f"{', '.join(sorted(set(arrays) ^ set(SHAPES)))} differ")
    with atomic_folder(folder) as partial:
        for name, shape in SHAPES.items():
            array = np.asarray(arrays[name], "<f4")
            if array.shape != shape or not np.isfinite(array).all():
                raise BadInput(f"{folder}: {name}", f"finite numbers of shape {shape}", f"{array.shape}")
            (partial / f"{name}.bin").write_bytes(array.tobytes())


def content_id(path: str | Path) -> str:
    """What ``git hash-object`` prints for a file."""
    data = Path(path).read_bytes()
    return hashlib.sha1(b"blob %d\0" % len(data) + data, usedforsecurity=False).hexdigest()


def _read(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    size, expected = path.stat().st_size, 4 * int(np.prod(shape))
    if size != expected:
        raise BadInput(path, f"{expected} bytes: float32 of shape {shape}", f"{size} bytes", "fetch the file again")
    array = np.frombuffer(path.read_bytes(), "<f4").reshape(shape)
    if not np.isfinite(array).all():
        raise BadInput(path, "finite numbers", "NaN or infinity", "fetch the file again")
    return array


def _sentence(name: str, shape: tuple[int, ...]) -> str:
    known = f", git content id {ABSENT_IDS[name]}" if name in ABSENT_IDS else ""
    return f"{name}.bin ({4 * int(np.prod(shape)):,} bytes{known})"


def in_released_layout(
    arrays: Mapping[str, np.ndarray], inputs: Relabelled, outputs: Relabelled
) -> dict[str, np.ndarray]:
    """The 20 arrays of a network of our layout as those of one that reads and writes the release's: the same function.

    inputs, outputs: ``released_inputs`` and ``released_outputs`` of its hand and settings. Sign, scale and order go
    into means, deviations and the outer matrices.
    """
    return _folded(arrays, inputs, outputs)


def in_our_layout(arrays: Mapping[str, np.ndarray], inputs: Relabelled, outputs: Relabelled) -> dict[str, np.ndarray]:
    """The way back of :func:`in_released_layout`."""
    return _folded(arrays, _inverse(inputs), _inverse(outputs))


def _inverse(layout: Relabelled) -> Relabelled:
    order = np.argsort(layout.order)
    return Relabelled(order, 1 / layout.scale[order])


def _folded(arrays: Mapping[str, np.ndarray], inputs: Relabelled, outputs: Relabelled) -> dict[str, np.ndarray]:
    folded = dict(arrays)
    for letter, layout in (("X", inputs), ("Y", outputs)):
        folded[f"{letter}mean"] = layout(arrays[f"{letter}mean"])
        folded[f"{letter}std"] = arrays[f"{letter}std"][layout.order] * np.abs(layout.scale)
    sign, first = np.sign(inputs.scale), 0
    for number, size in enumerate(ENCODED):
        columns = slice(first, first + size)
        own = inputs.order[columns] - first
        folded[f"Encoder{number}_w0"] = arrays[f"Encoder{number}_w0"][:, own] * sign[columns]
        first += size
    for name in ("Decoder_w0", "Decoder_b0"):
        rows = arrays[name][outputs.order]
        folded[name] = (rows.T * np.sign(outputs.scale)).T
    return folded
