"""`hoidata lineage diff`: the causes of a difference between two checkpoints or other outputs, in words."""

from pathlib import Path
from typing import Any

from pipelines.lineage.raw import RawSource, raw_sources
from pipelines.lineage.tree import value_changes

# Facts of a record that are causes. The others (clips_digest, vocabulary, ...) follow from the data.
_CAUSES = ("device", "encoder", "hand_digest")
_SEED = "train.seed"


def differences(root: Path | None, first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    """The causes, one line each; empty if the records are equal."""
    pairs = _paired(first.get("stages", {}), second.get("stages", {}))
    causes = [line for name, (one, other) in pairs.items() for line in _stage_differences(name, one, other)]
    causes += _seed(first, second) + _facts(first, second)
    libraries = value_changes(first.get("libraries", {}), second.get("libraries", {}))
    causes += [f"library {change.replace(': ', ' ', 1)}" for change in libraries]
    causes += _raw(raw_sources(root, first), raw_sources(root, second))
    return list(dict.fromkeys(causes)) or _unexplained(first, second, pairs)


def _paired(first: dict[str, Any], second: dict[str, Any]) -> dict[str, tuple[dict | None, dict | None]]:
    """The stages of both records by name; without a common name, by kind (``train``, ``convert``)."""
    if not first.keys() & second.keys():
        first, second = ({_kind(name): stage for name, stage in stages.items()} for stages in (first, second))
    return {name: (first.get(name), second.get(name)) for name in dict.fromkeys([*first, *second])}


def _kind(stage: str) -> str:
    return stage.partition("@")[0]


def _stage_differences(name: str, one: dict | None, other: dict | None) -> list[str]:
    if one is None or other is None:
        return [f"stage {name}: only in the {'second' if one is None else 'first'}"]
    return [*_params(name, one["params"], other["params"]), *_code(one["code"], other["code"]), *_manifests(one, other)]


def _params(stage: str, one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    names = dict.fromkeys(key for key in [*one, *other] if key != _SEED)
    changes = ((key, change) for key in names for change in value_changes(one.get(key), other.get(key)))
    return [f"param {key} of {_kind(stage)}: {change.removeprefix('value: ')}" for key, change in changes]


def _code(one: dict[str, str], other: dict[str, str]) -> list[str]:
    return [f"{'setting' if ' ' in path else 'code'} {change}" for path, change in _changes(one, other).items()]


def _changes(one: dict[str, Any], other: dict[str, Any]) -> dict[str, str]:
    """How the second value of each key differs from the first, if it does, as ``key: words``, by key."""
    words = {}
    for key in sorted({*one, *other}):
        first, second = one.get(key), other.get(key)
        if first != second:
            only = "only in the first" if second is None else "only in the second"
            words[key] = f"{key}: {only if None in (first, second) else 'differs'}"
    return words


def _manifests(one: dict, other: dict) -> list[str]:
    """Differences of manifests, the inputs that no stage writes."""
    changes = _changes(one["inputs"], other["inputs"])
    return [f"manifest {change}" for path, change in changes.items() if path.startswith("manifests/")]


def _seed(first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    def seed(record: dict[str, Any]) -> Any:
        last = record.get("stages", {}).get(record.get("stage"), {})
        return record.get("seed", last.get("params", {}).get(_SEED))

    return [] if seed(first) == seed(second) else [f"seed: {seed(first)} -> {seed(second)}"]


def _facts(first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    lines = []
    for key in _CAUSES:
        if key == "encoder" and _encoder_param(first) != _encoder_param(second):
            continue  # reported as a param
        lines += [f"{key}: {change}" for change in value_changes(first.get(key), second.get(key))]
    return [line.replace(": value: ", ": ") for line in lines]


def _encoder_param(record: dict[str, Any]) -> Any:
    params = (stage["params"].get("annotate") for stage in record.get("stages", {}).values())
    return next((values.get("encoder") for values in params if isinstance(values, dict)), None)


def _raw(one: list[RawSource], other: list[RawSource]) -> list[str]:
    """Raw files that differ; if none do, clips that only one record has."""
    first, second = (dict(item for source in sources for item in source.digests.items()) for sources in (one, other))
    if changes := _changes(first, second):
        return [f"raw file {change}" for change in changes.values()]
    clips, others = ({clip.clip_id for source in sources for clip in source.clips} for sources in (one, other))
    only_first = [f"clip {clip}: only in the first" for clip in sorted(clips - others)]
    return only_first + [f"clip {clip}: only in the second" for clip in sorted(others - clips)]


def _unexplained(
    first: dict[str, Any], second: dict[str, Any], pairs: dict[str, tuple[dict | None, dict | None]]
) -> list[str]:
    """The first data that differs although all its recorded causes are equal; else weights that do."""
    for one, other in reversed([pair for pair in pairs.values() if None not in pair]):
        assert one is not None
        assert other is not None
        for path, digest in one["inputs"].items():
            if path in other["inputs"] and other["inputs"][path] != digest:
                return [f"data {path}: differs, although all its recorded causes are equal"]
    weights = [record.get("seal", {}).get("payload_sha256") for record in (first, second)]
    if weights[0] != weights[1]:
        return ["weights: differ, although all their recorded causes are equal"]
    return []
