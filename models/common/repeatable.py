"""Reproducible results: deterministic algorithms for a process, seeds for a step, and the choice of a device."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256

import numpy as np
import torch

from hoidata.errors import BadInput, MissingResource


def make_repeatable(threads: int) -> None:
    """Make the whole process deterministic: number of threads and algorithms.

    For the entry point of a process, such as a stage, a command or a worker; the library never calls it. Matrix
    products stay float32 on processors with bfloat16 units (AMX), because sampled motions would jitter.
    """
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS refuses deterministic products otherwise
    torch.set_num_threads(threads)
    # Like use_deterministic_algorithms(True), which also loads torch's compiler and costs each command a second.
    torch.set_deterministic_debug_mode("error")
    # No code reads uninitialised memory; filling it would cost a seventh of the time.
    setattr(torch.utils.deterministic, "fill_uninitialized_memory", False)  # noqa: B010 (missing in torch's types)
    torch.set_float32_matmul_precision("highest")


@contextmanager
def restored_rng(device: torch.device | str = "cpu") -> Iterator[None]:
    """Restore torch's global random generators (weights, dropout) at the end of the ``with`` block."""
    device = torch.device(device)
    with torch.random.fork_rng([device] if device.type == "cuda" else [], enabled=True):
        yield


def seeded_generator(*words: int) -> torch.Generator:
    """A CPU generator seeded by ``words``, such as (seed, step, part); seeds torch's global generators as well."""
    seed = int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0] >> np.uint64(1))
    torch.manual_seed(seed)
    return torch.Generator().manual_seed(seed)


def seed_of(text: str) -> int:
    """A seed that depends on a text only."""
    return int.from_bytes(sha256(text.encode(errors="backslashreplace")).digest()[:7])


DEVICES = ("auto", "cpu", "cuda")


def chosen_device(setting: str) -> str:
    """``cuda`` or ``cpu`` for the setting ``device``; auto is a GPU if torch finds one.

    Raises BadInput for another value, and MissingResource for cuda without a GPU.
    """
    if setting not in DEVICES:
        raise BadInput("params.yaml: device", " or ".join(DEVICES), repr(setting), "correct it")
    if setting == "cuda" and not torch.cuda.is_available():
        raise MissingResource("params.yaml: device is cuda, and torch finds no GPU; set it to auto or cpu")
    return "cuda" if setting != "cpu" and torch.cuda.is_available() else "cpu"
