"""Damaged JSON files of stages: every reader names the wrong entry, or does not need it."""

import copy
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from hoidata.contact.settings import read_contact_settings
from hoidata.errors import BadInput, HoidataError
from hoidata.files.written import Facts, read_json, read_json_rows
from hoidata.store.annotated import load_annotated
from pipelines.expected_orderings import check_orderings, read_methods
from pipelines.lineage.check import compare_made
from pipelines.lineage.manifests import read_manifest
from pipelines.metrics_files import LEADING, write_dvc_plots
from pipelines.pages import quality
from pipelines.pages.clip_page_facts import clip_quality
from pipelines.pages.dataset_page import split_rows
from pipelines.pages.metrics_table import markdown_table, metrics_tables
from pipelines.run_facts import describe_results
from pipelines.stages.base import StagePaths, hand_is_present
from pipelines.stages.evaluate import _with_reasons
from pipelines.stages.raw import write_generated
from tests.builders.stores import write_annotated

DATA, METRICS, CLIP = Path("data/embedded/grab"), Path("metrics/embedded/grab"), "grab/s1/box_1"
MADE = {
    "schema": "hoidata.made/1",
    "outputs": {"a": "1"},
    "networks": {},
    "processor": "p",
    "libraries": {"torch": "2"},
}
FIGURES = {
    "figures": dict.fromkeys(LEADING, 0.5),
    "intervals": {LEADING[0]: {"clips": [0.4, 0.6]}},
    "notes": {LEADING[0]: "few"},
    "evaluators": {"corrected": {"labels": ["lift"], "confusion": [[1]], "digest": "d"}},
    "diagnostics": {"loss": 1.0},
    "left_out": [],
    "motions": 4,
    "held_out_clips": 2,
}


@pytest.fixture(scope="module")
def written(page_clip, tmp_path_factory) -> Path:
    """A project with one dataset and metrics."""
    folder = tmp_path_factory.mktemp("written")
    clips = [
        replace(page_clip(), clip_id=CLIP),
        replace(page_clip(left=True, hinged=True, frames=30), clip_id="grab/s2/lid_1", subject="s2"),
    ]
    split = {"by": "subject", "train": "rest", "test": ["s2"], "promises": ["subject"]}
    write_annotated(folder / DATA, clips, "grab", split, 0.09, quality=True)
    (folder / METRICS).mkdir(parents=True)
    for family in ("ground-truth", "text2hoi"):
        (folder / METRICS / f"{family}.json").write_text(json.dumps(FIGURES))
    (folder / METRICS / "mean-pose.json").write_text(json.dumps({"empty": "no clips", "held_out_clips": 0}))
    params = {"datasets": ["grab"], "families": ["text2hoi", "ground-truth"], "profile": "embedded"}
    (folder / "params.yaml").write_text(yaml.safe_dump(params))
    manifests = folder / "manifests/embedded"
    manifests.mkdir(parents=True)
    for name in ("grab", "hand"):
        shutil.copy(Path(__file__).parents[3] / "manifests/embedded" / f"{name}.json", manifests)
    (folder / "made.json").write_text(json.dumps(MADE))
    (folder / "left_out.json").write_text(json.dumps([{"clip_id": "a~0", "reason": "none"}]))
    return folder


@pytest.fixture
def here(written, tmp_path, monkeypatch) -> Path:
    shutil.copytree(written, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(quality, "measures_svg", lambda *_: "")
    monkeypatch.setattr("pipelines.stages.raw.jobs", lambda: 1)
    monkeypatch.setattr("hoidata.synthetic.corpus.write_corpus", lambda *_: None)
    return tmp_path


def read_quality_files() -> None:
    quality.read_quality(DATA / "quality", "grab")
    clip_quality(DATA / "quality", CLIP)


def read_annotated() -> None:
    annotated = load_annotated(DATA)
    split_rows(annotated)
    annotated.hand_evidence(CLIP)
    assert annotated.contact_threshold_m + annotated.contact_info["points"] + annotated.annotation_info["points"] > 0


def read_all_metrics() -> None:
    families = ("text2hoi", "ground-truth", "mean-pose")
    metrics_tables(METRICS, families)
    markdown_table(METRICS, families, LEADING)
    check_orderings(read_methods(METRICS))
    shutil.rmtree("figures", ignore_errors=True)
    Path("figures").mkdir()
    write_dvc_plots(Path("figures"), METRICS.parent, Path("checkpoints"), {"grab": families})


def read_a_manifest() -> None:
    manifest = read_manifest(StagePaths("embedded", "grab").manifest)
    assert all(part.title() for part in (manifest.dataset, manifest.licence))
    write_generated(StagePaths("embedded", "grab"), manifest, Path("raw"))


def read_hand() -> None:
    hand_is_present("embedded")


READERS: dict[str, list[Callable[[], object]]] = {
    f"{DATA}/quality/info.json": [read_quality_files],
    f"{DATA}/annotation/info.json": [read_annotated, lambda: describe_results(Path(), "embedded")],
    f"{DATA}/contact/info.json": [read_annotated, lambda: read_contact_settings(DATA / "contact")],
    f"{DATA}/splits/info.json": [read_annotated, lambda: describe_results(Path(), "embedded")],
    f"{DATA}/clips/meta/info.json": [lambda: describe_results(Path(), "embedded"), read_annotated],
    f"{METRICS}/text2hoi.json": [read_all_metrics, lambda: describe_results(Path(), "embedded")],
    f"{METRICS}/mean-pose.json": [read_all_metrics],
    "manifests/embedded/grab.json": [read_a_manifest],
    "manifests/embedded/hand.json": [read_hand],
    "made.json": [lambda: compare_made(Path(), Path("made.json"))],
    "left_out.json": [lambda: _with_reasons([{"clip_id": "a~0", "reason": "?"}], Path("left_out.json"))],
}


def damaged(values: Any, depth: int = 3, most: int = 24) -> Iterator[Any]:
    """The value with one entry renamed or replaced by a value of another type, nested objects included."""
    yield [] if isinstance(values, dict) else {}
    entries = values.items() if isinstance(values, dict) else enumerate(values)
    for name, value in list(entries)[:most]:
        others = [None, "text", [1, "x"], {"x": 1}, True]
        inside = damaged(value, depth - 1, 3) if depth and isinstance(value, dict | list) and value else ()
        for other in (*others, *inside):
            changed = copy.deepcopy(values)
            changed[name] = other
            yield changed
        if isinstance(values, dict):
            yield {(f"{key}x" if key == name else key): item for key, item in values.items()}


@pytest.mark.long
@pytest.mark.parametrize("file", READERS)
def test_all_readers_of_a_damaged_file_name_the_entry(here, file):
    path, messages, damages = here / file, [], set()
    values = json.loads(path.read_text())
    for reader in READERS[file]:
        reader()
    for changed in damaged(values):
        text = json.dumps(changed)
        if text in damages:
            continue
        damages.add(text)
        path.write_text(text)
        for reader in READERS[file]:
            try:
                reader()
            except HoidataError as error:
                messages.append(str(error))
            except Exception as error:
                raise AssertionError(f"{type(error).__name__}: {error} for {text[:400]}") from error
    assert len(messages) > 2
    assert all(path.stem in message for message in messages)


def test_a_missing_entry_is_named_by_its_full_key(tmp_path):
    path = tmp_path / "info.json"
    path.write_text('{"thresholds": {"limits": {"jump_m": {"warn": 1}}}, "rows": [{"name": "a"}]}')
    facts = read_json(path)
    with pytest.raises(
        BadInput, match=r"info\.json: expected an entry 'thresholds\.limits\.jump_m\.leave_out', got none"
    ):
        facts["thresholds"]["limits"]["jump_m"]["leave_out"]
    with pytest.raises(BadInput, match=r"an entry 'rows\.count'"):
        facts["rows"][0]["count"]
    assert copy.deepcopy(facts)["thresholds"].key == "thresholds."
    assert isinstance(facts["thresholds"], Facts)


def test_an_entry_of_another_type_is_named_with_what_it_has_to_be(tmp_path):
    path = tmp_path / "info.json"
    path.write_text('{"counts": {"clips": "many"}}')
    with pytest.raises(BadInput, match=r"expected int as the entry 'counts\.clips', got 'many'; restore it with"):
        read_json(path, {"counts": {"clips": int}})
    path.write_text('[{"clip_id": 3}]')
    with pytest.raises(BadInput, match=r"expected str as the entry '0\.clip_id', got 3"):
        read_json_rows(path, {"clip_id": str})
