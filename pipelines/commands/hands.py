"""Which hand a command computes with, where no profile says so."""

from pathlib import Path
from typing import TYPE_CHECKING

from hoidata.errors import MissingResource

if TYPE_CHECKING:
    from hoidata.hands import HandPair


def chosen_hands(choice: str) -> "HandPair":
    """``embedded``, or the folder of MANO's files; for nothing those that are registered, else the embedded one."""
    from hoidata.hands import load_embedded_hands, load_mano_hands
    from pipelines.stages.base import HAND, own_root

    folder = Path(choice) if choice not in ("", "embedded") else (own_root(HAND) if not choice else None)
    return load_embedded_hands() if folder is None else load_mano_hands(folder)


def hands_of(digest: str, what: str) -> "HandPair":
    """The hand of a digest that ``what`` was made with: the embedded one, or the user's MANO files.

    Raises MissingResource where it is neither.
    """
    each = (chosen_hands(choice) for choice in ("embedded", ""))  # the second is not looked for where the first fits
    found = next((hands for hands in each if hands.digest == digest), None)
    if found is None:
        raise MissingResource(
            f"{what} was made with a hand ({digest[:12]}) that is not here; name the folder of the MANO files in "
            "HOIDATA_MANO, or register it in a project: `hoidata raw scan mano --root FOLDER`"
        )
    return found
