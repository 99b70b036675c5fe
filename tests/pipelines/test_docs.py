"""Code blocks in README.md and docs run in a project, or have a reason above them why they do not."""

import contextlib
import io
import json
import os
import re
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from hoidata.errors import BadInput
from pipelines.cli import app

PROJECT = Path(__file__).parents[2]
PAGES = [PROJECT / "README.md", *sorted((PROJECT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"(?:<!-- not run: (?P<why>[^>]+) -->\n)?```(?P<kind>\w*)\n(?P<text>.*?)```", re.DOTALL)
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)")
RUN = {"python", "console"}


def docs_tool(name: str) -> Any:
    """The module docs/make/NAME.py, which is in no package."""
    spec = spec_from_file_location(name, PROJECT / f"docs/make/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


plain_words, results, reference = map(docs_tool, ("plain_words", "results", "reference"))
MADE_WITH_THE_SITE = [PROJECT / "docs" / name for name in reference.PAGES]


@dataclass(frozen=True)
class Block:
    """A fenced block of a page; ``why`` is the reason why it is not run, or ""."""

    page: Path
    kind: str
    text: str
    why: str

    def commands(self) -> Iterator[list[str]]:
        """The arguments of each `hoidata` command in the block."""
        for line in self.text.splitlines() if self.kind == "console" else ():
            for command in line.split("&&"):
                words = shlex.split(command, comments=True)
                if words[:1] == ["hoidata"]:
                    yield words[1:]


def blocks(page: Path) -> list[Block]:
    matches = BLOCK.finditer(page.read_text(encoding="utf-8"))
    return [Block(page, item["kind"], item["text"], (item["why"] or "").strip()) for item in matches]


ALL = [block for page in PAGES for block in blocks(page)]


def test_all_blocks_are_run_or_have_a_reason():
    assert [(block.page.name, block.kind) for block in ALL if not block.why and block.kind not in RUN] == []
    assert sum(not block.why for block in ALL) > 12


def test_all_commands_in_the_docs_exist_with_their_options():
    for block in ALL:
        for words in block.commands():
            command, rest = get_command(app), list(words)
            while rest and rest[0] in getattr(command, "commands", {}):
                command = command.commands[rest.pop(0)]
            if hasattr(command, "commands"):  # `hoidata lineage TARGET` means `of`
                command = command.commands["of"]
            parser = command.make_parser(command.context_class(command))
            parser.parse_args(rest)  # raises for an unknown option


def test_the_readme_is_short_and_all_links_resolve():
    assert len((PROJECT / "README.md").read_text().splitlines()) <= 90
    for page in PAGES:
        for target in LINK.findall(re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)):
            path = page.parent / target
            assert path.exists() or path in MADE_WITH_THE_SITE, f"{page}: {target}"


def test_reference_pages_explain_every_command_and_setting():
    items = [line for text in reference.PAGES.values() for line in text().splitlines() if line.startswith("- `")]
    assert len(items) > 150
    assert [item for item in items if not item.partition("`: ")[2].strip(" .")] == []


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if any(not block.why for block in blocks(page))], ids=str)
def test_the_blocks_of_a_page_run_one_after_the_other(page, built, monkeypatch):
    monkeypatch.chdir(built)
    monkeypatch.setattr(os, "environ", {key: value for key, value in os.environ.items() if key != "HOIDATA_MANO"})
    names: dict = {}
    for block in (block for block in blocks(page) if not block.why):
        if block.kind == "python":
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compile(block.text, page.name, "exec"), names)
        for words in block.commands():
            done = CliRunner().invoke(app, words, catch_exceptions=False)
            assert done.exit_code in (0, 1), done.output  # 1: a lineage or check command reports a difference
            assert done.output


def test_plain_words_counts_names_comments_docstrings_and_markdown_outside_of_code():
    source = '"""Lies beside it."""\nfound = 1  # left out\n\n\ndef f(row):\n    """A map."""\n    return row\n'
    assert [(hit.line, hit.word) for hit in plain_words.hits("a.py", source)] == [
        (2, "left out"),
        (1, "beside"),
        (2, "name found"),
        (5, "name row"),
    ]
    assert [hit.word for hit in plain_words.hits("a.md", "```\nanew\n```\nthings\n")] == ["things"]
    assert [hit.line for hit in plain_words.hits("a.js", "let told\n// told\n")] == [2]


def test_the_words_allowed_by_the_word_count_are_in_the_glossary():
    glossary = (PROJECT / "ARCHITECTURE.md").read_text().partition("## Glossary")[2].lower()
    assert {word for word in plain_words.ALLOWED if f"| {word}" not in glossary} == set()


def test_tables_of_results_are_those_of_their_files():
    places = [name for page in results.PAGES for name in results.PLACE.findall(page.read_text())]
    assert len(places) == len(set(places))
    assert set(results.TABLES) <= set(places)
    for page in results.PAGES:
        assert results.filled(page.read_text()) == page.read_text(), "run: python -m docs.make.results"


def test_a_changed_file_of_results_changes_its_table_and_no_other_text(tmp_path, monkeypatch):
    arctic = json.loads((results.RESULTS / "arctic.json").read_text())
    arctic["static"]["figures"]["contact_f1"] = 0.4321
    shutil.copytree(results.RESULTS, tmp_path, dirs_exist_ok=True)
    (tmp_path / "arctic.json").write_text(json.dumps(arctic))
    before = results.PAGES[1].read_text()
    monkeypatch.setattr(results, "RESULTS", tmp_path)
    changed = [line for line in results.filled(before).splitlines() if line not in before.splitlines()]
    assert len(changed) == 1
    assert changed[0].startswith("| first frame, repeated |")
    assert "| .43 |" in changed[0]


def test_a_cell_of_results_has_interval_and_measured_clips_and_the_best_is_bold():
    def content(value, clips, low=None, high=None):
        intervals = {"jitter_m_s3": {"clips": [low, high]}} if low is not None else {}
        counts, unmeasured = {"jitter_m_s3": {"clips": clips}}, {"jitter_m_s3": {"no such frame": 100 - clips}}
        figures = {"jitter_m_s3": value}
        return {"figures": figures, "intervals": intervals, "counts": counts, "unmeasured": unmeasured}

    methods = {"near": content(55.2, 94, 51.4, 60.6), "far": content(30.0, 95)}
    assert results.best_methods(methods, "jitter", content(50.0, 100)) == {"near"}  # closest to the recorded value
    assert results.cell(methods["near"], "jitter", True, True) == "**55** (51–61) [94]"
    assert results.cell(methods["far"], "jitter", True, False) == "30"
    assert [results.number(value, 2) for value in (0.0, 0.004, 0.456, 1.0, 12.3)] == ["0", "0", ".46", "1", "12.30"]


def test_an_unknown_name_of_results_is_refused(tmp_path):
    with pytest.raises(BadInput, match="one of arctic, arctic-hands, arctic-windows, embedded-arctic"):
        results.collect("artic", tmp_path)
