"""Write a store in the format of another project, with croissant.json, README.md and export.json."""

import io
import tarfile
from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from rich.console import Console
from rich.progress import Progress

from hoidata.clips.clip import SIDES, Side
from hoidata.errors import BadInput
from hoidata.files import atomic_folder
from hoidata.files.arrays import write_npz_to
from hoidata.store.store import Store
from pipelines.exports import bvh, hugging_face, lerobot, licences, spider, usd
from pipelines.exports.describe import selected, write_description
from pipelines.exports.motion import CLIP_COLUMNS, COLUMNS, Y_UP, ExportedClip, Format, Source, write_json
from pipelines.pages.glb import glb_bytes

CLIPS_PER_SHARD = 500
_MOTION = (licences.HANDS, licences.OBJECT)
_PARAMETERS = (*_MOTION, licences.WORDS, licences.PERSON)
_COLUMNS = (*COLUMNS, *CLIP_COLUMNS)
_SCENE = (*_MOTION, licences.MESHES, licences.PERSON, licences.SKIN)
_SPIDER = (*_MOTION, licences.MESHES)


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


_LEROBOT = "LeRobot v3: 2 x 21 joints, object, sentences as tasks"
_HUGGING_FACE = "Parquet with features: datasets.load_dataset(DIR)"
FORMATS = {
    "croissant": Format("croissant.json and a dataset card for the store itself, to be stored next to its meta/"),
    "lerobot": Format(_LEROBOT, (*_MOTION, licences.WORDS), lerobot.write, lerobot.COLUMNS),
    "huggingface": Format(_HUGGING_FACE, _PARAMETERS, hugging_face.write, _COLUMNS),
    "webdataset": Format("tar shards with .npz and .json of each clip", _PARAMETERS, _write_web_dataset, _COLUMNS),
    "glb": Format("an animated scene per clip", _SCENE, _write_glb, world=Y_UP),
    "usd": Format("a stage per clip, meshes with time samples", _SCENE, usd.write, world=Y_UP),
    "bvh": Format("a skeleton per hand, and the object's motion", _MOTION, bvh.write, world=Y_UP),
    "spider": Format("SPIDER's keypoints and meshes", _SPIDER, spider.write, (), spider.WORLD, spider.unsupported),
}


def export_store(
    store: Store, to: str, out: Path, clip_ids: tuple[str, ...] = (), for_own_use: bool = False, progress: bool = True
) -> dict[str, Any]:
    """Write the clips ``clip_ids``, or all, into a new folder; returns the content of export.json.

    Equal stores give equal bytes.

    Raises:
        BadInput: the format or a clip is unknown, the store has no clips, ``out`` exists, or a licence forbids sharing.
    """
    if to not in FORMATS:
        raise BadInput("--to", f"one of {', '.join(FORMATS)}", repr(to), "choose one")
    form, existing = FORMATS[to], "an existing file or folder"
    if out.exists():
        raise BadInput(out, "a path that does not exist", existing, "choose another name, or remove it")
    if not len(store):
        raise BadInput(store.folder, "a store with clips", "none", "convert raw data first")
    if unknown := [clip_id for clip_id in clip_ids if clip_id not in store.sequences.index]:
        examples = ", ".join(store.ids[:3])
        raise BadInput("--clip", f"ids of clips of {store.folder}", unknown[0], f"choose one, such as {examples}")
    licences.check_may_be_shared(str(store.folder), store.info, form.kinds_in(store), for_own_use)
    source, skipped = Source(store, clip_ids), {}
    with atomic_folder(out) as partial, Progress(console=Console(stderr=True), disable=not progress) as bar:
        if form.write is not None:
            task = bar.add_task(f"export to {to}", total=len(source.ids))
            form.write(partial, _clips(source, form, skipped, lambda: bar.advance(task)))
        if len(skipped) == len(source.ids):
            reason = next(iter(skipped.values()))
            raise BadInput(store.folder, f"clips that {to} can represent", f"none: {reason}", "choose another format")
        facts = _facts(store, to, form, for_own_use) | {"clips": len(source.ids) - len(skipped), "left_out": skipped}
        write_json(partial / "export.json", facts)
        shown = selected(store, [clip_id for clip_id in source.ids if clip_id not in skipped])
        write_description(partial, shown, form, for_own_use)
    return facts


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
    kinds = form.kinds_in(store) or licences.KINDS
    return {
        "format": to,
        **{key: store.info[key] for key in ("dataset", "dataset_version", "synthetic", "hand_model")},
        "world": form.world,
        "terms": licences.OWN_USE if for_own_use else "may be shared under the licences below",
        "licences": [item.as_json() for item in licences.licences_of(store.info) if item.kind in kinds],
    }
