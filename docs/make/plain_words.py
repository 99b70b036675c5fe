"""Counts words of house dialect in comments, docstrings, Markdown and names.

`python -m docs.make.plain_words` fails if the count is above CEILING; with files as arguments it lists their hits.
Lower CEILING whenever the count falls. A hit is a sentence to read again, not always a fault. The words in ALLOWED are
defined in the glossary of ARCHITECTURE.md and do not count.
"""

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

CEILING = 152  # hits in all tracked files
ALLOWED = frozenset({"promises"})

# Patterns of prose and the standard terms to use instead.
PHRASES = {
    r"told|tells? (?:it|one|them|the network)": "conditioned on, given, reported",
    r"beside": "next to, compared with, alongside",
    r"things?": "object",
    r"look(?:s|ed|ing)?[ -]up again|drawn again|draws? again": "resampled, rejection sampling",
    r"drawn": "sampled, plotted",
    r"held lookups?|lookups?(?! table)": "retrieval baseline",
    r"holds?(?=[^.]{0,40}\b(?:correct|refine|pose|solver|clip)\b)": "contact refinement, grasp",
    r"asked for|(?:is|are) asked|asks? for": "requested, target, needs",
    r"left out": "excluded, skipped",
    r"made (?:frames?|motions?)|made of(?= the)|what it made": "interpolated, generated, predicted",
    r"anew": "again, from scratch",
    r"spoilt": "corrupted, perturbed",
    r"promises?": "assertion, expected ordering",
    r"judges?": "evaluator, classifier",
    r"rooms?": "package, subpackage",
    r"stands? (?:in|under|beside|at|above|below|there)": "is in, is listed in",
    r"what is (?:told|asked|made|drawn|known|left)": "say the noun",
    r"of (?:it|them)": "say the noun",
    r"where (?:there is|it is|one is|they are) (?:one|not|none|there)": "if present, otherwise",
    r"as (?:it is|they are)": "unchanged",
    r"by name": "explicitly",
    r"its own|their own|of our own|of one's own": "its, custom",
    r"no (?:other|one) (?:is|was|knows)": "only",
    r"(?:is|are) no": "is not a",
    r"at once": "immediately, in one call",
    r"sa(?:y|ys|id) so": "state it",
    r"take(?:n|s) up": "resumed",
    r"give[sn]? back": "return, recover",
    r"can(?:not)? tell|tell apart": "distinguish",
    r"nearer": "closer",
    r"places?(?=[^.]{0,20}\b(?:m|metres|points?)\b)": "position",
    r"turns?(?=[^.]{0,12}\b(?:of|by|rad)\b)": "rotation",
    r"figures?(?! \d|s? \(|s? of the paper)": "metric, result",
}
# Names of variables and arguments that do not say what they hold.
NAMES = frozenset(
    {
        "own", "thing", "things", "found", "known", "told", "every", "kept", "made", "asked", "wanted", "beside",
        "what", "where", "there", "seen", "some", "given", "share", "way", "turn", "place", "held", "row",
    }
)  # fmt: skip
_PATTERNS = {phrase: re.compile(rf"\b(?:{phrase})\b", re.IGNORECASE) for phrase in PHRASES}
_CODE_BLOCK = re.compile(r"```.*?```", re.DOTALL)


class Hit(NamedTuple):
    path: str
    line: int
    word: str
    instead: str


def hits(path: str, text: str) -> Iterator[Hit]:
    """The hits of one file: .py (comments, docstrings, bound names), .md (outside of code blocks), .js (comments)."""
    for line, prose in _prose(path, text):
        for phrase, pattern in _PATTERNS.items():
            for match in pattern.finditer(prose):
                if match[0].lower() not in ALLOWED:
                    yield Hit(path, line, match[0].lower(), PHRASES[phrase])
    if path.endswith(".py"):
        for node in ast.walk(ast.parse(text)):
            name = node.arg if isinstance(node, ast.arg) else _stored_name(node)
            if name in NAMES - ALLOWED:
                yield Hit(path, getattr(node, "lineno", 0), f"name {name}", "say what it holds")


def _stored_name(node: ast.AST) -> str:
    return node.id if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) else ""


def _prose(path: str, text: str) -> Iterator[tuple[int, str]]:
    """Line number and text of every line of prose."""
    if path.endswith(".md"):
        yield from enumerate(_CODE_BLOCK.sub(lambda block: "\n" * block[0].count("\n"), text).splitlines(), 1)
    elif path.endswith(".js"):
        yield from (
            (number, line.partition("//")[2]) for number, line in enumerate(text.splitlines(), 1) if "//" in line
        )
    else:
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                yield token.start[0], token.string
        for node in ast.walk(ast.parse(text)):
            documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
            if documented and (docstring := ast.get_docstring(node, clean=False)):
                yield from enumerate(docstring.splitlines(), node.body[0].lineno)


def _tracked() -> list[str]:
    listed = subprocess.run(["git", "ls-files", "*.py", "*.md", "*.js"], capture_output=True, text=True, check=True)
    return [path for path in listed.stdout.split() if "/vendor/" not in path]


def main(paths: list[str]) -> int:
    """Print the hits; without paths compare the count of all tracked files with CEILING. Returns the exit status."""
    files = {path: Path(path).read_text(encoding="utf-8") for path in paths or _tracked()}
    everything = [hit for path, text in files.items() for hit in hits(path, text)]
    lines = sum(text.count("\n") for text in files.values())
    if paths:
        for hit in everything:
            print(f"{hit.path}:{hit.line}: {hit.word}: {hit.instead}")
    elif len(everything) > CEILING:
        for word, count in Counter(hit.word for hit in everything).most_common(20):
            print(f"{count:5d}  {word}")
    print(f"{len(everything)} hits in {lines} lines: {1000 * len(everything) / max(lines, 1):.1f} per 1,000")
    if paths or len(everything) <= CEILING:
        return 0
    print(
        f"more than {CEILING}: rewrite new sentences; `python -m docs.make.plain_words FILE` lists the hits of a file"
    )
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
