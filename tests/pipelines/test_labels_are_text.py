"""Text of foreign files is text in tables and terminals, never markup."""

from types import SimpleNamespace

import numpy as np
import pytest
from markdown_it import MarkdownIt

from models.bimart_tables.mapping import VARIANTS, WHERE
from pipelines.commands.lineage import _print_tree
from pipelines.lineage.tree import Node
from pipelines.markdown import markdown_text
from pipelines.stages import tables

EVIL = "a | <b>b</b> [c](javascript:d) ![e](f) `g` *h* \\ &lt;"


def test_any_text_is_one_cell_of_plain_text_in_a_table_of_markdown():
    blocks = MarkdownIt("commonmark").enable("table").parse(f"| x |\n|---|\n| {markdown_text(EVIL)} |\n")
    _, cell = (block for block in blocks if block.type == "inline")
    assert {child.type for child in cell.children or ()} <= {"text", "text_special"}
    assert "".join(child.content for child in cell.children or ()) == EVIL


def test_names_of_objects_are_text_in_the_tables_of_bimart(monkeypatch):
    found = {EVIL: {kind: np.zeros(len(WHERE)).tolist() for kind in VARIANTS}}
    monkeypatch.setattr(tables, "load_hands", lambda profile: None)
    monkeypatch.setattr("hoidata.store.annotated.load_annotated", lambda *_: None)
    monkeypatch.setattr("hoidata.batches.dataset.HoiDataset", lambda *_, **__: [])
    monkeypatch.setattr("models.bimart_tables.mapping.mapping_errors_cm", lambda *_: found)
    rows = tables._mapping(SimpleNamespace(profile="", data=""))  # pyright: ignore[reportArgumentType]
    blocks = MarkdownIt("commonmark").enable("table").parse("\n".join(rows))
    children = [child for block in blocks for child in block.children or ()]
    assert {child.type for child in children} <= {"text", "text_special"}
    assert sum(block.type == "td_open" for block in blocks) == 2 * (1 + len(VARIANTS) * len(WHERE))


@pytest.mark.parametrize("name", ["[/red]", "[link=file:///etc/passwd]x[/link]"])
def test_the_libraries_a_checkpoint_names_are_text_in_a_terminal(name, capsys):
    tree = Node("motion", "x", "same")
    _print_tree(tree, {"libraries": {name: "1"}}, show_clips=False)
    assert f"libraries: {name} 1" in capsys.readouterr().out
