"""Sentences, prompts read back and text features of all three datasets, in one run on one thread.

``python -m bench.text``. Every distinct prompt of H2O, GRAB and ARCTIC in the paper's four forms and three hand
types: all verbs with all objects of a dataset, which holds every real pair. The default encoder goes through all of
them once; everything else takes turns on a sample. CLIP, where installed, has random weights of ViT-B/32's size.
"""

import re
import sys
import tempfile
import time
from importlib.util import find_spec
from itertools import product
from pathlib import Path

import numpy as np

from bench.harness import Times, medians, show
from hoidata.annotation.encoders import CachedEncoder, HashEncoder, TextEncoder, UniversalSentenceEncoder
from hoidata.annotation.grammar import default_grammar
from hoidata.annotation.hand_choice import HAND_TYPES, select_hand
from hoidata.annotation.prompts import Lexicon, grammar_lexicon
from hoidata.annotation.sentences import four_sentences
from hoidata.datasets.arctic import words as arctic
from hoidata.datasets.grab.words import INTENTS, OBJECTS
from hoidata.datasets.h2o.words import PAIRS

RUNS, SAMPLE, CLIP_SAMPLE = 7, 400, 16
GOAL_S = 60
VOCABULARIES = (
    (sorted({verb for verb, _ in PAIRS}), sorted({noun for _, noun in PAIRS})),
    (list(INTENTS.values()), list(OBJECTS.values())),
    (arctic.VERBS, [arctic.object_words(name) for name in arctic.OBJECTS]),
)


def prompts() -> list[str]:
    """Every distinct prompt, in a fixed order."""
    made = (
        sentence
        for verbs, nouns in VOCABULARIES
        for verb, noun, hand in product(verbs, nouns, HAND_TYPES)
        for sentence in four_sentences(verb, noun, hand)
    )
    return list(dict.fromkeys(made))


class OneSearchPerForm:
    """The plain way to find words: a regular expression for each form, all of them over every sentence."""

    def __init__(self, lexicon: Lexicon) -> None:
        forms = [form.words for found in (lexicon._verbs, lexicon._nouns) for each in found._by_start.values()
                 for form in each]  # fmt: skip
        self.patterns = [re.compile(rf"(?<![\w-]){re.escape(form)}(?![\w-])") for form in forms]

    def read(self, text: str) -> list[tuple[int, int]]:
        return [match.span() for pattern in self.patterns for match in pattern.finditer(text.lower())]


def main() -> None:
    """Print the table of every operation beside its baseline, and the one pass over all prompts."""
    texts = prompts()
    random = np.random.default_rng(0)
    sample = [texts[number] for number in sorted(random.choice(len(texts), SAMPLE, replace=False))]
    rows = [*_reading_rows(sample), *_feature_rows(sample), *_clip_rows(sample[:CLIP_SAMPLE])]
    show("Text, one thread, ms of processor time per sentence", ["operation", "ours", "baseline", "times", ""], rows)
    _whole_pass(texts)


def _reading_rows(sample: list[str]) -> list[list[str]]:
    lexicon = grammar_lexicon(default_grammar())
    plain = OneSearchPerForm(lexicon)
    times = medians(
        {
            "words": lambda: [lexicon.read(text) for text in sample],
            "searches": lambda: [plain.read(text) for text in sample],
            "hand": lambda: [select_hand(text) for text in sample],
        },
        RUNS,
    )
    first = _row("verb and object of a prompt", times["words"], times["searches"], len(sample), "a search per form")
    return [first, ["hand of a prompt", _ms(times["hand"], len(sample)), "", "", "rules alone"]]


def _feature_rows(sample: list[str]) -> list[list[str]]:
    encoders = {"use": UniversalSentenceEncoder(), "hash": HashEncoder()}
    times = medians({name: lambda own=encoder: own.encode(sample) for name, encoder in encoders.items()}, RUNS)
    return [[f"features of {name!r}", _ms(times[name], len(sample)), "", "", ""] for name in encoders]


def _clip_rows(sample: list[str]) -> list[list[str]]:
    if find_spec("open_clip") is None:
        return []
    import torch
    from safetensors.torch import save_file

    from hoidata.annotation.clip_encoder import ARCHITECTURE, ClipEncoder, import_open_clip
    from hoidata.annotation.clip_weights import WeightsName

    torch.set_num_threads(1)
    open_clip = import_open_clip()
    config = open_clip.get_model_config(ARCHITECTURE)["text_cfg"]
    whole = open_clip.model._build_text_tower(512, config, quick_gelu=True).eval()
    tokens = open_clip.get_tokenizer(ARCHITECTURE)(sample)
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        path = Path(folder) / "random.safetensors"
        save_file({name: value.contiguous() for name, value in whole.state_dict().items()}, path)
        ours = ClipEncoder(WeightsName(str(path), True))
        error = np.abs(ours.encode(sample) - whole(tokens).numpy()).max()
        times = medians({"ours": lambda: ours.encode(sample), "whole": lambda: whole(tokens)}, RUNS)
    note = f"77 tokens, {len(sample)} at once; largest difference {error:.0e}"
    return [_row("CLIP ViT-B/32, random weights", times["ours"], times["whole"], len(sample), note)]


def _whole_pass(texts: list[str]) -> None:
    encoder: TextEncoder = CachedEncoder(UniversalSentenceEncoder())
    encoder.encode(texts[:1])
    start = time.perf_counter(), time.process_time()
    encoder.encode(texts)
    row = ["encoded", f"{time.perf_counter() - start[0]:.1f}", f"{time.process_time() - start[1]:.1f}"]
    show(
        f"All {len(texts):,} distinct prompts, default encoder, s (goal {GOAL_S})",
        ["once", "clock", "processor"],
        [row],
    )


def _row(name: str, ours: Times, theirs: Times, count: int, note: str) -> list[str]:
    return [name, _ms(ours, count), _ms(theirs, count), f"{theirs.processor / ours.processor:.1f}", note]


def _ms(times: Times, count: int) -> str:
    return f"{times.processor / count * 1e3:.3f}"


if __name__ == "__main__":
    sys.exit(main())
