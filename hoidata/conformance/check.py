"""Tests an adapter against the rules of ``hoidata.datasets.base.Adapter`` on raw files.

``check_adapter`` is independent of the dataset. It reads the declared facts, loads a few sequences and measures their
clips. It loads the sequences again from copies of the raw folder: complete, partial, damaged, and in another process.
It never writes to the raw folder.
"""

import pickle
import re
import tempfile
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from hoidata.clips.hand_parameters import hands_for
from hoidata.conformance.clips import clip_findings, is_valid
from hoidata.conformance.loading import Loaded, load_recorded, opened_files
from hoidata.conformance.report import Finding, finding, skipped
from hoidata.conformance.touch import touch_findings
from hoidata.conformance.trials import trial_findings
from hoidata.datasets.base import Adapter, SequenceKey
from hoidata.datasets.registry import FACTS
from hoidata.hands import HandPair

__all__ = ["Finding", "check_adapter"]

TRIES_PER_SEQUENCE = 15


def check_adapter(
    adapter: Adapter, root: str | Path, hands: HandPair, sequences: int = 4, worker: bool = True
) -> list[Finding]:
    """Try every rule on an adapter.

    Args:
        adapter: the adapter to test.
        root: a raw folder with at least one sequence that gives a clip. Rules about other sequences need two or more.
        hands: hand models of both sides.
        sequences: number of sequences to load, spread evenly over the dataset.
        worker: also load one sequence in another process, in which the adapter's module must be importable.

    Returns:
        Every rule with its outcome, in a fixed order. The adapter conforms if no outcome is "fail".
    """
    root = Path(root)
    missing = [name for name in (*FACTS, "sequences", "load") if not hasattr(adapter, name)]
    if missing:
        return [finding("the facts are declared", [f"no {name}" for name in missing])]
    findings = [
        finding("the facts are declared and plausible", _facts(adapter)),
        finding("the licence facts agree with each other", _licence(adapter)),
        finding("the adapter can be sent to another process", _picklable(adapter)),
        finding("the raw folder holds every part the adapter declares", _parts(adapter, root)),
    ]
    with opened_files(root) as opened:
        keys = list(adapter.sequences(root))
    findings.append(finding("sequences are sorted, unique and named as they should be", _keys(adapter, keys)))
    findings.append(
        finding("sequences are found by name: no file is opened", [f"{path} is opened" for path in sorted(opened)])
    )
    if not keys:
        return [*findings, finding("at least one sequence gives a clip", ["there is no sequence"])]
    hands = hands_for(adapter.hand_convention, hands)
    loaded, refused = _load_some(adapter, root, keys, hands, sequences)
    findings += _loading_findings(loaded, refused)
    if not loaded:
        return findings
    findings += clip_findings(adapter, loaded)
    # Clips with arrays of the wrong shape cannot be measured; clip_findings reports them.
    valid_clips = [clip for item in loaded for clip in item.clips if is_valid(clip)]
    findings += (
        touch_findings(valid_clips, hands) if valid_clips else [skipped("hands touch the object", "no clip is valid")]
    )
    with tempfile.TemporaryDirectory(prefix="hoidata-check-") as folder:
        findings += trial_findings(adapter, root, Path(folder), loaded, hands, worker)
    return findings


def _facts(adapter: Adapter) -> list[str]:
    problems = []
    if not isinstance(adapter.name, str) or not re.fullmatch(r"[a-z][a-z0-9_]*", adapter.name):
        problems.append(f"name is {adapter.name!r}; lower-case letters, digits and _ are allowed")
    for fact in ("version", "licence", "where_to_register"):
        if not isinstance(getattr(adapter, fact), str) or not getattr(adapter, fact).strip():
            problems.append(f"{fact} is not stated")
    for fact in ("needs_mano", "may_be_shared"):
        if not isinstance(getattr(adapter, fact), bool):
            problems.append(f"{fact} is {getattr(adapter, fact)!r}, not True or False")
    if not 1 <= adapter.source_fps <= 1000:
        problems.append(f"source_fps is {adapter.source_fps}")
    return problems + _convention(adapter) + _frame(adapter)


def _convention(adapter: Adapter) -> list[str]:
    convention, problems = adapter.hand_convention, []
    if not convention.note:
        problems.append("hand_convention has no note")
    has_betas = convention.shape in ("betas per frame", "betas per sequence")
    if has_betas == (convention.left_shape == "unused"):
        problems.append(f"shape is {convention.shape!r}, left_shape {convention.left_shape!r}: they exclude each other")
    if not 0 <= convention.components <= 45:
        problems.append(f"components is {convention.components}, not 0 to 45")
    if adapter.needs_mano and convention.shape == "fitted":
        problems.append("needs_mano is True, yet the hands are fitted to keypoints")
    return problems


def _frame(adapter: Adapter) -> list[str]:
    frame, problems = adapter.frame, []
    if not frame.note:
        problems.append("frame has no note")
    if frame.gravity == "stated" and frame.up_axis is None:
        problems.append("frame says that gravity is stated, but not which axis is up")
    if not adapter.parts:
        problems.append("parts is empty: what a raw folder holds is not stated")
    unclear = [part for part in adapter.parts if not (part.contents and part.patterns and part.archive)]
    return problems + [f"the part {part.contents!r} lacks words, patterns or its archive" for part in unclear]


def _licence(adapter: Adapter) -> list[str]:
    forbids = re.search(r"no[ -]redistribution|not? .*redistribut", adapter.licence.lower())
    if adapter.may_be_shared and forbids:
        return [f"may_be_shared is True, the licence says {adapter.licence!r}"]
    return []


def _picklable(adapter: Adapter) -> list[str]:
    if not is_dataclass(adapter):
        return ["it is not a dataclass"]
    frozen = getattr(type(adapter), "__dataclass_params__").frozen  # noqa: B009 - not declared for type checkers
    problems = [] if frozen else ["its dataclass is not frozen"]
    try:
        if pickle.loads(pickle.dumps(adapter)) != adapter:  # an object of this process, not foreign data
            problems.append("its copy is not equal to it")
    except Exception as error:  # a foreign class can raise anything
        problems.append(f"it cannot be pickled: {error}")
    try:
        type(adapter)()
    except TypeError as error:
        problems.append(f"a field has no default: {error}")
    return problems + [f"the field {item.name} starts with _" for item in fields(adapter) if item.name.startswith("_")]


def _parts(adapter: Adapter, root: Path) -> list[str]:
    absent = [part for part in adapter.parts if not part.optional and not part.is_in(root)]
    return [
        f"no {part.contents} ({', '.join(part.patterns)}); it comes from {part.archive}"
        + (f"; it is not needed with the setting {part.unneeded_with}" if part.unneeded_with else "")
        for part in absent
    ]


def _keys(adapter: Adapter, keys: list[SequenceKey]) -> list[str]:
    problems = []
    if keys != sorted(keys):
        problems.append("they are not sorted")
    if len(set(map(str, keys))) != len(keys):
        problems.append("one is duplicated")
    for key in keys:
        if key.dataset != adapter.name:
            problems.append(f"{key.name} belongs to {key.dataset!r}, not {adapter.name!r}")
        elif not key.subject or not _is_plain_path(key.name):
            problems.append(f"{key.name!r} of the subject {key.subject!r} is not a plain name")
    with tempfile.TemporaryDirectory(prefix="hoidata-check-") as empty:
        if adapter.sequences(Path(empty)):
            problems.append("an empty folder has sequences")
    return problems


def _is_plain_path(name: str) -> bool:
    return (
        bool(name) and not re.search(r"[\\\0\n]", name) and all(part not in ("", ".", "..") for part in name.split("/"))
    )


def _load_some(
    adapter: Adapter, root: Path, keys: list[SequenceKey], hands: HandPair, n_sequences: int
) -> tuple[list[Loaded], list[Loaded]]:
    """Load sequences until ``n_sequences`` give clips. Returns those and the ones without clips, sorted by key."""
    loaded: list[Loaded] = []
    refused: list[Loaded] = []
    for key in _spread(keys)[: n_sequences * TRIES_PER_SEQUENCE]:
        item = load_recorded(adapter, root, key, hands)
        (loaded if item.clips else refused).append(item)
        if len(loaded) == n_sequences:
            break
    return sorted(loaded, key=lambda item: item.key), sorted(refused, key=lambda item: item.key)


def _spread(keys: list[Any]) -> list[Any]:
    """Reorder keys so that the first n are spread over all: first, last, middle, quarters and so on."""
    order, step = [0, len(keys) - 1], len(keys) - 1
    while step > 1:
        step = -(-step // 2)
        order += list(range(0, len(keys), step))
    return [keys[i] for i in dict.fromkeys(order)]


def _loading_findings(loaded: list[Loaded], refused: list[Loaded]) -> list[Finding]:
    reasons = [f"{item.key}: {item.problem or 'it gives no clip'}" for item in refused]
    crashes = [f"{item.key}: {item.problem}" for item in refused if item.crashed]
    rule = "files are read through the RawTree only"
    unrecorded = [f"{item.key}: {path} is opened without it" for item in loaded for path in item.unrecorded]
    return [
        finding("at least one sequence gives a clip", [] if loaded else reasons),
        finding("unusable input raises BadInput, nothing else", crashes),
        finding(rule, unrecorded) if loaded else skipped(rule, "nothing was loaded"),
    ]
