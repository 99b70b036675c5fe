"""The facts of a whole store: what its writer has to say, and how they are checked."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from hoidata.clips.clip import FPS, WorldFrame
from hoidata.clips.hand_parameters import HandConvention
from hoidata.errors import BadInput
from hoidata.hands import HandPair, load_embedded_hands
from hoidata.store.fields import INFO, Field, value_at

_WHERE = "meta/info.json"
# Of real recordings with the embedded hand, compared with published joints of MANO.
STAND_IN_ERROR = (
    "joints are off by 21 to 37 mm on average and wrists by 6 to 11 mm, so contact is off too; "
    "convert with the MANO files (--hand FOLDER)"
)
_OF_THE_WRITER = ("schema_version", "fps", "units", "axes", "counts")
_TYPES: dict[str, type | tuple[type, ...]] = {
    "string": str, "boolean": bool, "integer": int, "number": (int, float), "object": dict,
}  # fmt: skip


def store_info(
    dataset: str,
    hands: HandPair,
    *,
    frame: WorldFrame,
    hand_convention: HandConvention,
    dataset_version: str,
    licence: str,
    may_be_shared: bool,
    source_fps: float,
    synthetic: bool,
    **further: Any,
) -> dict[str, Any]:
    """All facts ``write_store`` requires, in the layout of ``meta/info.json``; ``further`` keys are added as given.

    dataset: its name. hands: the model the parameters belong to. The other facts are those of an Adapter.
    """
    return {
        "dataset": dataset,
        "dataset_version": dataset_version,
        "synthetic": synthetic,
        "source_fps": source_fps,
        "hand_model": {"name": hands.name, "digest": hands.digest},
        "frame": {"handedness": "right", **asdict(frame)},
        "hand_convention": hand_convention.as_json(),
        "licence": licence,
        "may_be_shared": may_be_shared,
        **further,
    }


def stand_in_note(info: Mapping[str, Any]) -> str:
    """What to say of a store of MANO parameters that was converted with the embedded hand in MANO's place; else "".

    Generated raw files were made with the embedded hand, and fitted hands are fitted to the hand that is there: both
    are right with it. info: of a store, or what ``store_info`` gives.
    """
    is_right = info["synthetic"] or info["hand_convention"]["shape"] == "fitted"
    if is_right or info["hand_model"]["name"] != load_embedded_hands().right.name:
        return ""
    return f"{info['dataset']} has MANO parameters, and the embedded hand is no MANO: {STAND_IN_ERROR}"


def generated_info(dataset: str, hands: HandPair | None = None, **further: Any) -> dict[str, Any]:
    """The facts of a store whose clips were made by code, in a world with z up. hands: the embedded ones by default."""
    facts = store_info(
        dataset,
        hands or load_embedded_hands(),
        frame=WorldFrame("+z", "stated", "z up, metres"),
        hand_convention=HandConvention("wrist", "absolute", "betas per sequence", "unused", note="as stored"),
        dataset_version="generated",
        licence="none: generated",
        may_be_shared=True,
        source_fps=float(FPS),
        synthetic=True,
    )
    return facts | further


def check_info(info: dict[str, Any]) -> None:
    """Raise BadInput that names the first required fact which is missing or of the wrong kind.

    Facts the writer itself adds (version, units, counts) are not looked at.
    """
    for problem in info_problems(info):
        if problem.where.removeprefix(f"{_WHERE}: ").split(".")[0] not in _OF_THE_WRITER:
            raise problem


def info_problems(info: Any) -> list[BadInput]:
    """Every fact that a store must state and does not, or not as documented."""
    problems = []
    for field in INFO.fields:
        try:
            value = value_at(info, field.name)
        except KeyError:
            problems.append(_problem(field, "nothing"))
            continue
        if not _is_of(field, value):
            problems.append(_problem(field, repr(value)))
    return problems


def _is_of(field: Field, value: Any) -> bool:
    if value is None:
        return not field.required
    if not isinstance(value, _TYPES[field.dtype]) or (isinstance(value, bool) and field.dtype != "boolean"):
        return False
    return not field.choices or value in field.choices


def _problem(field: Field, got: str) -> BadInput:
    kind = f"one of {', '.join(field.choices)}" if field.choices else f"a {field.dtype}"
    expected = f"{kind} ({field.meaning})" if field.required else f"{kind} or null ({field.meaning})"
    return BadInput(
        f"{_WHERE}: {field.name}", expected, got, "pass hoidata.store.info.store_info(...), or convert again"
    )
