"""Write a store in the format of another project, with croissant.json, README.md and export.json."""

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
    check_may_be_shared,
    licences_of,
)
from pipelines.exports.motion import CLIP_COLUMNS, COLUMNS, WORLD, Y_UP, Column, ExportedClip, Source, write_json
from pipelines.pages.glb import glb_bytes

CLIPS_PER_SHARD = 500
_MOTION = (HANDS, OBJECT, WORDS)
_PARAMETERS = (*_MOTION, PERSON)
_COLUMNS = (*COLUMNS, *CLIP_COLUMNS)
_SCENE = (HANDS, OBJECT, MESHES, PERSON, SKIN)


@dataclass(frozen=True)
class Format:
    """An export format."""

    meaning: str  # one line for people
    kinds: tuple[Kind, ...]  # of the arrays it can have
    write: Callable[[Path, Iterable[ExportedClip]], None] | None  # None: the description alone
    unsupported: Callable[[Clip], str] = lambda clip: ""  # the reason why it cannot represent a clip; "" if it can
    world: str = WORLD  # the frame of its coordinates
    columns: tuple[Column, ...] = ()  # arrays with a documented meaning

    def kinds_in(self, store: Store) -> tuple[Kind, ...]:
        """The kinds of arrays in an export of this store: personal rest meshes only if the store has some."""
        templates = store.sequences[[f"{side}_template" for side in SIDES]].notna()
        return tuple(kind for kind in self.kinds if kind is not PERSON or templates.to_numpy().any())


def _write_glb(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write <clip>.glb: the animated scene of the pages, with the 21 joints of each hand as empty nodes.

    The nodes are exact. The skins of glTF are not, because they have no pose correctives and no changing shapes.
    """
    for item in clips:
        markers: dict[Side, np.ndarray] = {
            side: item.joints[side] for side in SIDES if item.clip.hands[side].valid.any()
        }
        scene = glb_bytes(item.clip, item.hands, extras=item.motion_facts, markers=markers)
        (folder / f"{item.file_name}.glb").write_bytes(scene)


def _write_web_dataset(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write WebDataset shards <subset>-<number>.tar; ``all-<number>.tar`` has the clips without subset.

    A clip is ``<number>.npz`` with the arrays of ``COLUMNS`` and ``CLIP_COLUMNS``, and ``<number>.json`` with facts.
    Clips of one subset must follow each other.
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
        member = tarfile.TarInfo(f"{key}.{suffix}")  # dated 1970, so that equal clips give equal bytes
        member.size = len(content)
        tar.addfile(member, io.BytesIO(content))


FORMATS = {
    "croissant": Format(
        "croissant.json and a dataset card for the store itself, to be stored next to its meta/", kinds=(), write=None
    ),
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
        "SPIDER's keypoints and meshes",
        (HANDS, OBJECT, MESHES),
        spider.write,
        unsupported=spider.unsupported,
        world=spider.WORLD,
    ),
}


def export_store(
    store: Store, to: str, out: Path, clip_ids: tuple[str, ...] = (), for_own_use: bool = False, progress: bool = True
) -> dict[str, Any]:
    """Write the clips of a store into a new folder. Equal stores give equal bytes.

    Args:
        clip_ids: the clips to export; empty for all.

    Returns:
        The content of export.json.

    Raises:
        BadInput: the format or a clip is unknown, the store has no clips, ``out`` exists, or a licence forbids sharing.
    """
    if to not in FORMATS:
        raise BadInput("--to", f"one of {', '.join(FORMATS)}", repr(to), "choose one")
    form = FORMATS[to]
    if out.exists():
        raise BadInput(
            out, "a path that does not exist", "an existing file or folder", "choose another name, or remove it"
        )
    _check_clips(store, clip_ids)
    check_may_be_shared(str(store.folder), store.info, form.kinds_in(store), for_own_use)
    source, skipped = Source(store, clip_ids), {}
    with atomic_folder(out) as partial, Progress(console=Console(stderr=True), disable=not progress) as bar:
        if form.write is not None:
            task = bar.add_task(f"export to {to}", total=len(source.ids))
            form.write(partial, _clips(source, form, skipped, lambda: bar.advance(task)))
        if len(skipped) == len(source.ids):
            reason = next(iter(skipped.values()))
            raise BadInput(store.folder, f"clips that {to} can represent", f"none: {reason}", "choose another format")
        facts = _facts(store, to, form, for_own_use) | {"clips": len(source.ids) - len(skipped), "left_out": skipped}
        untracked = "their values are undefined" if form.write is None else "they repeat its last tracked pose"
        description = Description(form.meaning, form.world, untracked, columns=form.columns, for_own_use=for_own_use)
        write_json(partial / "export.json", facts)
        write_description(partial, store, to, description)
    return facts


def _check_clips(store: Store, clip_ids: tuple[str, ...]) -> None:
    if not len(store):
        raise BadInput(store.folder, "a store with clips", "none", "convert raw data first")
    if unknown := [clip_id for clip_id in clip_ids if clip_id not in store.sequences.index]:
        examples = ", ".join(store.ids[:3])
        raise BadInput("--clip", f"ids of clips of {store.folder}", unknown[0], f"choose one, such as {examples}")


def _clips(source: Source, form: Format, skipped: dict[str, str], done: Callable[[], None]) -> Iterator[ExportedClip]:
    """Yield the clips that the format can represent; adds the reasons of the others to ``skipped``."""
    for clip_id in source.ids:
        item = source.clip(clip_id)
        if reason := form.unsupported(item.clip):
            skipped[clip_id] = reason
        else:
            yield item
        done()


def _facts(store: Store, to: str, form: Format, for_own_use: bool) -> dict[str, Any]:
    info, array_licences = store.info, licences_of(store.info)
    return {
        "format": to,
        "dataset": info["dataset"],
        "dataset_version": info["dataset_version"],
        "synthetic": info["synthetic"],
        "hand_model": info["hand_model"],
        "world": form.world,
        "terms": OWN_USE if for_own_use else "may be shared under the licences below",
        "licences": [item.as_json() for item in array_licences if item.kind in (form.kinds_in(store) or [item.kind])],
    }
