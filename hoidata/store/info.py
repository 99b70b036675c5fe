"""Facts of a whole store (``meta/info.json``): their layout and their check."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from hoidata.clips.clip import FPS, WorldFrame
from hoidata.clips.hand_parameters import HandConvention
from hoidata.errors import BadInput
from hoidata.hands import HandPair, load_embedded_hands
from hoidata.store.fields import INFO, Field, value_at

_PATH = "meta/info.json"
# Error of the embedded hand on real recordings, compared with the published joints of MANO.
EMBEDDED_HAND_ERROR = (
    "joints are off by 21 to 37 mm on average and wrists by 6 to 11 mm, so contact is off too; "
    "convert with the MANO files (--hand FOLDER)"
)
_WRITER_KEYS = ("schema_version", "fps", "units", "axes", "counts")
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
    """Return all facts that ``write_store`` requires, in the layout of ``meta/info.json``, and ``further`` keys.

    hands: hand model that the parameters belong to. Facts of the dataset are those of ``Adapter``.
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


def embedded_hand_warning(info: Mapping[str, Any]) -> str:
    """Return a warning if MANO parameters were converted with the embedded hand; else "". info: of ``store_info``.

    Generated raw files and fitted hands are exact with the embedded hand, so they give no warning.
    """
    is_exact = info["synthetic"] or info["hand_convention"]["shape"] == "fitted"
    if is_exact or info["hand_model"]["name"] != load_embedded_hands().right.name:
        return ""
    return f"{info['dataset']} has MANO parameters, and the embedded hand is not MANO: {EMBEDDED_HAND_ERROR}"


def generated_info(dataset: str, hands: HandPair | None = None, **further: Any) -> dict[str, Any]:
    """Return the facts of a store of generated clips with z up. hands: the embedded hands by default."""
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
    """Raise BadInput for the first required fact that is missing or invalid, except facts that the writer adds."""
    for problem in info_problems(info):
        if problem.where.removeprefix(f"{_PATH}: ").split(".")[0] not in _WRITER_KEYS:
            raise problem


def info_problems(info: Any) -> list[BadInput]:
    """Return a problem for each required fact that is missing or differs from the schema."""
    problems = []
    for field in INFO.fields:
        try:
            value = value_at(info, field.name)
        except KeyError:
            problems.append(_problem(field, "nothing"))
            continue
        if not _is_valid(field, value):
            problems.append(_problem(field, repr(value)))
    return problems


def _is_valid(field: Field, value: Any) -> bool:
    if value is None:
        return not field.required
    if not isinstance(value, _TYPES[field.dtype]) or (isinstance(value, bool) and field.dtype != "boolean"):
        return False
    return not field.choices or value in field.choices


def _problem(field: Field, got: str) -> BadInput:
    kind = f"one of {', '.join(field.choices)}" if field.choices else f"a {field.dtype}"
    expected = f"{kind} ({field.meaning})" if field.required else f"{kind} or null ({field.meaning})"
    remedy = "pass hoidata.store.info.store_info(...), or convert again"
    return BadInput(f"{_PATH}: {field.name}", expected, got, remedy)
