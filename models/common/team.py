"""Data-parallel training of one network: each process computes some micro-batches, and gradients are averaged.

A step depends only on the number of micro-batches, so any number of processes gives the same weights.
"""

import multiprocessing
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from multiprocessing.queues import SimpleQueue
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor
from torch.multiprocessing.spawn import ProcessException, spawn

from hoidata.errors import BadInput, HoidataError
from hoidata.lifetime import end_with_starter


@dataclass(frozen=True)
class Team:
    """The processes that train one network together, seen from one process; rank 0 writes."""

    rank: int = 0
    size: int = 1

    @classmethod
    def joined(cls) -> "Team":
        """The team in which this process was started, or a team of one."""
        return cls(dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else cls()

    @property
    def writes(self) -> bool:
        return self.rank == 0

    def device(self, name: str) -> str:
        """``name``; for "cuda" in a team of several, the GPU of this process."""
        several = name == "cuda" and self.size > 1
        return f"cuda:{self.rank % torch.cuda.device_count()}" if several else name

    def own_micro_batches(self, count: int) -> range:
        """This process's micro-batches, of ``count`` in all. Raises BadInput if they do not divide evenly."""
        if count % self.size:
            expected = f"a multiple of the {self.size} processes"
            raise BadInput(
                "params.yaml: training.micro_batches", expected, str(count), "set micro_batches, or train.processes"
            )
        return range(self.rank, count, self.size)

    def sum_over_team(self, tensors: Iterable[Tensor]) -> None:
        """Replace every tensor by its sum over the team."""
        tensors = list(tensors)
        if self.size == 1 or not tensors:
            return
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        dist.all_reduce(flat)
        for tensor, total in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(total.view_as(tensor))


def run_team(work: Callable[..., None], size: int, meeting: Path, *arguments: object) -> None:
    """Run ``work(*arguments)`` in ``size`` new processes that form one team. An error in a process is raised here.

    Args:
        work: a function of a module, because processes start afresh.
        meeting: a file that does not exist yet, through which the processes find each other.
    """
    if size == 1:
        work(*arguments)
        return
    errors = multiprocessing.get_context("spawn").SimpleQueue()
    try:
        spawn(_member, (work, size, meeting.absolute().as_uri(), errors, arguments), size)
    except ProcessException:
        if errors.empty():
            raise
        raise errors.get() from None


def _member(
    rank: int, work: Callable[..., None], size: int, meeting: str, errors: SimpleQueue, arguments: tuple
) -> None:
    end_with_starter()  # torch relies on SIGINT, which may be ignored
    dist.init_process_group("gloo", init_method=meeting, rank=rank, world_size=size)
    try:
        work(*arguments)
    except HoidataError as error:
        errors.put(error)
        raise
    finally:
        dist.destroy_process_group()
