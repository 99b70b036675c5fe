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
    assert len({row["item"] for row in statements}) == len(statements) > 0
    for row in statements:
        assert list(row) == HEADER
        assert None not in row.values(), row
        assert row["statement"], row
        assert row["status"] in ("exact", "differs", "missing"), row
        assert bool(row["reason"]) == (row["status"] != "exact"), row
        assert row["where"] or row["status"] == "missing", row
        code, _, name = row["where"].partition(":")
        assert not row["where"] or (name and name in text_of(code)), row
        test, *_, name = row["test"].split("::") if row["test"] else ("", "")
        assert not row["test"] or f"def {name}(" in text_of(test), row


def text_of(path: str) -> str:
    """The text of a file; "" if there is none."""
    return (ROOT / path).read_text(encoding="utf-8") if (ROOT / path).is_file() else ""
