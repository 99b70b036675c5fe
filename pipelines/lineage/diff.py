"""What made two checkpoints (or other outputs) differ, in words: causes only, never what follows from them."""

from pathlib import Path
from typing import Any

from pipelines.lineage.raw import RawSource, raw_sources
from pipelines.lineage.tree import value_changes

# Facts of a record that are causes; others (clips_digest, vocabulary, ...) follow from the data.
_CAUSES = ("device", "encoder", "hand_digest")
_SEED = "train.seed"


def differences(root: Path | None, first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    """The causes, one line each; none where nothing that is recorded differs."""
    pairs = _paired(first.get("stages", {}), second.get("stages", {}))
    found = [line for name, (one, other) in pairs.items() for line in _stage_differences(name, one, other)]
    found += _seed(first, second)
    found += _facts(first, second)
    found += _libraries(first.get("libraries", {}), second.get("libraries", {}))
    found += _raw(raw_sources(root, first), raw_sources(root, second))
    found = list(dict.fromkeys(found))
    return found or _unexplained(first, second, pairs)


def _paired(first: dict[str, Any], second: dict[str, Any]) -> dict[str, tuple[dict | None, dict | None]]:
    """The stages of both, by name; where the datasets are others, by what they do."""
    if not first.keys() & second.keys():
        first, second = ({_kind(name): stage for name, stage in of.items()} for of in (first, second))
    return {name: (first.get(name), second.get(name)) for name in dict.fromkeys([*first, *second])}


def _kind(stage: str) -> str:
    return stage.partition("@")[0]


def _stage_differences(name: str, one: dict | None, other: dict | None) -> list[str]:
    if one is None or other is None:
        return [f"stage {name}: only behind the {'second' if one is None else 'first'}"]
    return [*_params(name, one["params"], other["params"]), *_code(one["code"], other["code"]), *_manifests(one, other)]


def _params(stage: str, one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    names = dict.fromkeys(key for key in [*one, *other] if key != _SEED)
    changes = ((key, change) for key in names for change in value_changes(one.get(key), other.get(key)))
    return [f"param {key} of {_kind(stage)}: {change.removeprefix('value: ')}" for key, change in changes]


def _code(one: dict[str, str], other: dict[str, str]) -> list[str]:
    words = {path: _word(one.get(path), other.get(path)) for path in sorted({*one, *other})}
    return [f"{'setting' if ' ' in path else 'code'} {path}: {word}" for path, word in words.items() if word]


def _word(one: Any, other: Any) -> str:
    """How the second differs from the first."""
    if one == other:
        return ""
    return "only in the first" if other is None else "only in the second" if one is None else "differs"


def _manifests(one: dict, other: dict) -> list[str]:
    """Inputs that no stage makes."""
    inputs = (
        {path: digest for path, digest in of["inputs"].items() if path.startswith("manifests/")} for of in (one, other)
    )
    first, second = inputs
    return [
        f"manifest {path}: {word}"
        for path in sorted({*first, *second})
        if (word := _word(first.get(path), second.get(path)))
    ]


def _seed(first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    def seed(record: dict[str, Any]) -> Any:
        last = record.get("stages", {}).get(record.get("stage"), {})
        return record.get("seed", last.get("params", {}).get(_SEED))

    return [] if seed(first) == seed(second) else [f"seed: {seed(first)} -> {seed(second)}"]


def _facts(first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    found = []
    for key in _CAUSES:
        if key == "encoder" and _encoder_param(first) != _encoder_param(second):
            continue  # said of the param
        found += [f"{key}: {change}" for change in value_changes(first.get(key), second.get(key))]
    return [line.replace(": value: ", ": ") for line in found]


def _encoder_param(record: dict[str, Any]) -> Any:
    params = (stage["params"].get("annotate") for stage in record.get("stages", {}).values())
    return next((values.get("encoder") for values in params if isinstance(values, dict)), None)


def _libraries(one: dict[str, str], other: dict[str, str]) -> list[str]:
    return [f"library {change.replace(': ', ' ', 1)}" for change in value_changes(one, other)]


def _raw(one: list[RawSource], other: list[RawSource]) -> list[str]:
    """Raw files that differ, and clips only one of them saw."""
    first, second = ({path: digest for source in of for path, digest in source.digests.items()} for of in (one, other))
    words = {path: _word(first.get(path), second.get(path)) for path in sorted({*first, *second})}
    changed = [f"raw file {path}: {word}" for path, word in words.items() if word]
    if changed:
        return changed
    seen, also = ({clip.clip_id for source in of for clip in source.clips} for of in (one, other))
    return [f"clip {clip}: only in the first" for clip in sorted(seen - also)] + [
        f"clip {clip}: only in the second" for clip in sorted(also - seen)
    ]


def _unexplained(
    first: dict[str, Any], second: dict[str, Any], pairs: dict[str, tuple[dict | None, dict | None]]
) -> list[str]:
    """Data that differs though nothing it was made from does; else weights that do."""
    for one, other in reversed([pair for pair in pairs.values() if None not in pair]):
        assert one is not None
        assert other is not None
        for path, digest in one["inputs"].items():
            if path in other["inputs"] and other["inputs"][path] != digest:
                return [f"data {path}: differs, and nothing that is recorded of its making does"]
    weights = [record.get("seal", {}).get("payload_sha256") for record in (first, second)]
    if weights[0] != weights[1]:
        return ["weights: differ, and nothing that is recorded of their making does"]
    return []
