"""Hand and verb of the embedded corpora, from raw files to stored sentences, against what they were made from."""

import re
from pathlib import Path

import pandas as pd
import pytest

from hoidata.annotation.stage import annotate_store
from hoidata.conversion.convert import convert_dataset
from hoidata.datasets import get_adapter
from hoidata.hands import load_embedded_hands
from hoidata.store.store import open_store
from hoidata.synthetic.truth import TruthSequence

pytestmark = pytest.mark.slow
NAMED = {"left": r"\bleft hand\b", "right": r"\bright hand\b", "both": r"\bboth hands\b"}


def annotated(clips: Path, out: Path) -> tuple[pd.DataFrame, pd.Series]:
    """Hand types and sentences by clip id."""
    annotate_store(clips, out / "annotation", encoder="hash")
    text = pd.read_parquet(out / "annotation" / "text.parquet").groupby("clip_id")["sentence"].agg(list)
    return pd.read_parquet(out / "annotation" / "hand_type.parquet").set_index("clip_id"), text


def by_clip(sequences: list[TruthSequence], clips: Path) -> dict[str, TruthSequence]:
    truths = {(truth.source_key, int(truth.source_frames[0])): truth for truth in sequences}
    rows = open_store(clips).sequences
    return {entry.clip_id: truths[entry.sequence, entry.first_source_frame] for entry in rows.itertuples()}


@pytest.mark.long
@pytest.mark.parametrize("dataset", ["h2o", "grab", "arctic"])
def test_the_known_hand_is_found_and_every_sentence_names_it_alone(dataset: str, small_corpus, tmp_path: Path) -> None:
    corpus = small_corpus(dataset)
    hands, text = annotated(corpus.clips, tmp_path)
    truths = by_clip(corpus.truths, corpus.clips)
    assert set(truths) == set(hands.index) == set(text.index)
    assert len(truths) >= 8
    for clip_id, truth in truths.items():
        assert hands.at[clip_id, "hand_type"] == truth.hand_type
        assert (hands.at[clip_id, "verb"], hands.at[clip_id, "verb_source"]) == (truth.verb, "source")
        assert len(text[clip_id]) == 4
        for sentence in text[clip_id]:
            assert [name for name, form in NAMED.items() if re.search(form, sentence, re.I)] == [truth.hand_type]


@pytest.mark.long
def test_arctic_without_descriptions_gets_verb_and_hand_from_the_motion(small_corpus, tmp_path: Path) -> None:
    """Whole sequences have neither word nor hand; those with one action only are named for it."""
    corpus, adapter = small_corpus("arctic"), get_adapter("arctic", clips="whole")
    convert_dataset(adapter, corpus.raw, load_embedded_hands(), tmp_path / "clips", progress=False, synthetic=True)
    hands, text = annotated(tmp_path / "clips", tmp_path)
    assert hands["labelled_hand"].isna().all()
    assert set(hands["verb_source"]) == {"derived"}
    assert hands["verb_evidence"].notna().all()
    for clip_id, entry in hands.iterrows():
        within = [truth for truth in corpus.truths if f"arctic/{truth.source_key}" == clip_id]
        sides = {side for truth in within for side in truth.active_sides}
        assert entry["hand_type"] == ("both" if len(sides) == 2 else min(sides))
        if len(within) == 1:
            assert entry["verb"] == within[0].verb
        assert text[clip_id][0].lower().startswith(entry["verb"])
    assert any(sum(f"arctic/{truth.source_key}" == clip_id for truth in corpus.truths) == 1 for clip_id in hands.index)
