"""A store written in another project's form, with croissant.json, README.md and export.json beside what was written."""

import io
import tarfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from rich.console import Console
from rich.progress import Progress

from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.errors import BadInput
from hoidata.files import atomic_folder
from hoidata.files.arrays import write_npz_to
from hoidata.store.store import Store
from pipelines.exports import bvh, hugging_face, lerobot, spider, usd
from pipelines.exports.describe import Description, write_description
from pipelines.exports.licences import (
    HANDS,
    MESHES,
    OBJECT,
    OWN_USE,
    PERSON,
    SKIN,
    WORDS,
    Kind,
    check_may_be_passed_on,
    licences_of,
)
from pipelines.exports.motion import CLIP_COLUMNS, COLUMNS, WORLD, Y_UP, Column, ExportedClip, Source
from pipelines.pages.glb import glb_bytes

CLIPS_PER_SHARD = 500
_MOTION = (HANDS, OBJECT, WORDS)
_PARAMETERS = (*_MOTION, PERSON)
_COLUMNS = (*COLUMNS, *CLIP_COLUMNS)
_SCENE = (HANDS, OBJECT, MESHES, PERSON, SKIN)


def _everything(_: Clip) -> str:
    return ""


@dataclass(frozen=True)
class Format:
    """One form. meaning: one line for people. kinds: the arrays it can hold.

    write: (folder, clips); None: a description alone. cannot: why it has no form for a clip, "" where it has.
    world: which frame its coordinates are in. columns: the arrays that a user reads by name.
    """

    meaning: str
    kinds: tuple[Kind, ...]
    write: Callable[[Path, Iterable[ExportedClip]], None] | None
    cannot: Callable[[Clip], str] = _everything
    world: str = WORLD
    columns: tuple[Column, ...] = ()

    def held_kinds(self, store: Store) -> tuple[Kind, ...]:
        """The kinds of arrays that an export of this store holds: rest meshes of persons only where it has some."""
        templates = store.sequences[[f"{side}_template" for side in SIDES]].notna()
        return tuple(kind for kind in self.kinds if kind is not PERSON or templates.to_numpy().any())


def _write_glb(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write <clip>.glb: the animated scene of the pages, with the 21 joints of each hand as empty nodes.

    The nodes are exact where glTF's skins are not: those leave out pose correctives, and shapes that change.
    """
    for item in clips:
        markers: dict[Side, np.ndarray] = {
            side: item.joints[side] for side in SIDES if item.clip.hands[side].valid.any()
        }
        scene = glb_bytes(item.clip, item.hands, extras=item.motion_facts, markers=markers)
        (folder / f"{item.file_name}.glb").write_bytes(scene)


def _write_web_dataset(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write WebDataset shards <subset>-<number>.tar, ``all-`` for clips in no subset, which follow each other.

    ``<number>.npz`` of a clip has the arrays of ``COLUMNS`` and ``CLIP_COLUMNS``, ``<number>.json`` the facts.
    """
    for subset, group in groupby(clips, key=lambda item: item.subset):
        for shard, numbered in groupby(enumerate(group), key=lambda pair: pair[0] // CLIPS_PER_SHARD):
            with tarfile.open(folder / f"{subset or 'all'}-{shard:06d}.tar", "w", format=tarfile.USTAR_FORMAT) as tar:
                for number, item in numbered:
                    _add_to_tar(tar, f"{number:08d}", item)


def _add_to_tar(tar: tarfile.TarFile, key: str, item: ExportedClip) -> None:
    arrays = io.BytesIO()
    write_npz_to(arrays, item.arrays() | item.clip_arrays())
    for suffix, content in (("npz", arrays.getvalue()), ("json", orjson.dumps(item.facts))):
        member = tarfile.TarInfo(f"{key}.{suffix}")  # dated 1970: equal clips, equal bytes
        member.size = len(content)
        tar.addfile(member, io.BytesIO(content))


FORMATS = {
    "croissant": Format("croissant.json and a dataset card for the store itself, to lie beside its meta/", (), None),
    "lerobot": Format(
        "LeRobot v3: 2 x 21 joints, object, sentences as tasks", _MOTION, lerobot.write, columns=lerobot.COLUMNS
    ),
    "huggingface": Format(
        "Parquet with features: datasets.load_dataset(DIR)", _PARAMETERS, hugging_face.write, columns=_COLUMNS
    ),
    "webdataset": Format(
        "tar shards with .npz and .json of each clip", _PARAMETERS, _write_web_dataset, columns=_COLUMNS
    ),
    "glb": Format("an animated scene per clip", _SCENE, _write_glb, world=Y_UP),
    "usd": Format("a stage per clip, meshes with time samples", _SCENE, usd.write, world=Y_UP),
    "bvh": Format("a skeleton per hand, and the object's motion", (HANDS, OBJECT), bvh.write, world=Y_UP),
    "spider": Format(
        "SPIDER's keypoints and meshes", (HANDS, OBJECT, MESHES), spider.write, spider.cannot, spider.WORLD
    ),
}


def export_store(
    store: Store, to: str, out: Path, clip_ids: tuple[str, ...] = (), for_own_use: bool = False, progress: bool = True
) -> dict[str, Any]:
    """Write the clips of a store as the new folder ``out``; equal stores give equal bytes; returns export.json.

    to: a key of ``FORMATS``. clip_ids: by default all. Raises BadInput for an unknown format or clip, for a store
    without clips, for an ``out`` that is there, and where a licence forbids passing on what is not for_own_use.
    """
    form = _format(to)
    if out.exists():
        raise BadInput(out, "a folder that is not there yet", "something else", "choose another name, or remove it")
    _check_clips(store, clip_ids)
    check_may_be_passed_on(str(store.folder), store.info, form.held_kinds(store), for_own_use)
    source, left_out = Source(store, clip_ids), {}
    with atomic_folder(out) as partial, Progress(console=Console(stderr=True), disable=not progress) as bar:
        if form.write is not None:
            task = bar.add_task(f"export to {to}", total=len(source.ids))
            form.write(partial, _clips(source, form, left_out, lambda: bar.advance(task)))
        if len(left_out) == len(source.ids):
            reason = next(iter(left_out.values()))
            raise BadInput(store.folder, f"clips that {to} has a form for", f"none: {reason}", "choose another format")
        facts = _facts(store, to, form, for_own_use) | {"clips": len(source.ids) - len(left_out), "left_out": left_out}
        untracked = "their numbers mean nothing" if form.write is None else "they repeat its last tracked pose"
        described = Description(form.meaning, form.world, untracked, form.columns, for_own_use)
        (partial / "export.json").write_bytes(orjson.dumps(facts, option=orjson.OPT_INDENT_2) + b"\n")
        write_description(partial, store, to, described)
    return facts


def _format(to: str) -> Format:
    if to not in FORMATS:
        raise BadInput("--to", f"one of {', '.join(FORMATS)}", repr(to), "choose one")
    return FORMATS[to]


def _check_clips(store: Store, clip_ids: tuple[str, ...]) -> None:
    if not len(store):
        raise BadInput(store.folder, "a store with clips", "none", "convert raw data first")
    if unknown := [clip_id for clip_id in clip_ids if clip_id not in store.sequences.index]:
        near = ", ".join(store.ids[:3])
        raise BadInput("--clip", f"ids of clips of {store.folder}", unknown[0], f"choose one, such as {near}")


def _clips(source: Source, form: Format, left_out: dict[str, str], done: Callable[[], None]) -> Iterator[ExportedClip]:
    """The clips the format has a form for, one at a time; ``left_out`` gets the reason of the others."""
    for clip_id in source.ids:
        item = source.clip(clip_id)
        if reason := form.cannot(item.clip):
            left_out[clip_id] = reason
        else:
            yield item
        done()


def _facts(store: Store, to: str, form: Format, for_own_use: bool) -> dict[str, Any]:
    info, rows = store.info, licences_of(store.info)
    return {
        "format": to,
        "dataset": info["dataset"],
        "dataset_version": info["dataset_version"],
        "synthetic": info["synthetic"],
        "hand_model": info["hand_model"],
        "world": form.world,
        "terms": OWN_USE if for_own_use else "may be passed on under the licences below",
        "licences": [row.as_json() for row in rows if row.kind in (form.held_kinds(store) or [row.kind])],
    }
