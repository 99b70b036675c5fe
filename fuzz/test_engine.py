"""The fuzzer itself: it finds what it is there for, the same each time. And its share of `make test`."""

import os
import random
import signal
import subprocess
import sys
import time
import warnings
from functools import cache
from pathlib import Path

import pytest

from fuzz.__main__ import problems
from fuzz.coverage import lines_of, lines_reached
from fuzz.engine import Target, check_call, fuzz
from fuzz.structure import npy_bytes, npy_mutation, pickle_mutation, zip_mutation
from fuzz.targets import all_targets, scratch_folder
from hoidata.errors import BadInput, HoidataError

pytestmark = pytest.mark.first
PROJECT = Path(__file__).parents[1]
SECONDS_EACH = 0.4


def branching(data: bytes) -> int:
    if data.startswith(b"a"):
        if data[1:2] == b"b":
            return 2
        return 1
    raise BadInput("x", "an a", "none")


def test_a_tracer_counts_the_lines_of_the_named_function_only():
    assert len(lines_of([branching])) == 5
    assert len(lines_reached([branching], branching, [b"ac", b"ax"])) == 3
    assert lines_reached([branching], branching, [b"", b"ac", b"ab"]) == lines_of([branching])


@pytest.mark.parametrize("change", [pickle_mutation((b"N", b"]")), npy_mutation(lambda _, body: body)])
def test_mutations_depend_on_the_seed_alone_and_differ(change):
    files = {"pickle": b"\x80\x02]K\x01a.", "npy": npy_bytes({"shape": ()}, b"")}
    for data in files.values():
        first, again = ([change(random.Random(seed), data) for seed in range(60)] for _ in range(2))
        assert first == again
    assert max(len({change(random.Random(seed), data) for seed in range(60)}) for data in files.values()) > 5


def test_every_parser_accepts_a_seed_and_no_seed_is_a_fault():
    for name, target in all_targets().items():
        with scratch_folder():
            for data in target.seeds():
                check_call(target, data)
            assert name == "store-info" or any(accepts(target, data) for data in target.seeds()), name


def accepts(target: Target, data: bytes) -> bool:
    try:
        target.run(data)
    except HoidataError:
        return False
    return True


def fragile(data: bytes) -> None:
    """One way to fail, or to be slow, for each first letter."""
    if data[:1] == b"k":
        raise KeyError("k")
    if data[:1] == b"w":
        warnings.warn("w", stacklevel=1)
    if data[:1] == b"m":
        try:
            bytearray(3 << 30)
        except MemoryError as error:
            raise BadInput("x", "less", repr(error)) from None
    if data[:1] == b"s":
        while time.process_time() < deadline(1.1):
            pass
    if data[:1] == b"d":
        os.kill(os.getpid(), signal.SIGSEGV)
    raise BadInput("x", "y", "z")


@cache
def deadline(seconds: float) -> float:
    return time.process_time() + seconds


@pytest.mark.slow
@pytest.mark.parametrize(
    ("data", "what"),
    [(b"k", "KeyError"), (b"w", "UserWarning"), (b"m", "MemoryError"), (b"s", "TimeoutError"), (b"d", "ended with")],
)
def test_exceptions_warnings_memory_slow_calls_and_crashes_are_faults_and_their_input_is_saved(tmp_path, data, what):
    outcome = fuzz(Target("fragile", lambda: [b"ok", data], fragile, [fragile]), 0, 1, 20, tmp_path)
    assert what in outcome.fault
    assert Path(outcome.input_path).read_bytes() == data
    assert problems(outcome, full=False)


def test_a_parser_without_faults_is_run_as_often_as_asked(tmp_path):
    outcome = fuzz(Target("fragile", lambda: [b"ok", b"ab", b"ac"], branching, [branching]), 0, 3000, 20, tmp_path)
    assert (outcome.fault, outcome.missing) == ("", [])
    assert outcome.executions == 3000
    assert problems(outcome, full=True) == []


def run_python(*words: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, *words], cwd=PROJECT, env=environment, capture_output=True, text=True)


@pytest.mark.long
def test_a_short_run_of_fuzzing_finds_nothing(tmp_path: Path):
    options = ("--seconds", str(SECONDS_EACH), "--executions", "50000", "--seed", "1", "--folder", str(tmp_path))
    done = run_python("-m", "fuzz", *options)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    assert done.stdout.count("no fault") == len(all_targets())


def test_the_parsers_named_by_the_issue_are_all_there():
    assert isinstance(next(iter(all_targets().values())), Target)
    assert set(all_targets()) >= {
        "pickle-arrays", "pickle-mano", "pickle-torch", "npy", "npy-object", "npz-object", "npz-read", "npz-map",
        "mano-file", "obj", "ply-ascii", "ply-binary", "bvh", "gzip-text", "h2o-rows", "h2o-segments",
        "arctic-descriptions", "arctic-parts", "arctic-misc", "manipnet-hand-reference", "manifest", "hoidata-toml",
        "params-yaml", "store-info",
    }  # fmt: skip


def test_zips_are_put_together_again_with_sums_that_fit():
    from fuzz import seeds

    change = zip_mutation(lambda _, content: content)
    whole = seeds.npz_files(False)[0]
    assert any(change(random.Random(seed), whole) != whole for seed in range(20))
