"""Families that take long are made only where params.yaml lists them; their stages are there all the same."""

from pathlib import Path

from models.registry import IF_LISTED
from pipelines.params import read_params


def off_reason(name: str) -> str | None:
    """Why a family, or its network, is not made although it has stages; None for those that are."""
    if name not in IF_LISTED or name in read_params(Path())["families"]:
        return None
    return f"off: params.yaml does not list {name} under families"
