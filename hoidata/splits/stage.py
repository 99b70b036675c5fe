"""Stage split: assign each clip of a dataset to a part, in the chosen split and in each named split.

    splits.parquet    one row per clip: clip_id, one column per named split that has enough clips, and `split`, the
                      chosen one. Values: train, validation, test, or null for a clip without sentences and for a clip
                      that no part covers
    info.json         definition, clips per part and leak check of each split; completeness of the dataset; `missing`:
                      the empty parts of the chosen split, if any, and their consequence
    statistics.json   ``training_statistics`` over the training part of the chosen split

``hoidata.store.annotated`` reads the chosen split from this folder.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa

from hoidata.clips.clip import SIDES, Clip
from hoidata.errors import BadInput
from hoidata.files import atomic_folder
from hoidata.files.written import read_table, write_table
from hoidata.splits.definitions import Definition, Leaks, choose, definitions_for, find_leaks, published
from hoidata.splits.rules import PARTS, assign_split, missing_parts
from hoidata.splits.statistics import training_statistics
from hoidata.store.store import Store, open_store

CHOSEN = "split"
Assignment = dict[str, str | None]


def split_store(
    clips_folder: str | Path,
    annotation_folder: str | Path,
    out_folder: str | Path,
    choice: str | Mapping[str, Any] | None,
) -> dict[str, int]:
    """Split the annotated clips of a store; the folder appears whole or not at all.

    Only clips with sentences are split, because no model uses the others. choice: name of a split, or a custom rule
    (see ``choose``). Returns the number of clips of each part of the chosen split. Raises BadInput if two of its parts
    share what it promises to keep apart.
    """
    store = open_store(clips_folder)
    hand_types, used = _annotated_clips(store, Path(annotation_folder))
    dataset = str(store.info["dataset"])
    chosen = choose(dataset, choice)
    named = {name: item for name, item in definitions_for(dataset).items() if not item.if_chosen}
    labels = hand_types.loc[used]
    sequences = store.sequences.loc[used].assign(verb=labels["verb"], hand_type=labels["hand_type"])
    digests = {clip_id: motion_digest(store.clip(clip_id, motion_only=True)) for clip_id in used}
    parts = _assignments(sequences, chosen, named.values())
    named = {name: item for name, item in named.items() if item in parts}
    leaks = {definition: _leaks(store, sequences, parts[definition], definition, digests) for definition in parts}
    _refuse_leaks(chosen, leaks[chosen])
    records = {name: _record(store, parts[item], item, leaks[item]) for name, item in named.items()}
    info = {
        "dataset": dataset,
        "chosen": _record(store, parts[chosen], chosen, leaks[chosen]),
        "splits": records,
        "without_sentences": len(store) - len(used),
        "published": _completeness(store, dataset),
    }
    if missing := missing_parts(info["chosen"]["clips"]):
        info["missing"] = missing
    train = [clip_id for clip_id in used if parts[chosen][clip_id] == "train"]
    statistics = {"dataset": dataset, "split": chosen.name, **training_statistics(store, train, hand_types)}
    with atomic_folder(out_folder) as folder:
        columns = {name: parts[item] for name, item in named.items()} | {CHOSEN: parts[chosen]}
        _write_parts(folder / "splits.parquet", store.ids, columns)
        _write_json(folder / "info.json", info)
        _write_json(folder / "statistics.json", statistics)
    return info["chosen"]["clips"]


def _assignments(
    sequences: pd.DataFrame, chosen: Definition, named: Iterable[Definition]
) -> dict[Definition, Assignment]:
    """Assign clips by the chosen and the named splits. Named splits with too few clips to hold out are skipped."""
    parts: dict[Definition, Assignment] = {}
    for definition in (*named, chosen):
        try:
            parts[definition] = assign_split(sequences, definition.rule).to_dict()
        except BadInput:
            if definition == chosen:
                raise
    return parts


def motion_digest(clip: Clip) -> str:
    """Return the SHA-256 of a clip's motion arrays. Copies under other names, subjects or objects have the same."""
    digest = hashlib.sha256()
    for side in SIDES:
        track = clip.hands[side]
        for array in (track.wrist_m, track.global_orient, track.hand_pose, track.valid):
            digest.update(array.tobytes())
    for array in (clip.object.translation_m, clip.object.rotvec, clip.object.hinge_rad):
        digest.update(b"" if array is None else array.tobytes())
    return digest.hexdigest()


def _annotated_clips(store: Store, annotation: Path) -> tuple[pd.DataFrame, list[str]]:
    """Read the annotation's table of hands, and the ids of the clips with sentences in the store's order."""
    hand_types = read_table(annotation / "hand_type.parquet").set_index("clip_id", drop=False)
    if list(hand_types["clip_id"]) != store.ids:
        got = f"{len(hand_types)} clips of another conversion"
        raise BadInput(annotation, f"the {len(store)} clips of {store.folder}", got, "run the stage 'annotate' again")
    with_sentences = set(read_table(annotation / "text.parquet", ["clip_id"])["clip_id"])
    return hand_types, [clip_id for clip_id in store.ids if clip_id in with_sentences]


def _leaks(
    store: Store, sequences: pd.DataFrame, parts: Assignment, definition: Definition, digests: Mapping[str, str]
) -> Leaks:
    patterns = published(str(store.info["dataset"])).motion_files
    paths = store.files["path"].tolist()
    return find_leaks(sequences, parts, definition.promises, files=paths, motion_files=patterns, digests=digests)


def _refuse_leaks(chosen: Definition, leaks: Leaks) -> None:
    if leaks.broken:
        kind = leaks.broken[0]
        got = f"{len(leaks.shared[kind])} in several: {', '.join(leaks.shared[kind][:3])}"
        # A margin around clips that follow each other makes them overlap.
        remedy = "choose another split" + (", or convert with margin_frames: 0" if kind == "frame" else "")
        raise BadInput(f"split {chosen.name}", f"no {kind} in two parts, as it promises", got, remedy)


def _record(store: Store, parts: Assignment, definition: Definition, leaks: Leaks) -> dict[str, Any]:
    counts, frames = Counter(parts.values()), Counter[str | None]()
    for clip_id, length in store.sequences.loc[list(parts), "n_frames"].items():
        frames[parts[str(clip_id)]] += int(length)
    return definition.as_json() | {
        "clips": {**{part: counts[part] for part in PARTS}, "left_out": counts[None]},
        "frames": {**{part: frames[part] for part in PARTS}, "left_out": frames[None]},
        "leaks": leaks.as_json(),
        "keeps_its_promises": not leaks.broken,
    }


def _completeness(store: Store, dataset: str) -> dict[str, Any] | None:
    """Count the published sequences that have a clip; None if no list is published."""
    lists = published(dataset)
    if not lists.sequences:
        return None
    with_clips = set(lists.usable) & set(store.sequences["sequence"])
    facts = {"sequences": len(lists.sequences), "usable": len(lists.usable), "with_clips": len(with_clips)}
    return {"source": lists.source, **facts}


def _write_parts(path: Path, clip_ids: list[str], columns: dict[str, Assignment]) -> None:
    schema = pa.schema([(name, pa.string()) for name in ("clip_id", *columns)])
    rows = [{"clip_id": key, **{name: parts.get(key) for name, parts in columns.items()}} for key in clip_ids]
    write_table(path, rows, schema)


def _write_json(path: Path, values: Any) -> None:
    text = json.dumps(values, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
