"""The lists of the papers' statements in docs/papers: where each one is implemented and tested, or why it is not."""

import csv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HEADER = ["item", "statement", "status", "where", "test", "reason"]


@pytest.mark.parametrize("path", sorted((ROOT / "docs/papers").glob("*.csv")), ids=lambda path: path.stem)
def test_statements_have_a_status_and_existing_code_and_tests(path):
    with path.open(encoding="utf-8", newline="") as file:
        statements = list(csv.DictReader(file, strict=True))
    assert len({one["item"] for one in statements}) == len(statements) > 0
    for statement in statements:
        assert list(statement) == HEADER
        assert None not in statement.values(), statement
        assert statement["statement"], statement
        assert statement["status"] in ("exact", "differs", "missing"), statement
        assert bool(statement["reason"]) == (statement["status"] != "exact"), statement
        assert statement["where"] or statement["status"] == "missing", statement
        code, _, name = statement["where"].partition(":")
        assert not statement["where"] or (name and name in text_of(code)), statement
        test, *_, name = statement["test"].split("::") if statement["test"] else ("", "")
        assert not statement["test"] or f"def {name}(" in text_of(test), statement


def text_of(path: str) -> str:
    """The text of a file; "" if there is none."""
    return (ROOT / path).read_text(encoding="utf-8") if (ROOT / path).is_file() else ""
