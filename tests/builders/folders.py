"""Folders of small text files."""

from collections.abc import Mapping
from pathlib import Path


def write_text(root: Path, files: Mapping[str, str]) -> Path:
    """Write each text to its path below ``root``, which is returned."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root
