"""Settings of the stage annotate: the section ``annotate`` of params.yaml."""

from dataclasses import dataclass
from typing import Literal, get_args

from hoidata.contact.settings import check_threshold
from hoidata.errors import BadInput

Forms = Literal["paper", "reference"]
HandRule = Literal["proximity", "annotated-else-proximity"]


@dataclass(frozen=True)
class AnnotationSettings:
    """Settings of the stage annotate."""

    encoder: str = "use"  # a name for ``load_encoder``
    threshold_m: float | None = None  # a hand with a closer joint is active; None: threshold of the contact stage
    # Active hands: those close to the object, or the labelled hand if there is a label (Text2HOI does so for ARCTIC).
    hand: HandRule = "proximity"
    forms: Forms = "paper"  # ``english_sentences`` or ``reference_sentences``
    derive_verbs: bool = True  # derive a missing verb from the motion; False: the sentences say "move"

    def __post_init__(self) -> None:
        chosen = (("forms of the sentences", self.forms, Forms), ("annotate.hand", self.hand, HandRule))
        for setting, value, values in chosen:
            if value not in get_args(values):
                raise BadInput(setting, " or ".join(get_args(values)), repr(value), "choose one of them")
        if self.threshold_m is not None:
            check_threshold("annotate.threshold_m", self.threshold_m)
