"""A dataset for which stages had nothing to do is refused with the reason they noted, by everything that reads it."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from hoidata.contact.settings import read_contact_settings
from hoidata.errors import MissingResource
from hoidata.quality.thresholds import left_out_reasons
from hoidata.store.annotated import load_annotated
from hoidata.store.info import generated_info
from hoidata.store.store import open_store
from hoidata.store.writing import write_store

REASON = "grab is not present in the profile own"


def empty(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "empty.json").write_text(json.dumps({"reason": REASON}))
    return folder


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """The folders of a dataset that is not there: a store without clips, and notes in place of all else."""
    write_store(tmp_path / "clips", [], generated_info("grab"))
    for name in ("clips", "annotation", "contact", "splits", "quality"):
        empty(tmp_path / name)
    return tmp_path


READERS: list[Callable[[Path], object]] = [
    load_annotated,
    lambda root: left_out_reasons(root / "quality"),
    lambda root: read_contact_settings(root / "contact"),
]


@pytest.mark.parametrize("read", READERS)
def test_the_reason_is_told(dataset, read):
    with pytest.raises(MissingResource, match=f"is empty: {REASON}"):
        read(dataset)


@pytest.mark.parametrize("name", ["annotation", "contact", "splits"])
def test_the_reason_of_a_later_stage_is_told_too(dataset, name):
    (dataset / "clips/empty.json").unlink()
    for other in {"annotation", "contact", "splits"} - {name}:
        (dataset / other / "empty.json").unlink()
        (dataset / other / "info.json").write_text("{}")
    with pytest.raises(MissingResource, match=f"{name} is empty: {REASON}"):
        load_annotated(dataset)


def test_a_family_without_motions_tells_why_where_its_clips_would_be(tmp_path):
    with pytest.raises(MissingResource, match=f"text2hoi is empty: {REASON}"):
        open_store(empty(tmp_path / "text2hoi") / "clips")


def test_a_stage_that_has_not_run_is_named(tmp_path):
    write_store(tmp_path / "clips", [], generated_info("grab"))
    with pytest.raises(MissingResource, match="annotation is not there: run the stage 'annotate'"):
        load_annotated(tmp_path)
