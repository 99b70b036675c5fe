"""Text features kept on disk: the same numbers cold, warm or damaged, never another encoder's, safe for two at once."""

import logging
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hoidata.annotation.encoders import HashEncoder
from hoidata.annotation.feature_cache import MOST_FILES, DiskCachedEncoder

TEXTS = [f"Lift object {number} with both hands." for number in range(40)]


class Counting(HashEncoder):
    """Counts the texts it is really asked for; ``shift`` makes its numbers another machine's."""

    def __init__(self, shift: float = 0.0) -> None:
        super().__init__()
        self.seen: list[str] = []
        self.shift = np.float32(shift)

    def encode(self, sentences):
        self.seen += list(sentences)
        return super().encode(sentences) + self.shift


def files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.npz"))


def test_a_second_process_finds_the_features_and_encodes_one_text_to_be_sure(tmp_path: Path) -> None:
    first = DiskCachedEncoder(Counting(), tmp_path).encode(TEXTS)
    inner = Counting()
    again = DiskCachedEncoder(inner, tmp_path).encode(TEXTS[::-1])
    assert len(inner.seen) == 1
    assert again[::-1].tobytes() == first.tobytes() == HashEncoder().encode(TEXTS).tobytes()


def test_only_new_texts_are_encoded_and_repeated_ones_once(tmp_path: Path) -> None:
    DiskCachedEncoder(HashEncoder(), tmp_path).encode(TEXTS[:10])
    inner = Counting()
    found = DiskCachedEncoder(inner, tmp_path).encode([TEXTS[20], TEXTS[3], TEXTS[20], "with NUL\0", "with NUL"])
    assert sorted(inner.seen) == sorted([TEXTS[3], TEXTS[20], "with NUL\0", "with NUL"])
    assert found.tobytes() == HashEncoder().encode([TEXTS[20], TEXTS[3], TEXTS[20], "with NUL\0", "with NUL"]).tobytes()
    assert DiskCachedEncoder(HashEncoder(), tmp_path).encode([]).shape == (0, 512)


@pytest.mark.parametrize("where", [0.01, 0.3, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("harm", ["flip", "cut"])
def test_a_damaged_file_is_left_out_with_a_message_and_made_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, harm: str, where: float
) -> None:
    first = DiskCachedEncoder(HashEncoder(), tmp_path).encode(TEXTS)
    (path,) = files(tmp_path)
    sound = path.read_bytes()
    place = int(len(sound) * where)
    flipped = bytes([sound[place] ^ 0x10])
    path.write_bytes(sound[:place] if harm == "cut" else sound[:place] + flipped + sound[place + 1 :])
    inner = Counting()
    with caplog.at_level(logging.WARNING):
        assert DiskCachedEncoder(inner, tmp_path).encode(TEXTS).tobytes() == first.tobytes()
    if len(inner.seen) > 1:  # a flip in a field no reader looks at (a time stamp) harms nothing
        assert "left out and made again" in caplog.text
        assert files(tmp_path)[0].read_bytes() == sound


def test_a_pickle_in_the_place_of_a_file_is_never_executed(tmp_path: Path) -> None:
    class Harmful:
        def __reduce__(self):
            return Path.touch, (tmp_path / "executed",)

    DiskCachedEncoder(HashEncoder(), tmp_path / "cache").encode(TEXTS)
    (path,) = files(tmp_path / "cache")
    path.write_bytes(pickle.dumps(Harmful()))
    np.savez(path.with_name("objects.npz"), sha256=np.array([Harmful()], object))
    found = DiskCachedEncoder(HashEncoder(), tmp_path / "cache").encode(TEXTS)
    assert found.tobytes() == HashEncoder().encode(TEXTS).tobytes()
    assert not (tmp_path / "executed").exists()
    assert len(files(tmp_path / "cache")) == 1


def test_features_of_another_encoder_are_never_given_even_when_moved_into_its_folder(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = HashEncoder()
    other.identity = {**other.identity, "version": "2"}
    DiskCachedEncoder(other, tmp_path).encode(TEXTS)
    DiskCachedEncoder(HashEncoder(), tmp_path).encode(TEXTS[:1])
    theirs, ours = sorted({path.parent for path in files(tmp_path)}, key=lambda folder: len(_texts(folder)))[::-1]
    assert theirs != ours
    for path in theirs.glob("*.npz"):
        path.rename(ours / path.name)
    inner = Counting()
    DiskCachedEncoder(inner, tmp_path).encode(TEXTS)
    assert set(TEXTS[1:]) <= set(inner.seen)
    assert "another encoder's" in caplog.text


def test_numbers_of_another_machine_are_noticed_by_one_text(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    DiskCachedEncoder(Counting(shift=1e-6), tmp_path).encode(TEXTS)
    found = DiskCachedEncoder(HashEncoder(), tmp_path).encode(TEXTS[5:])
    assert found.tobytes() == HashEncoder().encode(TEXTS[5:]).tobytes()
    assert "gives other numbers" in caplog.text


def test_features_changed_behind_a_sound_archives_back_are_noticed(tmp_path: Path) -> None:
    """Written anew with correct checksums of its members, and with the first text's feature left as it was."""
    first = DiskCachedEncoder(HashEncoder(), tmp_path).encode(TEXTS)
    (path,) = files(tmp_path)
    arrays = dict(np.load(path))
    arrays["features"][5] *= 2
    np.savez(path, **arrays)
    assert DiskCachedEncoder(HashEncoder(), tmp_path).encode(TEXTS).tobytes() == first.tobytes()


def test_many_small_files_become_one_and_nothing_is_lost(tmp_path: Path) -> None:
    for text in TEXTS[: MOST_FILES + 1]:
        DiskCachedEncoder(HashEncoder(), tmp_path).encode([text])
    assert len(files(tmp_path)) == 1
    inner = Counting()
    DiskCachedEncoder(inner, tmp_path).encode(TEXTS[: MOST_FILES + 1])
    assert len(inner.seen) == 1


def test_a_folder_that_cannot_be_written_costs_a_message(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("in the way")
    found = DiskCachedEncoder(HashEncoder(), tmp_path / "file").encode(TEXTS)
    assert found.tobytes() == HashEncoder().encode(TEXTS).tobytes()
    assert "are not kept" in caplog.text


ONE_BY_ONE = """
import sys
from hoidata.annotation.encoders import HashEncoder
from hoidata.annotation.feature_cache import DiskCachedEncoder
for number in range(40):
    text = f"Lift object {(number + int(sys.argv[2])) % 40} with both hands."
    encoder = HashEncoder()
    assert DiskCachedEncoder(encoder, sys.argv[1]).encode([text]).tobytes() == encoder.encode([text]).tobytes()
"""


@pytest.mark.slow
def test_processes_at_once_lose_nothing_and_read_nothing_half_written(tmp_path: Path) -> None:
    """Each adds one text at a time, so that files are merged while others read and write."""
    commands = [[sys.executable, "-c", ONE_BY_ONE, str(tmp_path), start] for start in ("0", "1", "20")]
    workers = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for command in commands]
    assert [(worker.communicate()[1], worker.returncode) for worker in workers] == [("", 0)] * 3
    inner = Counting()
    found = DiskCachedEncoder(inner, tmp_path).encode(TEXTS)
    assert found.tobytes() == HashEncoder().encode(TEXTS).tobytes()
    assert len(inner.seen) <= len(files(tmp_path))
    assert not list(tmp_path.rglob("*.part"))


def _texts(folder: Path) -> bytes:
    return b"".join(path.read_bytes() for path in folder.glob("*.npz"))
