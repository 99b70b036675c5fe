"""From a clip to its words: sentences, hand type, text features; and from a user's words back to the hand."""

from hoidata.annotation.encoders import TextEncoder, load_encoder, refuse_other_encoder
from hoidata.annotation.hand_choice import HandChoice, hand_prior, most_similar_hand, select_hand
from hoidata.annotation.prompts import PromptReading, read_prompt
from hoidata.annotation.sentences import FORMS, four_sentences

__all__ = [
    "FORMS",
    "HandChoice",
    "PromptReading",
    "TextEncoder",
    "four_sentences",
    "hand_prior",
    "load_encoder",
    "most_similar_hand",
    "read_prompt",
    "refuse_other_encoder",
    "select_hand",
]
