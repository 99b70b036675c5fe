"""The page of a lineage: what a file was made from, piece by piece, and the raw files and frames behind it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipelines.lineage.raw import RawSource
from pipelines.lineage.tree import STATUSES, Node, overall_status
from pipelines.pages.player import write_page

QUIET = ("same", "recorded")


def write_lineage_page(path: Path, tree: Node, record: dict[str, Any], sources: Sequence[RawSource]) -> Path:
    """Write a self-contained page; what is not as recorded stands open, all else is folded."""
    status = overall_status(tree)
    stages = dict.fromkeys(node.name for node in tree.walk() if node.kind == "stage")
    return write_page(
        path,
        "lineage.html",
        title=f"Lineage of {tree.name}",
        status=status,
        meaning=STATUSES[status],
        tree=tree,
        loud={node.name for node in tree.walk() if any(below.status not in QUIET for below in node.walk())},
        anchors={name: f"stage-{number}" for number, name in enumerate(stages)},
        libraries=record.get("libraries", {}),
        sources=list(sources),
        has_players=False,
    )
