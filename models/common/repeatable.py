"""Equal inputs, equal bytes: what a process sets once for itself, and the draws of one step from their own seed."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from hoidata.errors import BadInput, MissingResource


def make_repeatable(threads: int) -> None:
    """Fix, for the whole process, what could change bytes from run to run: threads and algorithms.

    For the entry of a process that trains or samples alone: a stage, a command, a worker. The library never calls it.
    Matrix products stay float32 where a processor would be faster in bfloat16 (AMX): sampled motions would shake.
    """
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # without it cuBLAS refuses deterministic products
    torch.set_num_threads(threads)
    # As use_deterministic_algorithms(True), which loads torch's compiler as well: a second of every command's start.
    torch.set_deterministic_debug_mode("error")
    # Nothing here reads memory before writing it; filling it first would cost a seventh of the time.
    setattr(torch.utils.deterministic, "fill_uninitialized_memory", False)  # noqa: B010 (pyright does not know it)
    torch.set_float32_matmul_precision("highest")


@contextmanager
def own_draws(device: torch.device | str = "cpu") -> Iterator[None]:
    """Inside, torch's global generators (weights, dropout) may be seeded; afterwards they are as they were."""
    device = torch.device(device)
    with torch.random.fork_rng([device] if device.type == "cuda" else [], enabled=True):
        yield


def seed_draws(*words: int) -> torch.Generator:
    """A CPU generator seeded by ``words``, for instance (seed, step, part); torch's global ones are seeded alike."""
    seed = int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0] >> np.uint64(1))
    torch.manual_seed(seed)
    return torch.Generator().manual_seed(seed)


DEVICES = ("auto", "cpu", "cuda")


def chosen_device(setting: str) -> str:
    """``cuda`` or ``cpu``: auto takes a GPU where torch finds one.

    Raises BadInput for another word, and MissingResource where cuda is asked for and there is none.
    """
    if setting not in DEVICES:
        raise BadInput("params.yaml: device", " or ".join(DEVICES), repr(setting), "correct it")
    if setting == "cuda" and not torch.cuda.is_available():
        raise MissingResource("params.yaml: device is cuda, and torch finds no GPU; set it to auto or cpu")
    return "cuda" if setting != "cpu" and torch.cuda.is_available() else "cpu"
