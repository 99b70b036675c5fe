"""Text from untrusted files is plain text in tables and terminals, never markup."""

import pytest
from markdown_it import MarkdownIt

from pipelines.commands.lineage import _print_tree
from pipelines.exports.describe import markdown_text
from pipelines.lineage.tree import Node

EVIL = "a | <b>b</b> [c](javascript:d) ![e](f) `g` *h* \\ &lt;"


def test_any_text_is_one_cell_of_plain_text_in_a_table_of_markdown():
    blocks = MarkdownIt("commonmark").enable("table").parse(f"| x |\n|---|\n| {markdown_text(EVIL)} |\n")
    _, cell = (block for block in blocks if block.type == "inline")
    assert {child.type for child in cell.children or ()} <= {"text", "text_special"}
    assert "".join(child.content for child in cell.children or ()) == EVIL


@pytest.mark.parametrize("name", ["[/red]", "[link=file:///etc/passwd]x[/link]"])
def test_the_libraries_a_checkpoint_names_are_text_in_a_terminal(name, capsys):
    tree = Node("motion", "x", "same")
    _print_tree(tree, {"libraries": {name: "1"}})
    assert f"libraries: {name} 1" in capsys.readouterr().out
