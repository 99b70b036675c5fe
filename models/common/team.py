"""Several processes that train one network: each computes its parts of every batch, and gradients are averaged.

What a step computes depends on the number of parts alone, so any number of processes gives the same weights.
"""

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from multiprocessing.queues import SimpleQueue
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor
from torch.multiprocessing.spawn import ProcessException, spawn

from hoidata.errors import BadInput, HoidataError


@dataclass(frozen=True)
class Team:
    """rank: number of this process among ``size``; the one of rank 0 writes."""

    rank: int = 0
    size: int = 1

    @classmethod
    def joined(cls) -> "Team":
        """The team this process was started in, or a team of one."""
        return cls(dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else cls()

    @property
    def writes(self) -> bool:
        return self.rank == 0

    def device(self, name: str) -> str:
        """``name``, or of several GPUs the one that is this process's own."""
        several = name == "cuda" and self.size > 1
        return f"cuda:{self.rank % torch.cuda.device_count()}" if several else name

    def own_parts(self, of: int) -> range:
        """Which of ``of`` parts of a batch are computed here. Raises BadInput where they cannot be shared evenly."""
        if of % self.size:
            expected = f"a multiple of the {self.size} processes"
            raise BadInput("params.yaml: training.parts", expected, str(of), "set parts, or train.processes")
        return range(self.rank, of, self.size)

    def add_up(self, tensors: Iterable[Tensor]) -> None:
        """Every tensor in the place of its sum over the team."""
        tensors = list(tensors)
        if self.size == 1 or not tensors:
            return
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        dist.all_reduce(flat)
        for tensor, total in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(total.view_as(tensor))


def run_team(work: Callable[..., None], size: int, meeting: Path, *given: object) -> None:
    """``work(*given)`` in ``size`` new processes that are one team; a module's function, as processes start afresh.

    meeting: a file, not there yet, by which they find each other. The error of one of them is raised here.
    """
    if size == 1:
        work(*given)
        return
    errors = multiprocessing.get_context("spawn").SimpleQueue()
    try:
        spawn(_member, (work, size, meeting.absolute().as_uri(), errors, given), size)
    except ProcessException:
        if errors.empty():
            raise
        raise errors.get() from None


def _member(rank: int, work: Callable[..., None], size: int, meeting: str, errors: SimpleQueue, given: tuple) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    dist.init_process_group("gloo", init_method=meeting, rank=rank, world_size=size)
    try:
        work(*given)
    except HoidataError as error:
        errors.put(error)
        raise
    finally:
        dist.destroy_process_group()


def _end_with_parent() -> None:
    """End this process when its parent has ended: torch asks for SIGINT then, which may be ignored or swallowed."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
