"""Tests an adapter against the rules of ``hoidata.datasets.base.Adapter`` on raw files.

``check_adapter`` is independent of the dataset. It reads the declared facts, loads a few sequences and measures their
clips: ids, words, times, units, frames, sources. It loads the sequences again from copies of the raw folder: complete,
partial, damaged, and in another process. It never writes to the raw folder.
"""

import pickle
import re
import tempfile
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip
from hoidata.clips.hand_parameters import hands_for
from hoidata.clips.validation import check_clip
from hoidata.conformance.loading import Finding, Loaded, finding, load_recorded, opened_files, skipped, undecided
from hoidata.conformance.touch import touch_findings
from hoidata.conformance.trials import trial_findings
from hoidata.datasets.base import Adapter, Quarantined, SequenceKey
from hoidata.datasets.registry import FACTS
from hoidata.errors import BadInput
from hoidata.hands import HandPair
from hoidata.objects.distance import volume_m3
from hoidata.objects.model import ObjectModel

VERB = re.compile(r"[a-z]+( [a-z]+)*")
NOUN = re.compile(r"[A-Z]?[a-z]+([ '-][A-Z]?[a-z]+)*")  # words may be capitalized: Stanford bunny
UP_AXES = {f"{sign}{axis}": i for i, axis in enumerate("xyz") for sign in "+-"}
MAX_FIT_ERROR_M = 0.015
MIN_VALID_FRACTION = 0.5
MIN_VOLUME_FRACTION = 0.01

ClipRule = Callable[[Adapter, Clip], list[str]]


def clip_findings(adapter: Adapter, loaded: list[Loaded]) -> list[Finding]:
    """Apply the rules to all results of the loaded sequences."""
    clips = list(chain.from_iterable(item.clips for item in loaded))

    def per_clip(rule: str, check: ClipRule) -> Finding:
        return finding(rule, [f"{clip.clip_id}: {text}" for clip in clips for text in _tried(check, adapter, clip)])

    return [
        finding("results are clips or quarantined intervals", _kinds(loaded)),
        finding("ids come from the sequence's key and are unique", _ids(loaded)),
        per_clip("clips state dataset, subject and sequence", _origin),
        finding("clips name their source files", _sources(loaded)),
        _undeclared(adapter, loaded),
        per_clip("clips are valid: shapes, finite numbers, possible sizes", _validity),
        _clocks(clips, per_clip("frames are 1/30 s apart by the source's clock", _clock)),
        per_clip("words are words: a lower-case verb or None, and a noun", _words),
        per_clip("gravity is as declared, or None with a note", _gravity),
        per_clip("source_from_world is a similarity transform", _source_transform),
        per_clip("hands are from parameters, or fitted with a stated error", _hands_from),
        _mirrored(clips),
        finding("both hands are present", _both_hands(clips), "warn"),
    ]


def _tried(check: ClipRule, adapter: Adapter, clip: Clip) -> list[str]:
    """Problems by one rule. A rule that raises on an invalid clip reports none, because ``_validity`` does."""
    try:
        return check(adapter, clip)
    except Exception:
        if is_valid(clip):
            raise
        return []


def _kinds(loaded: list[Loaded]) -> list[str]:
    wrong = [(item.key, type(result)) for item in loaded for result in item.results]
    return [f"{key}: a {kind.__name__}" for key, kind in wrong if not issubclass(kind, Clip | Quarantined)]


def _ids(loaded: list[Loaded]) -> list[str]:
    problems, earlier_ids = [], set()
    for item in loaded:
        names = [clip.clip_id for clip in item.clips]
        quarantined = [result.source_key for result in item.results if isinstance(result, Quarantined)]
        for name in names + quarantined:
            if name != str(item.key) and not name.startswith(f"{item.key}/"):
                problems.append(f"{name} does not begin with {item.key}")
        problems += [f"{name} is duplicated" for name in names if name in earlier_ids or names.count(name) > 1]
        earlier_ids.update(names)
    return problems


def _origin(adapter: Adapter, clip: Clip) -> list[str]:
    problems = [] if clip.dataset == adapter.name else [f"its dataset is {clip.dataset!r}"]
    if not clip.subject:
        problems.append("it has no subject")
    if not clip.sequence or not clip.clip_id.startswith(f"{adapter.name}/{clip.sequence}"):
        problems.append(f"its sequence is {clip.sequence!r}")
    return problems


def _sources(loaded: list[Loaded]) -> list[str]:
    problems = []
    for item in loaded:
        read_files = {source.path: source for source in item.sources}
        for clip in item.clips:
            if not clip.sources:
                problems.append(f"{clip.clip_id}: none")
            problems += [f"{clip.clip_id}: {s.path} was not read" for s in clip.sources if read_files.get(s.path) != s]
    return problems


def _undeclared(adapter: Adapter, loaded: list[Loaded]) -> Finding:
    rule, paths = "files that are read belong to a declared part", {s.path for item in loaded for s in item.sources}
    if not paths:
        return undecided(rule, "no file was read through the RawTree")
    undeclared = [path for path in sorted(paths) if not any(part.matches(path) for part in adapter.parts)]
    return finding(rule, [f"{path} matches no pattern of parts: `raw scan` would leave it out" for path in undeclared])


def is_valid(clip: Clip) -> bool:
    """Whether the clip passes ``check_clip``, so that it can be measured."""
    return not _validity(None, clip)


def _validity(adapter: Adapter | None, clip: Clip) -> list[str]:
    try:
        check_clip(clip)
    except BadInput as error:
        return [f"{error.where.removeprefix(f'{clip.clip_id}: ')}: expected {error.expected}, got {error.got}"]
    except Exception as error:  # a missing or foreign array can break the check itself
        return [f"it cannot be checked: {error!r}"]
    return []


def _clock(adapter: Adapter, clip: Clip) -> list[str]:
    if len(clip.source_frames) != clip.object.n_frames:
        return [f"{len(clip.source_frames)} source frames for {clip.object.n_frames} frames"]
    if not 1 <= clip.source_fps <= 1000:
        return [f"source_fps is {clip.source_fps}"]
    passed_s = (clip.source_frames - clip.source_frames[0]) / clip.source_fps
    # An interpolated frame has the source number of the frame before it, so only recorded frames have a time.
    drift_s = np.abs(passed_s - np.arange(clip.n_frames) / FPS)[clip.recorded].max()
    if drift_s > 1 / FPS + 1e-6:
        seconds = f"{clip.n_frames} frames at {FPS} per second are {(clip.n_frames - 1) / FPS:.2f} s"
        return [f"{seconds}, its source frames at {clip.source_fps:g} {passed_s[-1]:.2f} s"]
    return []


def _clocks(clips: list[Clip], clock_finding: Finding) -> Finding:
    """Undecided for clips of at most three frames: the tolerance of one frame would accept any rate."""
    longest = max((clip.n_frames for clip in clips), default=0)
    return undecided(clock_finding.rule, f"the longest clip has {longest} frames") if longest < 4 else clock_finding


def _words(adapter: Adapter, clip: Clip) -> list[str]:
    problems = []
    if clip.verb is not None and not VERB.fullmatch(clip.verb):
        problems.append(f"the verb {clip.verb!r}")
    if not NOUN.fullmatch(clip.object_words):
        problems.append(f"the object {clip.object_words!r}")
    return problems


def _gravity(adapter: Adapter, clip: Clip) -> list[str]:
    frame = adapter.frame
    if clip.gravity is None:
        problems = [] if clip.gravity_note else ["no gravity, and no note why"]
        return problems + (["no gravity, though the frame states it"] if frame.gravity == "stated" else [])
    if frame.gravity == "unknown":
        return [f"gravity {clip.gravity}, though the frame says it is unknown"]
    if frame.gravity == "estimated":
        return [] if clip.gravity_note else ["no note on how gravity was estimated"]
    down = np.zeros(3)
    if frame.up_axis is not None:
        down[UP_AXES[frame.up_axis]] = -1.0 if frame.up_axis[0] == "+" else 1.0
    return [] if np.allclose(clip.gravity, down, atol=1e-6) else [f"gravity {clip.gravity}, up is {frame.up_axis}"]


def _source_transform(adapter: Adapter, clip: Clip) -> list[str]:
    matrix = np.asarray(clip.source_from_world, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.allclose(matrix[3], (0, 0, 0, 1)):
        return ["source_from_world is not a 4x4 transform of points"]
    square = matrix[:3, :3] @ matrix[:3, :3].T
    scale = np.trace(square) / 3
    is_similar = scale > 0 and np.allclose(square, scale * np.eye(3), atol=1e-4 * scale)
    return [] if is_similar else ["source_from_world shears"]


def _hands_from(adapter: Adapter, clip: Clip) -> list[str]:
    is_fitted = clip.hands_from == "keypoints"  # a setting may select keypoints although the source has parameters
    if adapter.hand_convention.shape == "fitted" and not is_fitted:
        return [f"hands_from is {clip.hands_from!r}, the declared shape 'fitted'"]
    if (clip.fit_error_m is None) == is_fitted:
        return ["fit_error_m must be stated if and only if hands are fitted"]
    if clip.fit_error_m is not None and not 0 <= clip.fit_error_m <= MAX_FIT_ERROR_M:
        return [f"the fit misses the joints by {clip.fit_error_m * 1e3:.1f} mm: joint order, side or unit?"]
    return []


def _mirrored(clips: list[Clip]) -> Finding:
    """A mirrored mesh has negative volume. Below 1 % of the bounding box, as for thin sheets, it is undecided."""
    rule = "object meshes are not turned inside out (mirrored)"
    models = [(clip.clip_id, track.model) for clip in clips for track in (clip.object, *clip.other_objects)]
    fractions = [(f"{clip_id}: {model.name}", _volume_fraction(model)) for clip_id, model in models]
    if not any(abs(fraction or 0.0) >= MIN_VOLUME_FRACTION for _, fraction in fractions):
        return undecided(rule, "no mesh encloses 1 % of its bounding box")
    return finding(rule, [name for name, fraction in fractions if (fraction or 0.0) < -MIN_VOLUME_FRACTION], "warn")


def _volume_fraction(model: ObjectModel) -> float | None:
    """Signed volume as a fraction of the bounding box; None for an invalid mesh, which another rule reports."""
    try:
        box_m3 = float(np.ptp(model.vertices_m, axis=0).prod())
        return float(volume_m3(model.vertices_m, model.faces)) / box_m3 if box_m3 > 0 else 0.0
    except (ValueError, IndexError, TypeError):
        return None


def _both_hands(clips: list[Clip]) -> list[str]:
    problems = []
    for side in SIDES:
        if not any(clip.hands[side].valid.any() for clip in clips if side in clip.hands):
            problems.append(f"the {side} hand is valid in no frame")
    for clip in clips:
        if np.any([track.valid for track in clip.hands.values()], axis=0).mean() < MIN_VALID_FRACTION:
            problems.append(f"{clip.clip_id}: no hand is valid in most frames")
    return problems


TRIES_PER_SEQUENCE = 15


def check_adapter(
    adapter: Adapter, root: str | Path, hands: HandPair, sequences: int = 4, worker: bool = True
) -> list[Finding]:
    """Try every rule on an adapter, in a fixed order. It conforms if no outcome is "fail".

    Args:
        adapter: the adapter to test.
        root: a raw folder with at least one sequence that gives a clip. Rules about other sequences need two or more.
        hands: hand models of both sides.
        sequences: number of sequences to load, spread evenly over the dataset.
        worker: also load one sequence in another process, in which the adapter's module must be importable.
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
    too_early = [f"{path} is opened" for path in sorted(opened)]
    findings.append(finding("sequences are sorted, unique and named as they should be", _keys(adapter, keys)))
    findings.append(finding("sequences are found by name: no file is opened", too_early))
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
    return not re.search(r"[\\\0\n]", name) and not {"", ".", ".."} & set(name.split("/"))


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
