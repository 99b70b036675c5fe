"""Seeds are valid files, faults are detected, and a short run finds no fault."""

import io
import pickle
import random
import subprocess
import sys
import time
import warnings
import zipfile
from pathlib import Path

import pytest

from fuzz.engine import Target, change_pickle, change_zip, check_call
from fuzz.targets import all_targets
from hoidata.errors import BadInput, HoidataError

pytestmark = pytest.mark.first
PROJECT = Path(__file__).parents[1]


def accepts(target: Target, data: bytes, folder: Path) -> bool:
    try:
        target.run(data, folder)
    except HoidataError:
        return False
    return True


@pytest.mark.slow
def test_every_parser_accepts_a_seed_and_no_seed_is_a_fault(tmp_path):
    for name, target in all_targets().items():
        seeds = target.seeds()
        for data in seeds:
            check_call(target, data, tmp_path)
        assert name == "store-info" or any(accepts(target, data, tmp_path) for data in seeds), name


def fragile(data: bytes, _: Path) -> None:
    """A parser that fails in one way for each content."""
    if data == b"KeyError":
        raise KeyError
    if data == b"warning":
        warnings.warn("w", stacklevel=1)
    end_s = time.process_time() + (1.1 if data == b"slow" else 0)
    while time.process_time() < end_s:
        pass
    raise BadInput("x", "less", repr(MemoryError()) if data == b"memory" else "z")


FRAGILE = Target(lambda: [], fragile)


@pytest.mark.parametrize(
    ("data", "fault"),
    [(b"KeyError", KeyError), (b"warning", UserWarning), (b"memory", BadInput), (b"slow", TimeoutError)],
)
def test_exceptions_warnings_refused_memory_and_slow_calls_are_faults(tmp_path, data, fault):
    with pytest.raises(fault):
        check_call(FRAGILE, data, tmp_path)
    check_call(FRAGILE, b"", tmp_path)


FAULT = """
import os, signal, sys
from pathlib import Path
from fuzz import engine
def fragile(data, folder):
    if data == b"crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    raise KeyError if data == b"raise" else engine.BadInput("x", "y", "z")
target = engine.Target(lambda: [b"ok", sys.argv[1].encode()], fragile)
engine.fuzz("fragile", target, 0, 1, 20, Path(sys.argv[2]))
"""


def run_python(*words: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, *words], cwd=PROJECT, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("data", ["crash", "raise"])
def test_the_input_of_a_fault_is_saved(tmp_path, data):
    done = run_python("-c", FAULT, data, str(tmp_path))
    assert done.returncode, done.stderr
    (saved,) = (tmp_path / "fragile").glob("crash-*")
    assert saved.read_text() == data


@pytest.mark.long
def test_a_short_run_of_fuzzing_finds_nothing(tmp_path):
    done = run_python("-m", "fuzz", "--seconds", "1", "--seed", "1", "--jobs", "2", "--folder", str(tmp_path))
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    assert done.stdout.count("no fault") == len(all_targets())


def test_every_parser_of_files_from_outside_is_a_target():
    assert set(all_targets()) == {
        "pickle-arrays", "pickle-mano", "pickle-torch", "mano-file", "npy", "npy-object", "npz-object", "npz-pieces",
        "npz-read", "npz-map", "obj", "ply-ascii", "ply-binary", "glb", "stl", "urdf", "bvh", "gzip-text", "h2o-rows",
        "h2o-segments", "arctic-descriptions", "arctic-parts", "arctic-misc", "trajectories-csv",
        "trajectories-manipnet", "trajectories-npz", "hoi4d-camera", "hoi4d-hand", "hoi4d-json", "hot3d-hands",
        "hot3d-tables", "hot3d-tar", "hot3d-json", "oakink2-annotation", "oakink2-json", "object-keyframes",
        "manipnet-hand-reference", "manifest", "hoidata-toml", "params-yaml", "store-info",
    }  # fmt: skip


def test_changed_containers_are_sound_and_follow_the_seed(monkeypatch):
    monkeypatch.setattr("fuzz.engine.atheris.Mutate", lambda content, longest: content[::-1])
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in ("a.npy", "b.npy"):
            archive.writestr(zipfile.ZipInfo(name), f"content of {name}")
    for change, data in ((change_zip, stream.getvalue()), (change_pickle, pickle.dumps([1, "a", {"b": 2.5}], 4))):
        first, again = ([change(random.Random(seed), data, 1 << 14) for seed in range(60)] for _ in range(2))
        assert first == again
        assert len(set(first)) > 5
        for changed in first if change is change_zip else ():
            with zipfile.ZipFile(io.BytesIO(changed)) as archive:
                assert archive.testzip() is None
