import hashlib
import math
import shutil

import pytest

from hoidata.files import atomic_file, atomic_folder, canonical_json, sha256_bytes, sha256_file


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
    seen = []
    rmtree = shutil.rmtree

    def watched(folder, **options):
        if any(folder.glob("*")):
            seen.append((folder != target, [path.name for path in target.iterdir()]))
        rmtree(folder, **options)

    monkeypatch.setattr(shutil, "rmtree", watched)
    with atomic_folder(target) as part:
        (part / "new").write_text("2")
    assert seen == [(True, ["new"])]


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
