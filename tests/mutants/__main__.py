"""Applies each fault of mutants.toml to a copy of the tree and asks whether the tests named beside it notice.

python -m tests.mutants [--only NUMBER_OR_TEXT] [--jobs 2]; exits with 1 if a fault survives or its text is gone.
"""

import argparse
import importlib
import multiprocessing
import os
import shutil
import subprocess
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).parents[2]
PRODUCT = ("hoidata", "models", "pipelines")
COPIES = ROOT / ".mutants"
PASSED, NO_RESULT = (0, 5), 99  # 5: none of these tests has the mark
LIMIT_S = 300.0  # a fault that makes the tests run on for ever is noticed too
HEAVY = ("numpy", "torch", "scipy.spatial.transform", "numba", "pandas", "pyarrow.parquet", "trimesh", "igl",
         "diffusers", "pytest", "rich.progress", "hypothesis.extra.numpy",
         "scipy.sparse.csgraph", "scipy.optimize")  # fmt: skip
KILLED, SURVIVED, STALE, BROKEN = "killed", "survived", "stale", "broken"


@dataclass(frozen=True)
class Mutant:
    number: int
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def target(self, root: Path) -> Path | None:
        """The file that has the text once: the one named, or, where code has moved, the only one of the product."""
        named = root / self.file
        if named.is_file() and named.read_text(encoding="utf-8").count(self.old) == 1:
            return named
        paths = [path for room in PRODUCT for path in (root / room).rglob("*.py")]
        found = [(path, path.read_text(encoding="utf-8").count(self.old)) for path in paths]
        holders = [(path, count) for path, count in found if count]
        return holders[0][0] if len(holders) == 1 and holders[0][1] == 1 else None

    def test_paths(self, root: Path) -> list[str]:
        """The tests named; where a file is no more, the nearest folder that is."""
        paths = [root / name for name in self.tests]
        there = [next(path for path in (named, *named.parents) if path.exists()) for named in paths]
        return sorted({str(path.relative_to(root)) for path in there})


def read_mutants() -> list[Mutant]:
    rows = tomllib.loads(Path(__file__).with_name("mutants.toml").read_text(encoding="utf-8"))["mutant"]
    return [Mutant(number, tests=tuple(row.pop("tests")), **row) for number, row in enumerate(rows, 1)]


def copied_tree(number: int) -> Path:
    """A copy of the files git knows or would add, kept between runs so that compiled functions stay."""
    copy = COPIES / str(number)
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    names = {name for name in listed.stdout.decode().split("\0") if name and (ROOT / name).is_file()}
    for path in [path for path in copy.rglob("*") if path.is_file() and "__pycache__" not in path.parts]:
        if str(path.relative_to(copy)) not in names:
            path.unlink()
    for name in sorted(names):
        source, target = ROOT / name, copy / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if not target.is_file() or target.stat().st_mtime_ns != source.stat().st_mtime_ns:
            shutil.copy2(source, target)
    return copy


def _run_pytest(copy: Path, tests: Sequence[str], marked: str) -> None:
    """In a process of its own: run the tests of the copy, and exit with pytest's code."""
    os.chdir(copy)
    sys.path[:] = [str(copy), *(entry for entry in sys.path if Path(entry or ".").resolve() != ROOT)]
    for name in [name for name in sys.modules if name.partition(".")[0] in (*PRODUCT, "tests")]:
        del sys.modules[name]
    with open(copy / ".mutants.log", "w") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    code = NO_RESULT
    try:
        os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
        quick = ("-x", "-q", "-p", "no:cacheprovider", "--assert=plain", "-m", marked)
        code = int(importlib.import_module("pytest").main([*quick, *tests]))
    finally:
        sys.stdout.flush()
        os._exit(code)


def exit_code(copy: Path, tests: Sequence[str], marked: str, limit_s: float | None = LIMIT_S) -> int | None:
    """Pytest's exit code for the tests with such marks, or none if it had to be ended."""
    process = multiprocessing.get_context("fork").Process(target=_run_pytest, args=(copy, tests, marked))
    process.start()
    process.join(limit_s)
    if process.exitcode is None:
        process.kill()
        process.join()
        return None
    return process.exitcode


def tried(mutant: Mutant, copy: Path) -> str:
    path = mutant.target(copy)
    if path is None:
        return STALE
    text, times = path.read_text(encoding="utf-8"), path.stat()
    path.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
    try:
        code = exit_code(copy, mutant.test_paths(copy), "not slow and not long")
        if code in PASSED:
            code = exit_code(copy, mutant.test_paths(copy), "slow or long")
    finally:
        path.write_text(text, encoding="utf-8")
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    return SURVIVED if code in PASSED else KILLED if code in (1, None) else BROKEN


def check_unchanged(mutants: Sequence[Mutant], copy: Path) -> None:
    """Refuse to go on unless the tests that are not slow pass as long as nothing is changed."""
    tests = sorted({path for mutant in mutants for path in mutant.test_paths(copy)})
    if exit_code(copy, tests, "not slow and not long", None) not in PASSED:
        raise SystemExit(f"the tests fail before anything is changed: {copy / '.mutants.log'}")


def try_all(mutants: Sequence[Mutant], jobs: int) -> Counter[str]:
    """Tries the faults in as many copies as jobs, prints each, and counts what became of them."""
    trees, copies = [copied_tree(number) for number in range(jobs)], SimpleQueue[Path]()
    check_unchanged(mutants, trees[0])
    for tree in trees:
        copies.put(tree)

    def verdict(mutant: Mutant) -> tuple[Mutant, str, float]:
        start, copy = time.monotonic(), copies.get()
        try:
            return mutant, tried(mutant, copy), time.monotonic() - start
        finally:
            copies.put(copy)

    counts: Counter[str] = Counter()
    with ThreadPoolExecutor(jobs) as pool:
        for mutant, found, seconds in pool.map(verdict, mutants):
            counts[found] += 1
            print(f"{mutant.number:4d} {found:8s} {seconds:5.1f} s  {mutant.file}: {mutant.old!r}", flush=True)
    return counts


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--only", default="", help="a number, or part of a file's or test's name")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    chosen = [
        mutant
        for mutant in read_mutants()
        if given.only == str(mutant.number)
        or (not given.only.isdigit() and given.only in " ".join((mutant.file, *mutant.tests)))
    ]
    if not chosen:
        raise SystemExit(f"--only {given.only}: no fault has this number, nor a file or test of that name")
    for name in HEAVY:
        importlib.import_module(name)
    counts = try_all(chosen, given.jobs)
    print(f"{len(chosen)} faults: " + ", ".join(f"{counts[name]} {name}" for name in (KILLED, SURVIVED, STALE, BROKEN)))
    return int(counts[KILLED] != len(chosen))


if __name__ == "__main__":
    sys.exit(main())
