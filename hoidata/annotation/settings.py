"""Settings of the stage annotate: the section ``annotate`` of params.yaml."""

from dataclasses import dataclass, field
from typing import Literal, get_args

from hoidata.annotation.clip_variations import VariationSettings
from hoidata.contact.settings import check_threshold
from hoidata.errors import BadInput

Forms = Literal["paper", "reference"]


@dataclass(frozen=True)
class AnnotationSettings:
    """encoder: a name for ``load_encoder``. threshold_m: a hand acts when a joint comes closer to the object than this.

    threshold_m: None takes the contact stage's. forms: the paper's four sentences in our English, or as the reference
    implementation writes them. variations: further sentences, guarded. derive_verbs: a clip whose source names no verb
    gets the one its motion shows; else its sentences say "move".
    """

    encoder: str = "use"
    threshold_m: float | None = None
    forms: Forms = "paper"
    variations: VariationSettings = field(default_factory=VariationSettings)
    derive_verbs: bool = True

    def __post_init__(self) -> None:
        if self.forms not in get_args(Forms):
            known = " or ".join(get_args(Forms))
            raise BadInput("forms of the sentences", known, repr(self.forms), "choose one of them")
        if self.threshold_m is not None:
            check_threshold("annotate.threshold_m", self.threshold_m)
