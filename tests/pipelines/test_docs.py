"""What README.md and docs say to type works: blocks are run in a project, or say above them why they are not."""

import contextlib
import io
import os
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from pipelines.cli import app

PROJECT = Path(__file__).parents[2]
PAGES = [PROJECT / "README.md", *sorted((PROJECT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"(?:<!-- not run: (?P<why>[^>]+) -->\n)?```(?P<kind>\w*)\n(?P<text>.*?)```", re.DOTALL)
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)")
RUN = {"python", "console"}
SHOWN = {"yaml"}  # printed by docs/make/reference.py, and compared below


def docs_tool(name: str) -> Any:
    """The module docs/make/NAME.py, which is in no package."""
    spec = spec_from_file_location(name, PROJECT / f"docs/make/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


plain_words = docs_tool("plain_words")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page. why: it is not run, or ""."""

    page: Path
    kind: str
    text: str
    why: str

    def commands(self) -> Iterator[list[str]]:
        """The words of each `hoidata` command in it."""
        for line in self.text.splitlines() if self.kind == "console" else ():
            for command in line.split("&&"):
                words = shlex.split(command, comments=True)
                if words[:1] == ["hoidata"]:
                    yield words[1:]


def blocks(page: Path) -> list[Block]:
    found = BLOCK.finditer(page.read_text(encoding="utf-8"))
    return [Block(page, item["kind"], item["text"], (item["why"] or "").strip()) for item in found]


ALL = [block for page in PAGES for block in blocks(page)]


def test_every_block_is_run_or_says_why_not():
    assert [(block.page.name, block.kind) for block in ALL if not block.why and block.kind not in RUN | SHOWN] == []
    assert sum(not block.why for block in ALL) > 12


def test_every_command_that_is_shown_exists_with_its_options():
    for block in ALL:
        for words in block.commands():
            command, rest = get_command(app), list(words)
            while rest and rest[0] in getattr(command, "commands", {}):
                command = command.commands[rest.pop(0)]
            if hasattr(command, "commands"):  # `hoidata lineage TARGET` means `of`
                command = command.commands["of"]
            parser = command.make_parser(command.context_class(command))
            parser.parse_args(rest)  # raises for an option that is not there


def test_the_readme_is_read_in_a_minute_and_no_link_leads_nowhere():
    assert len((PROJECT / "README.md").read_text().splitlines()) <= 90
    for page in PAGES:
        for target in LINK.findall(re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)):
            assert (page.parent / target).exists(), f"{page}: {target}"


def test_reference_pages_are_printed_from_the_tables():
    reference = docs_tool("reference")
    for name, text in reference.PAGES.items():
        assert (reference.FOLDER / name).read_text() == text(), "run: python -m docs.make.reference"


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
            assert done.exit_code in (0, 1), (
                done.output
            )  # 1: the data is not what a lineage or check wants, and says so
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
