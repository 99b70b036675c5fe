"""From a clip to its words: sentences, hand type, text features; and from a user's words back to the hand."""

from hoidata.annotation.encoders import TextEncoder, load_encoder, refuse_other_encoder
from hoidata.annotation.sentences import FORMS, four_sentences

__all__ = [
    "FORMS",
    "TextEncoder",
    "four_sentences",
    "load_encoder",
    "refuse_other_encoder",
]
