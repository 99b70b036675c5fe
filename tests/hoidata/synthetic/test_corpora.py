"""The small corpora as a whole: the same bytes every time, sound throughout."""

import pytest

from hoidata.errors import HoidataError
from hoidata.files import sha256_file
from hoidata.synthetic.check import check_sequences
from hoidata.synthetic.corpus import write_corpus

pytestmark = pytest.mark.slow


def _digests(root) -> dict[str, str]:
    return {str(path.relative_to(root)): sha256_file(path) for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.mark.long
def test_a_corpus_is_the_same_bytes_for_any_number_of_jobs(small_corpus, tmp_path):
    write_corpus("grab", tmp_path / "together", seed=0, size="small", jobs=2)
    assert _digests(tmp_path / "together") == _digests(small_corpus("grab").raw)


@pytest.mark.parametrize("dataset", ["h2o", "grab", "arctic"])
def test_a_corpus_is_sound(dataset, small_corpus):
    figures = check_sequences(small_corpus(dataset).truths).iloc[0]
    assert figures["sequences"] == 8
    assert figures["pass %"] >= 98
    assert figures["largest hand-object distance mm"] < 20
    assert figures["largest penetration mm"] < 10
    assert figures["pass % shifted 10 mm"] < 0.8 * figures["pass %"]
    assert figures["pass % without contact"] < 1


def test_an_unknown_corpus_is_refused_with_the_known_names(tmp_path):
    with pytest.raises(HoidataError, match="h2o, grab, arctic"):
        write_corpus("mimic", tmp_path / "x")
