"""The object a command is told: the user's mesh file, or one of a dataset."""

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from hoidata.errors import BadInput
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.store.store import open_store


@dataclass(frozen=True)
class MeshWish:
    """How to read the user's mesh file; "" for what is to be assumed or found, as in ``read_user_object``."""

    unit: str = ""
    up: str = ""
    hinge: str = ""


def stored_object(name: str, clips: Path, hands: HandPair) -> ObjectModel:
    """An object of the dataset by name. Raises BadInput that lists the names there are."""
    store = open_store(clips, hands)
    names = list(store.objects["object"])
    if name not in names:
        expected = f"a mesh file (.obj, .ply, .stl, .glb) or one of: {', '.join(names)}"
        raise BadInput("--object", expected, name, nearest_name(name, names) or "correct the name or path")
    return store.object_model(name)


def nearest_name(name: str, names: Sequence[str]) -> str:
    """Which of the names was likely meant, as a question; empty where none is near."""
    near = get_close_matches(name, names, 1)
    return f"did you mean {near[0]!r}?" if near else ""


def mesh_notes(model: ObjectModel) -> list[str]:
    """What was repaired of a mesh, and which parts of it have no inside that hands could be kept out of."""
    index = surface_index(model)
    note = [] if index.solid_note is None else [f"mesh: {index.solid_note}"]
    return note if index.is_solid else [f"{note[0]}; hands are drawn to its surface, not kept out of it"]
