"""The release's 20 weight files: little-endian float32 without header, matrices (outputs, inputs) row by row.

Four of them, the matrices of the blocks, are in no public copy; their sizes and git content ids are known, so whoever
has them can check. A network of ours is written and read as these files (``arrays_of``, ``network_of``), normalisation
among them; one of other sizes has files of other sizes, which a reader has to be told (``shapes_of``).
"""

import hashlib
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from hoidata.errors import BadInput
from hoidata.files import atomic_folder
from hoidata.hands.tracked_hand import TrackedHand
from models.manipnet.examples import sized
from models.manipnet.features import Relabelled, released_inputs, released_outputs
from models.manipnet.network import ManipNet, NetworkConfig

Shapes = Mapping[str, tuple[int, ...]]


def shapes_of(config: NetworkConfig) -> dict[str, tuple[int, ...]]:
    """What the files of a network of these sizes hold, in order; encoders are of pose, trajectory and sensors."""
    inputs, hidden = config.inputs, config.encoder
    width, layers = len(inputs) * hidden, range(2 * config.blocks)
    return {
        "Xmean": (sum(inputs),),
        "Xstd": (sum(inputs),),
        "Ymean": (config.output,),
        "Ystd": (config.output,),
        **{f"Encoder{i}_w0": (hidden, size) for i, size in enumerate(inputs)},
        **{f"Encoder{i}_b0": (hidden,) for i in range(len(inputs))},
        **{f"DenseRes{i}_w0": (width, width) for i in layers},
        **{f"DenseRes{i}_b0": (width,) for i in layers},
        "Decoder_w0": (config.output, width),
        "Decoder_b0": (config.output,),
    }


SHAPES = shapes_of(NetworkConfig())
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


def read_released(folder: str | Path, shapes: Shapes = SHAPES) -> ReleasedFiles:
    """The files of a folder. shapes: the release's unless told.

    Raises BadInput for a wrong size, for numbers that are not finite, or an empty folder.
    """
    arrays, absent = {}, []
    for name, shape in shapes.items():
        path = Path(folder) / f"{name}.bin"
        if path.is_file():
            arrays[name] = _read(path, shape)
        else:
            absent.append(_sentence(name, shape))
    if not arrays:
        raise BadInput(folder, f"files {next(iter(shapes))}.bin to {list(shapes)[-1]}.bin", "none of them")
    return ReleasedFiles(arrays, tuple(absent))


def read_whole(folder: str | Path, shapes: Shapes = SHAPES) -> dict[str, np.ndarray]:
    """All arrays. Raises BadInput as :func:`read_released` does, and where some are absent, naming them."""
    found = read_released(folder, shapes)
    if found.absent:
        remedy = "give a folder with all of them: as released, the network cannot be run"
        raise BadInput(folder, f"{len(shapes)} files", f"without {'; '.join(found.absent)}", remedy)
    return found.arrays


def write_released(folder: str | Path, arrays: Mapping[str, np.ndarray], shapes: Shapes = SHAPES) -> None:
    """Write the files as the folder, whole or not at all. Raises BadInput for other names, shapes or numbers."""
    if set(arrays) != set(shapes):
        raise BadInput(folder, f"arrays {', '.join(shapes)}", f"{', '.join(sorted(set(arrays) ^ set(shapes)))} differ")
    with atomic_folder(folder) as partial:
        for name, shape in shapes.items():
            array = np.asarray(arrays[name], "<f4")
            if array.shape != shape or not np.isfinite(array).all():
                raise BadInput(f"{folder}: {name}", f"finite numbers of shape {shape}", f"{array.shape}")
            (partial / f"{name}.bin").write_bytes(array.tobytes())


def arrays_of(network: ManipNet, hand: TrackedHand) -> dict[str, np.ndarray]:
    """A trained network as the arrays of one that reads and writes the release's layout: the same function.

    hand: what it was trained for. Inputs that are switched off have no place in the files: their columns are zero.
    Neither have the features' settings, among them the step, and the joints' limits. Raises BadInput where the release
    has no formula for it.
    """
    config = network.config
    _check_formula(config, hand)
    state = network.state_dict()
    arrays = {name: state[key].double().numpy() for name, key in _state_names(config).items()}
    kept = network.kept.double().numpy()
    for number, columns in enumerate(_columns(arrays)):
        arrays[f"Encoder{number}_w0"] = arrays[f"Encoder{number}_w0"] * kept[columns]
    layout = released_inputs(hand, config.features), released_outputs(hand)
    return _in_float32(in_released_layout(arrays, *layout))


def network_of(arrays: Mapping[str, np.ndarray], config: NetworkConfig, hand: TrackedHand) -> ManipNet:
    """The way back of :func:`arrays_of`: a network that reads and writes our layout.

    config: its sizes and settings, which files do not say. What no number of the first layers reads counts as switched
    off. Joints are free to turn as far as the hand's hinges let them.
    """
    _check_formula(config, hand)
    exact = {name: np.asarray(array, np.float64) for name, array in arrays.items()}
    layout = released_inputs(hand, config.features), released_outputs(hand)
    ours = _in_float32(in_our_layout(exact, *layout))
    network = ManipNet(config).eval()
    state = network.state_dict()
    for name, key in _state_names(config).items():
        state[key].copy_(torch.from_numpy(ours[name]))
    read = [ours[f"Encoder{number}_w0"].any(axis=0) for number in range(len(config.inputs))]
    network.kept.copy_(torch.from_numpy(np.concatenate(read)))
    return network


def _check_formula(config: NetworkConfig, hand: TrackedHand) -> None:
    """Raise BadInput for a network that is not of this hand, or not of the kind that the files stand for."""
    if config.kind != "manipnet":
        remedy = "only this kind can be written as the release's files"
        raise BadInput("network", "kind manipnet", config.kind, remedy)
    if sized(config, hand) != config:
        of_hand, own = (f"{one.inputs} -> {one.output}" for one in (sized(config, hand), config))
        raise BadInput("network", f"{of_hand} numbers, those of the {hand.layout} hand", own, "give its own hand")


def _in_float32(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """As files and networks hold it; what means and spreads of inputs lose by rounding goes into the encoders.

    A mean of 1 m is rounded by 6e-8 m, which in units of a spread of 1 mm is more than a result may change by.
    """
    mean, spread = (arrays[name].astype(np.float32).astype(np.float64) for name in ("Xmean", "Xstd"))
    stretch, shift = spread / arrays["Xstd"], (mean - arrays["Xmean"]) / arrays["Xstd"]
    made = dict(arrays) | {"Xmean": mean, "Xstd": spread}
    for number, columns in enumerate(_columns(arrays)):
        weight = arrays[f"Encoder{number}_w0"]
        made[f"Encoder{number}_w0"] = weight * stretch[columns]
        made[f"Encoder{number}_b0"] = arrays[f"Encoder{number}_b0"] + weight @ shift[columns]
    return {name: array.astype(np.float32) for name, array in made.items()}


def _columns(arrays: Mapping[str, np.ndarray]) -> list[slice]:
    """Which inputs each encoder reads: pose, trajectory, sensors."""
    ends = np.cumsum([0, *(arrays[f"Encoder{number}_w0"].shape[1] for number in range(3))])
    return [slice(*pair) for pair in pairwise(ends.tolist())]


def _state_names(config: NetworkConfig) -> dict[str, str]:
    """By the name of a file what a network calls that tensor."""
    layers = {f"Encoder{number}": f"encoders.{number}" for number in range(len(config.inputs))}
    for number in range(2 * config.blocks):
        layers[f"DenseRes{number}"] = f"blocks.{number // 2}.{('first', 'second')[number % 2]}"
    layers["Decoder"] = "decoder"
    found = {"Xmean": "input_mean", "Xstd": "input_scale", "Ymean": "output_mean", "Ystd": "output_scale"}
    for name, key in layers.items():
        found |= {f"{name}_w0": f"{key}.weight", f"{name}_b0": f"{key}.bias"}
    return found


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
    """The arrays of a network of our layout as those of one that reads and writes the release's: the same function.

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
    sign = np.sign(inputs.scale)
    for number, columns in enumerate(_columns(arrays)):
        own = inputs.order[columns] - columns.start
        folded[f"Encoder{number}_w0"] = arrays[f"Encoder{number}_w0"][:, own] * sign[columns]
    for name in ("Decoder_w0", "Decoder_b0"):
        rows = arrays[name][outputs.order]
        folded[name] = (rows.T * np.sign(outputs.scale)).T
    return folded
