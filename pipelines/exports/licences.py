"""The licence of each array of a store, and whether it permits sharing, from the facts of the store.

Two licences apply: that of the raw data for all derived data, and that of the hand model for its mesh, which only
exports with hand surfaces have.
"""

import re
from dataclasses import dataclass
from typing import Any

from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.store.fields import BODY, FRAMES, OBJECT_ARRAYS, RECORDINGS, SEQUENCES, SOURCE_CONTACT, TEMPLATES

OWN_USE = "for the user's own use: not to be shared"
_SPDX = re.compile(r"CC0-1\.0|CC-BY(-NC)?(-SA|-ND)?-\d\.\d")
MANO = "MANO licence (MPI): non-commercial research, no redistribution"


@dataclass(frozen=True)
class Kind:
    """Arrays with a common source and licence."""

    name: str
    arrays: str  # files and members of a store, with * as wildcard
    meaning: str


HANDS = Kind("hands", f"{FRAMES.path}: left_*, right_*, source_frames", "motion and shape of both hands, their joints")
OBJECT = Kind("object motion", f"{FRAMES.path}: object_*, other_*", "poses and hinge angles of objects")
MESHES = Kind("object meshes", OBJECT_ARRAYS.path, "vertices, faces and parts of objects")
WORDS = Kind("words", SEQUENCES.path, "labels of the source, and the sentences derived from them")
CAMERA = Kind("camera", f"{FRAMES.path}: camera_*", "poses of the camera")
PERSON = Kind("personal hands", TEMPLATES.path, "rest meshes of single persons")
BODY_KIND = Kind("body", BODY.path, "SMPL-X parameters of the person")
CONTACT = Kind("source contact", SOURCE_CONTACT.path, "contact labels of the source")
RECORDED = Kind("recordings", f"{RECORDINGS.path}, source_hands.npz", "whole recordings with the source's hands")
SKIN = Kind("hand surface", "none: derived from the hand model", "the mesh of the hand model, posed or to be posed")
KINDS = (HANDS, OBJECT, MESHES, WORDS, CAMERA, PERSON, BODY_KIND, CONTACT, RECORDED, SKIN)


@dataclass(frozen=True)
class ArrayLicence:
    """The licence of one kind of arrays."""

    kind: Kind
    spdx: str  # an SPDX id, or LicenseRef-<name> for other licences
    licence: str  # in the words of the source
    may_be_shared: bool  # whether it permits sharing these arrays

    def as_json(self) -> dict[str, Any]:
        """The licence as JSON values, for export.json."""
        return {
            "arrays": self.kind.name,
            "in_the_store": self.kind.arrays,
            "spdx": self.spdx,
            "licence": self.licence,
            "may_be_passed_on": self.may_be_shared,
        }


def spdx_of(licence: str, name: str) -> str:
    """The SPDX id that begins ``licence`` (``CC BY-NC 4.0`` too), else ``LicenseRef-<name>``."""
    match = _SPDX.match(licence.replace("CC0 1", "CC0-1").replace("CC BY", "CC-BY").replace(" ", "-"))
    return match.group() if match else f"LicenseRef-{re.sub(r'[^A-Za-z0-9.-]+', '-', name)}"


def licences_of(info: dict[str, Any]) -> tuple[ArrayLicence, ...]:
    """The licences of all kinds of arrays of a store, from its ``meta/info.json`` with exceptions per kind."""
    name, exceptions = str(info["dataset"]), info.get("licences", {})
    if unknown := sorted(exceptions.keys() - {kind.name for kind in KINDS}):
        expected = f"some of {', '.join(kind.name for kind in KINDS)}"
        raise BadInput(f"licences of {name}", expected, ", ".join(unknown), "correct facts.toml and convert again")
    is_embedded = info["hand_model"]["digest"] == load_embedded_hands().digest
    hand_licence = ("CC0-1.0", "CC0-1.0: hoidata's embedded hand", True)
    if not is_embedded:
        hand_licence = ("LicenseRef-MANO", MANO, False)

    def data_licence(kind: Kind) -> tuple[str, str, bool]:
        facts = exceptions.get(kind.name, info)
        licence = str(facts["licence"])
        spdx = spdx_of(licence, f"{name}-{kind.name}" if kind.name in exceptions else name)
        return spdx, licence, bool(facts["may_be_shared"])

    return tuple(ArrayLicence(kind, *(hand_licence if kind is SKIN else data_licence(kind))) for kind in KINDS)


def check_may_be_shared(path: str, info: dict[str, Any], kinds: tuple[Kind, ...], for_own_use: bool) -> None:
    """Raise BadInput with the licences that forbid sharing these kinds of arrays, unless ``for_own_use``."""
    restricted = [item for item in licences_of(info) if item.kind in kinds and not item.may_be_shared]
    if restricted and not for_own_use:
        licences = dict.fromkeys(f"{item.licence} ({item.spdx})" for item in restricted)
        got = f"{', '.join(item.kind.name for item in restricted)} under: {'; '.join(licences)}"
        remedy = "the licence forbids sharing this; --for-own-use writes it for you alone, and marks it so"
        raise BadInput(path, "arrays whose licences permit sharing", got, remedy)
