"""A sentence and an object to a motion, with the models of one dataset, as files."""

from pathlib import Path

import numpy as np

from hoidata.annotation.encoders import load_encoder
from hoidata.annotation.hand_choice import Method
from hoidata.annotation.settings import AnnotationSettings
from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair
from hoidata.objects.mesh import load_mesh
from hoidata.objects.model import ObjectModel
from hoidata.store.store import open_store
from models.text2hoi.family import NAMES
from models.text2hoi.generation import generate
from pipelines.pages.generation_page import write_generation
from pipelines.stages.base import Place, empty_reason, load_hands, load_settings

SMALLEST_M, LARGEST_M = 0.005, 2.0


def generate_files(
    text: str, object: str | Path, seed: int, out: Path, place: Place, hand_by: Method = "rules"
) -> list[Path]:
    """Generate and write motion.npz, motion.glb and index.html; returns their paths.

    object: a mesh file in metres, or the name of an object of the dataset. hand_by: as in ``choose_hand``. Raises
    MissingResource or BadInput that says what is not there.
    """
    if reason := why_not_trained(place):
        raise MissingResource(f"the models of {place} cannot generate: {reason}")
    hands = load_hands(place.profile)
    model = read_object(object) if isinstance(object, Path) else stored_object(object, place, hands)
    encoder = load_encoder(load_settings(AnnotationSettings, "annotate").encoder)
    motion = generate(text, model, place.checkpoints, hands, encoder, seed, hand_by=hand_by)
    return write_generation(out, motion, hands)


def why_not_trained(place: Place) -> str | None:
    """What is missing of the four models of a dataset, or None when all are there."""
    for name in NAMES:
        folder = place.checkpoints / name
        if reason := empty_reason(folder):
            return f"{name} is empty, {reason}"
        if not (folder / "model.safetensors").is_file():
            return f"{folder} is not there; run `dvc repro`"
    return None


def read_object(path: Path) -> ObjectModel:
    """A rigid object from the user's mesh. Raises BadInput when its size in metres cannot be meant."""
    mesh = load_mesh(path)
    longest_m = float(np.ptp(mesh.vertices, axis=0).max())
    if not SMALLEST_M <= longest_m <= LARGEST_M:
        expected = f"a longest side of {SMALLEST_M} to {LARGEST_M} m"
        raise BadInput(path, expected, f"{longest_m:.4g} m", "scale the mesh to metres")
    return ObjectModel(path.stem, mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), np.uint8))


def stored_object(name: str, place: Place, hands: HandPair) -> ObjectModel:
    """An object of the dataset by name. Raises BadInput that lists the names there are."""
    store = open_store(place.clips, hands)
    names = list(store.objects["object"])
    if name not in names:
        raise BadInput("--object", f"a mesh file or one of: {', '.join(names)}", name, "correct the name or path")
    return store.object_model(name)
