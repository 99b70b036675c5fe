"""Text features kept on disk between runs, so that no sentence is encoded twice by the same encoder.

    <folder>/<digest of the encoder's identity>/<digest of the content>.npz

One folder per encoder, so features of two encoders never meet. Each file holds what one run encoded: identity JSON
bytes, texts (a JSON list as bytes), features (text, dims) float32 and the SHA-256 of all three. Files are only ever
added whole or deleted, never changed: any number of processes may work at once.

A cache is a convenience and never trusted blindly. A file that is damaged, of another encoder, or whose features the
encoder does not confirm on one of the texts asked for is left out with a message, deleted and made again. What cannot
be written costs a message and nothing else.
"""

import hashlib
import json
import logging
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hoidata.annotation.encoders import Identity, TextEncoder
from hoidata.errors import BadInput
from hoidata.files import canonical_json, sha256_bytes
from hoidata.files.arrays import read_npz, write_npz

MEMBERS = {"identity", "texts", "features", "sha256"}
MOST_FILES = 16
logger = logging.getLogger(__name__)


class DiskCachedEncoder:
    """``encoder`` with its features kept under ``folder``; ``encode`` gives what the encoder itself would give."""

    def __init__(self, encoder: TextEncoder, folder: str | Path) -> None:
        self.identity = encoder.identity
        self._encoder = encoder
        self._cache = FeatureCache(folder, encoder.identity)

    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        """(sentence, dims) float32, as the encoder's own."""
        known = self._confirmed(set(sentences))
        fresh = [text for text in dict.fromkeys(sentences) if text not in known]
        if not fresh:
            return np.stack([known[text] for text in sentences]) if known else self._encoder.encode([])
        made = np.asarray(self._encoder.encode(fresh), np.float32)
        self._cache.add(fresh, made)
        known.update(zip(fresh, made, strict=True))
        return np.stack([known[text] for text in sentences])

    def _confirmed(self, wanted: set[str]) -> dict[str, np.ndarray]:
        """Features of the wanted texts from files whose first wanted text the encoder gives the same bytes for.

        The same weights on another processor or another version of a numeric library differ in the last bits.
        """
        known: dict[str, np.ndarray] = {}
        for kept in self._cache.files():
            rows = {text: row for text, row in zip(kept.texts, kept.features, strict=True) if text in wanted}
            if not rows:
                continue
            text = next(iter(rows))
            if np.asarray(self._encoder.encode([text]), np.float32)[0].tobytes() == rows[text].tobytes():
                known.update(rows)
            else:
                _discard(kept.path, f"the encoder gives other numbers for {text!r} here")
        return known


@dataclass(frozen=True)
class KeptFeatures:
    """One file of the cache: texts and their features (text, dims) float32."""

    path: Path
    texts: list[str]
    features: np.ndarray


class FeatureCache:
    """The files of one encoder under ``folder`` (see the module's text). Nothing here raises for a bad file."""

    def __init__(self, folder: str | Path, identity: Identity) -> None:
        self._identity = canonical_json(identity)
        self._dims = int(identity["dims"])
        self.folder = Path(folder) / sha256_bytes(self._identity.encode())[:32]

    def files(self) -> list[KeptFeatures]:
        """Every sound file, by name; damaged ones are deleted."""
        found = []
        for path in sorted(self.folder.glob("*.npz")):
            try:
                found.append(self._read(path))
            except (BadInput, OSError) as error:
                if path.exists():  # else another process has just merged it into a larger one
                    _discard(path, str(error))
        return found

    def add(self, texts: Sequence[str], features: np.ndarray) -> None:
        """Keep features of further texts; many small files become one."""
        try:
            self._write(texts, features)
            if len(list(self.folder.glob("*.npz"))) > MOST_FILES:
                self._merge()
        except OSError as error:
            logger.warning("text features are not kept in %s: %s", self.folder, error)

    def _merge(self) -> None:
        """All files as one. Only what was read into it is deleted, so nothing another process adds is lost."""
        kept = self.files()
        if len(kept) < 2:
            return
        rows = {text: row for file in kept for text, row in zip(file.texts, file.features, strict=True)}
        merged = self._write(list(rows), np.stack(list(rows.values())))
        for path in {file.path for file in kept} - {merged}:
            path.unlink(missing_ok=True)

    def _write(self, texts: Sequence[str], features: np.ndarray) -> Path:
        arrays = {
            "identity": _bytes(self._identity),
            "texts": _bytes(json.dumps(list(texts))),
            "features": np.asarray(features, np.float32),
        }
        digest = _digest(arrays.values())
        path = self.folder / f"{digest[:32]}.npz"
        write_npz(path, {**arrays, "sha256": _bytes(digest)})
        return path

    def _read(self, path: Path) -> KeptFeatures:
        """Raises BadInput for anything but a file ``_write`` made for this encoder."""
        arrays = read_npz(path)
        if set(arrays) != MEMBERS:
            raise BadInput(path, f"arrays {', '.join(sorted(MEMBERS))}", ", ".join(sorted(arrays)), "delete it")
        digest = arrays.pop("sha256").tobytes()
        if digest != _digest(arrays[name] for name in ("identity", "texts", "features")).encode():
            raise BadInput(path, "arrays with the digest they were written with", "another digest", "delete it")
        if arrays["identity"].tobytes() != self._identity.encode():
            raise BadInput(path, f"features of {self._identity}", "another encoder's", "delete it")
        texts, features = _texts(path, arrays["texts"]), arrays["features"]
        if features.shape != (len(texts), self._dims) or features.dtype != np.float32:
            raise BadInput(path, f"{len(texts)} x {self._dims} float32", f"{features.shape}", "delete it")
        return KeptFeatures(path, texts, features)


def _discard(path: Path, why: str) -> None:
    logger.warning("text features in %s are left out and made again: %s", path, why)
    with suppress(OSError):
        path.unlink()


def _texts(path: Path, array: np.ndarray) -> list[str]:
    try:
        texts = json.loads(array.tobytes())
    except (ValueError, RecursionError) as error:
        raise BadInput(path, "a JSON list of texts", str(error)[:100], "delete it") from error
    if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
        raise BadInput(path, "a JSON list of texts", str(texts)[:100], "delete it")
    return texts


def _bytes(text: str) -> np.ndarray:
    return np.frombuffer(text.encode(), np.uint8)


def _digest(arrays: Iterable[np.ndarray]) -> str:
    """SHA-256 over the lengths and bytes of the arrays."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(b"%d:" % array.nbytes)
        digest.update(array.tobytes())
    return digest.hexdigest()
