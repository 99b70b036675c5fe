"""Settings of the stage annotate: the section ``annotate`` of params.yaml."""

from dataclasses import dataclass
from typing import Literal, get_args

from hoidata.contact.settings import check_threshold
from hoidata.errors import BadInput

Forms = Literal["paper", "reference"]
HandRule = Literal["proximity", "annotated-else-proximity"]


@dataclass(frozen=True)
class AnnotationSettings:
    """encoder: a name for ``load_encoder``. threshold_m: a hand acts when a joint comes closer to the object than this.

    threshold_m: None takes the contact stage's. hand: which hands are active: those that come so near, or the one the
    source's annotator named, where one did (Text2HOI does so for ARCTIC), as long as some hand comes near. forms: the
    paper's four sentences in our English, or as the reference implementation writes them. derive_verbs: a clip whose
    source names no verb gets the one its motion shows; else its sentences say "move".
    """

    encoder: str = "use"
    threshold_m: float | None = None
    hand: HandRule = "proximity"
    forms: Forms = "paper"
    derive_verbs: bool = True

    def __post_init__(self) -> None:
        chosen = (("forms of the sentences", self.forms, Forms), ("annotate.hand", self.hand, HandRule))
        for what, value, kind in chosen:
            if value not in get_args(kind):
                raise BadInput(what, " or ".join(get_args(kind)), repr(value), "choose one of them")
        if self.threshold_m is not None:
            check_threshold("annotate.threshold_m", self.threshold_m)
