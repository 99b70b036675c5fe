"""Which clips train, validate and test: rules, named splits kept as data, leak check, training statistics."""

from hoidata.splits.definitions import Definition, choose, definitions_for
from hoidata.splits.leaks import PROMISES, Leaks, find_leaks
from hoidata.splits.published import Published, published
from hoidata.splits.rules import PARTS, SplitRule, assign_split
from hoidata.splits.stage import split_store

__all__ = [
    "PARTS",
    "PROMISES",
    "Definition",
    "Leaks",
    "Published",
    "SplitRule",
    "assign_split",
    "choose",
    "definitions_for",
    "find_leaks",
    "published",
    "split_store",
]
