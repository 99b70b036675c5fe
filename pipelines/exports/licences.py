"""Under which licence each array of a store stands, and whether it may be passed on: from the facts of the store.

Two licences meet in a store: that of the raw data, which all that is derived from it stays under, and that of the hand
model, whose mesh is in no store but in every export that draws a hand.
"""

import re
from dataclasses import dataclass
from typing import Any

from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.store.fields import BODY, FRAMES, OBJECT_ARRAYS, RECORDINGS, SEQUENCES, SOURCE_CONTACT, TEMPLATES

OWN_USE = "for the user's own use: not to be passed on"
_SPDX = re.compile(r"CC0-1\.0|CC-BY(-NC)?(-SA|-ND)?-\d\.\d")
MANO = "MANO licence (MPI): non-commercial research, no redistribution"


@dataclass(frozen=True)
class Kind:
    """Arrays that come from one source, and so under one licence. arrays: files and members of a store, * for any."""

    name: str
    arrays: str
    meaning: str


HANDS = Kind("hands", f"{FRAMES.path}: left_*, right_*, source_frames", "motion and shape of both hands, their joints")
OBJECT = Kind("object motion", f"{FRAMES.path}: object_*, other_*", "poses and hinge angles of objects")
MESHES = Kind("object meshes", OBJECT_ARRAYS.path, "vertices, faces and parts of objects")
WORDS = Kind("words", SEQUENCES.path, "labels of the source, and the sentences made from them")
CAMERA = Kind("camera", f"{FRAMES.path}: camera_*", "poses of the camera")
PERSON = Kind("personal hands", TEMPLATES.path, "rest meshes of single persons")
BODY_KIND = Kind("body", BODY.path, "SMPL-X parameters of the person")
CONTACT = Kind("source contact", SOURCE_CONTACT.path, "contact labels of the source")
RECORDED = Kind("recordings", f"{RECORDINGS.path}, source_hands.npz", "whole recordings with the source's own hands")
SKIN = Kind("hand surface", "none: made from the hand model", "the mesh of the hand model, posed or to be posed")
KINDS = (HANDS, OBJECT, MESHES, WORDS, CAMERA, PERSON, BODY_KIND, CONTACT, RECORDED, SKIN)


@dataclass(frozen=True)
class ArrayLicence:
    """kind: which arrays. spdx: an SPDX id, or LicenseRef-<name> where there is none. licence: as the source words it.

    may_be_shared: whether the licence lets these arrays be passed on.
    """

    kind: Kind
    spdx: str
    licence: str
    may_be_shared: bool

    def as_json(self) -> dict[str, Any]:
        """One row of the table, for files."""
        return {
            "arrays": self.kind.name,
            "in_the_store": self.kind.arrays,
            "spdx": self.spdx,
            "licence": self.licence,
            "may_be_passed_on": self.may_be_shared,
        }


def spdx_of(licence: str, name: str) -> str:
    """The SPDX id that begins ``licence`` (``CC BY-NC 4.0`` too), else ``LicenseRef-<name>``."""
    found = _SPDX.match(licence.replace("CC0 1", "CC0-1").replace("CC BY", "CC-BY").replace(" ", "-"))
    return found.group() if found else f"LicenseRef-{re.sub(r'[^A-Za-z0-9.-]+', '-', name)}"


def licences_of(info: dict[str, Any]) -> tuple[ArrayLicence, ...]:
    """The licence of every kind of array of a store. info: its ``meta/info.json``, with exceptions."""
    name, exceptions = str(info["dataset"]), info.get("licences", {})
    if unknown := sorted(exceptions.keys() - {kind.name for kind in KINDS}):
        expected = f"some of {', '.join(kind.name for kind in KINDS)}"
        raise BadInput(f"licences of {name}", expected, ", ".join(unknown), "correct facts.toml and convert again")
    own_hand = info["hand_model"]["digest"] == load_embedded_hands().digest
    of_hand = ("CC0-1.0", "CC0-1.0: hoidata's embedded hand", True) if own_hand else ("LicenseRef-MANO", MANO, False)

    def of(kind: Kind) -> tuple[str, str, bool]:
        facts = exceptions.get(kind.name, info)
        licence = str(facts["licence"])
        spdx = spdx_of(licence, f"{name}-{kind.name}" if kind.name in exceptions else name)
        return spdx, licence, bool(facts["may_be_shared"])

    return tuple(ArrayLicence(kind, *(of_hand if kind is SKIN else of(kind))) for kind in KINDS)


def check_may_be_passed_on(where: str, info: dict[str, Any], kinds: tuple[Kind, ...], for_own_use: bool) -> None:
    """Raise BadInput that names the arrays and licences which forbid passing on, unless it is for the user alone."""
    bound = [row for row in licences_of(info) if row.kind in kinds and not row.may_be_shared]
    if bound and not for_own_use:
        words = dict.fromkeys(f"{row.licence} ({row.spdx})" for row in bound)
        got = f"{', '.join(row.kind.name for row in bound)} under: {'; '.join(words)}"
        remedy = "the licence forbids passing this on; --for-own-use writes it for you alone, and marks it so"
        raise BadInput(where, "arrays whose licences let them be passed on", got, remedy)
