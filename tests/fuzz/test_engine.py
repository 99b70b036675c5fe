"""The fuzzer itself: it finds what it is there for, the same each time. And its one-minute share of `make test`."""

import os
import random
import re
import subprocess
import sys
from pathlib import Path

import pytest

from hoidata.errors import BadInput
from tests.fuzz.coverage import LineCoverage, code_objects
from tests.fuzz.engine import Target
from tests.fuzz.mutation import mutate
from tests.fuzz.structure import json_mutation, npy_bytes, npy_mutation, pickle_mutation, zip_mutation
from tests.fuzz.targets import all_targets

PROJECT = Path(__file__).parents[2]
SECONDS_EACH = 2.0


def branching(data: bytes) -> int:
    if data.startswith(b"a"):
        if data[1:2] == b"b":
            return 2
        return 1
    raise BadInput("x", "an a", "none")


def test_a_tracer_counts_the_lines_of_the_named_function_only():
    coverage = LineCoverage(code_objects([branching]))
    assert len(coverage.lines) == 5
    assert coverage.trace(branching, b"ac")
    assert not coverage.trace(branching, b"ax")
    assert len(coverage.reached) == 3
    with pytest.raises(BadInput):
        coverage.trace(branching, b"")
    assert coverage.trace(branching, b"ab")
    assert coverage.share == 1
    assert coverage.missing == []


@pytest.mark.parametrize("change", [json_mutation, pickle_mutation((b"N", b"]")), npy_mutation(lambda _, body: body)])
def test_mutations_depend_on_the_seed_alone_and_differ(change):
    files = {"json": b'{"a": [1, 2, {"b": null}]}', "pickle": b"\x80\x02]K\x01a.", "npy": npy_bytes({"shape": ()}, b"")}
    for data in files.values():
        first, again = ([change(random.Random(seed), data) for seed in range(60)] for _ in range(2))
        assert first == again
    assert max(len({change(random.Random(seed), data) for seed in range(60)}) for data in files.values()) > 5
    assert mutate(random.Random(5), b"12 34", [b"x"], [b"y"]) == mutate(random.Random(5), b"12 34", [b"x"], [b"y"])


def test_every_parser_accepts_a_seed_and_no_seed_is_a_fault():
    for name, target in all_targets().items():
        accepted = 0
        for data in target.seeds():
            try:
                target.run(data)
                accepted += 1
            except BadInput:
                continue
            except Exception as error:
                assert type(error).__name__ == "MissingResource", name  # noqa: PT017
        assert accepted or name == "store-info", name


FAULTS = """
import sys, time
from pathlib import Path
import numpy as np
from hoidata.errors import BadInput
from tests.fuzz.engine import Target, fuzz

def fragile(data):
    if data[:1] == b"k": raise KeyError("k")
    if data[:1] == b"m":
        try: bytearray(3 << 30)
        except MemoryError as error: raise BadInput("x", "less", repr(error))
    if data[:1] == b"s": time.sleep(1.1)
    raise BadInput("x", "y", "z")

outcome = fuzz(Target("fragile", lambda: [b"ok", b"k", b"m", b"s"], fragile, [fragile]), 0, 4, 60, Path(sys.argv[1]))
print(sorted(fault["what"][:8] for fault in outcome.faults), outcome.executions)
"""


@pytest.mark.slow
def test_exceptions_memory_and_slow_calls_are_faults_and_their_inputs_are_saved(tmp_path: Path):
    done = run_python("-c", FAULTS, str(tmp_path))
    assert done.stdout.strip().endswith("4"), done.stderr
    assert re.search(r"1\.1\d s", done.stdout) or "1.10 s" in done.stdout
    assert "KeyError" in done.stdout
    assert "memory: " in done.stdout
    assert sorted(path.read_bytes() for path in (tmp_path / "fragile").iterdir()) == [b"k", b"m", b"s"]


def run_python(*words: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, *words], cwd=PROJECT, env=environment, capture_output=True, text=True)


@pytest.mark.slow
def test_a_minute_of_fuzzing_finds_nothing(tmp_path: Path):
    options = ("--seconds", str(SECONDS_EACH), "--executions", "50000", "--seed", "1", "--folder", str(tmp_path))
    done = run_python("-m", "tests.fuzz", *options)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    assert done.stdout.count("faults 0") == len(all_targets())


def test_the_parsers_named_by_the_issue_are_all_there():
    assert isinstance(next(iter(all_targets().values())), Target)
    assert set(all_targets()) >= {
        "pickle-arrays", "pickle-mano", "pickle-torch", "npy", "npy-object", "npz-object", "npz-read", "npz-map",
        "mano-file", "obj", "ply-ascii", "ply-binary", "bvh", "gzip-text", "h2o-rows", "h2o-segments",
        "arctic-descriptions", "arctic-parts", "arctic-misc", "manipnet-hand-reference", "manifest", "hoidata-toml",
        "params-yaml", "store-info",
    }  # fmt: skip


def test_zips_are_put_together_again_with_sums_that_fit():
    from tests.fuzz import seeds

    change = zip_mutation(lambda _, content: content)
    whole = seeds.npz_files(False)[0]
    assert any(change(random.Random(seed), whole) != whole for seed in range(20))
