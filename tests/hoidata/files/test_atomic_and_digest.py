import hashlib
import math
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hoidata.errors import BadInput
from hoidata.files import atomic_file, atomic_folder, canonical_json, sha256_bytes, sha256_file
from hoidata.files.atomic import exclusive, remove_dead_leftovers, remove_leftovers


def write_half_a_file(target):
    with atomic_file(target) as part:
        part.write_text("half")
        raise RuntimeError("stop")


def write_half_a_folder(target):
    with atomic_folder(target) as part:
        (part / "half").write_text("2")
        raise RuntimeError("stop")


def test_file_appears_only_when_the_block_ends_well(tmp_path):
    target = tmp_path / "deep" / "a.txt"
    with atomic_file(target) as part:
        part.write_text("new")
        assert not target.exists()
    assert target.read_text() == "new"
    with pytest.raises(RuntimeError, match="stop"):
        write_half_a_file(target)
    assert target.read_text() == "new"
    assert list(target.parent.iterdir()) == [target]


def test_folder_is_replaced_as_a_whole_or_not_at_all(tmp_path):
    target = tmp_path / "store"
    with atomic_folder(target) as part:
        (part / "old").write_text("1")
    with pytest.raises(RuntimeError, match="stop"):
        write_half_a_folder(target)
    assert [path.name for path in target.iterdir()] == ["old"]
    with atomic_folder(target) as part:
        (part / "new").write_text("3")
    assert [path.name for path in target.iterdir()] == ["new"]
    assert list(tmp_path.iterdir()) == [target]


def test_a_folder_is_never_seen_half_deleted(tmp_path, monkeypatch):
    target = tmp_path / "store"
    with atomic_folder(target) as part:
        (part / "old").write_text("1")
    states = []
    rmtree = shutil.rmtree

    def watched(folder, **options):
        if any(folder.glob("*")):
            states.append((folder != target, [path.name for path in target.iterdir()]))
        rmtree(folder, **options)

    monkeypatch.setattr(shutil, "rmtree", watched)
    with atomic_folder(target) as part:
        (part / "new").write_text("2")
    assert states == [(True, ["new"])]


def test_leftovers_of_killed_writers_are_removed_and_nothing_else(tmp_path):
    target = tmp_path / "clips"
    target.mkdir()
    for name in (".clips.abcd1234.part", ".clips.efgh5678.old"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "half").write_text("x")
    (tmp_path / ".clips.file0000.part").write_text("half")
    others = {".clips.work", ".clips.v2.abcd1234.part", ".clip.abcd1234.part", "clips.part", ".clipsX.abcd1234.old"}
    for name in others:
        (tmp_path / name).mkdir()
    remove_leftovers(target)
    assert {path.name for path in tmp_path.iterdir()} == {"clips", *others}
    remove_leftovers(tmp_path / "nowhere" / "clips")


def killed_writer(target: Path) -> None:
    """A process that is killed while it writes a folder and a file."""
    code = (
        "import os, signal, sys\n"
        "from hoidata.files import atomic_file, atomic_folder\n"
        "with atomic_folder(sys.argv[1]) as part, atomic_file(sys.argv[1] + '.json'):\n"
        "    (part / 'half').write_text('x')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert subprocess.run([sys.executable, "-c", code, str(target)], check=False).returncode == -signal.SIGKILL


def test_the_next_writer_of_a_folder_removes_leftovers_of_killed_writers_only(tmp_path):
    target = tmp_path / "length"
    killed_writer(target)
    killed_writer(tmp_path / "contact")
    assert len(list(tmp_path.glob(".length.[!j]*.part"))) == 1
    with atomic_folder(target):
        living = list(tmp_path.glob(".length.[!j]*.part"))
        assert len(living) == 1
        with atomic_folder(target) as second:  # another writer of the same folder
            (second / "new").write_text("2")
        assert living[0].is_dir()
    remove_dead_leftovers(tmp_path / "length.json")
    left = sorted(path.name.split(".")[1] for path in tmp_path.iterdir() if path.name.startswith("."))
    assert left == ["contact", "contact"]


def test_a_renamed_old_folder_is_restored(tmp_path):
    aside = tmp_path / ".clips.abcd1234.old"
    aside.mkdir()
    (aside / "old").write_text("1")
    (tmp_path / ".clips.abcd1234.part").mkdir()
    remove_leftovers(tmp_path / "clips")
    assert [path.name for path in tmp_path.iterdir()] == ["clips"]
    assert (tmp_path / "clips" / "old").read_text() == "1"


def test_only_one_may_write_and_the_lock_leaves_no_file(tmp_path):
    target = tmp_path / "deep" / "clips"
    taken = rf"process {os.getpid()} at work on it; wait for that run"
    with exclusive(target), pytest.raises(BadInput, match=taken), exclusive(target, wait_s=0.1):
        pass
    with exclusive(target, wait_s=0.1), exclusive(tmp_path / "deep" / "other", wait_s=0.1):
        pass
    assert list(target.parent.iterdir()) == []


HOLDER = """
import fcntl, subprocess, sys, time
lock = open(sys.argv[1], "w")
fcntl.flock(lock, fcntl.LOCK_EX)
subprocess.Popen(["sleep", "1"], pass_fds=[lock.fileno()])
print("held", flush=True)
time.sleep(60)
"""


def test_the_lock_of_a_killed_process_is_free_when_the_last_of_its_workers_has_ended(tmp_path):
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path / ".clips.lock")], stdout=subprocess.PIPE)
    assert holder.stdout is not None
    holder.stdout.readline()
    holder.kill()
    holder.wait()
    holder.stdout.close()
    with pytest.raises(BadInput, match="at work on it"), exclusive(tmp_path / "clips", wait_s=0.1):
        pass
    with exclusive(tmp_path / "clips"):
        assert [path.name for path in tmp_path.iterdir()] == [".clips.lock"]
    assert list(tmp_path.iterdir()) == []


def test_digests_of_file_and_bytes_agree(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert sha256_file(tmp_path / "a") == sha256_bytes(b"abc") == hashlib.sha256(b"abc").hexdigest()


def test_canonical_json_does_not_depend_on_the_order_of_keys_and_refuses_nan():
    assert (
        canonical_json({"b": 1, "a": [1.5, "ü"]})
        == canonical_json({"a": [1.5, "ü"], "b": 1})
        == '{"a":[1.5,"ü"],"b":1}'
    )
    with pytest.raises(ValueError, match="Out of range"):
        canonical_json({"a": math.nan})
