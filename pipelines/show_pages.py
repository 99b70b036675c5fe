"""Writes the page of a clip or a dataset for ``hoidata show``."""

import difflib
from pathlib import Path

from hoidata.clips.clip import FPS
from hoidata.dataset_folders import dataset_title
from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair
from hoidata.store.annotated import load_annotated
from hoidata.store.info import embedded_hand_warning
from hoidata.store.store import Store, open_store
from pipelines.pages.clip_page import page_name, write_clip_page
from pipelines.pages.clip_page_facts import source_frames_text
from pipelines.pages.dataset_page import write_dataset_page
from pipelines.pages.player import motion_player, write_page
from pipelines.pages.sequence_page import write_sequence_page
from pipelines.params import read_params
from pipelines.stages.base import StagePaths, empty_reason, load_hands

CLOSEST = 5


def write_named_page(name: str, profile: str, out: Path) -> Path:
    """Write the page of the clip or dataset ``name`` of a profile to the folder ``out``; returns its path.

    Raises BadInput, with the closest ids, for an unknown name, and MissingResource if a stage has not run.
    """
    datasets = [str(dataset) for dataset in read_params(Path())["datasets"]]
    if name in datasets:
        paths = StagePaths(profile, name)
        return write_dataset_page(out, paths.data, name, load_hands(profile), dataset_title(name))
    if paths := _find_sequence(name, profile, datasets):
        annotated = load_annotated(paths.data, load_hands(profile))
        return write_sequence_page(out / page_name(name), annotated, name.partition("/")[2])
    paths = dataset_of_clip(name, profile, datasets)
    hands = load_hands(profile)
    return write_clip_page(out / page_name(name), load_annotated(paths.data, hands), name, hands)


def write_page_from(folder: Path, clip_id: str, hands: HandPair, out: Path) -> Path:
    """Write the page of a clip of ``folder``, or for the id "" of the dataset, to ``out``; see ``write_named_page``."""
    is_store = (folder / "meta").is_dir()
    store = open_store(folder if is_store else folder / "clips", hands)
    if not is_store and _is_sequence(store, clip_id):
        annotated = load_annotated(folder, hands)
        return write_sequence_page(out / page_name(clip_id), annotated, clip_id.partition("/")[2])
    if clip_id and clip_id not in store.sequences.index:
        raise _unknown_id(clip_id, str(folder), {str(store.info["dataset"]): store})
    if is_store:
        return write_stored_clip(out, store, clip_id, hands)
    if clip_id:
        return write_clip_page(out / page_name(clip_id), load_annotated(folder, hands), clip_id, hands)
    name = str(store.info["dataset"])
    return write_dataset_page(out, folder, name, hands, dataset_title(name))


def write_stored_clip(out: Path, store: Store, clip_id: str, hands: HandPair) -> Path:
    """Write the page of a clip of a store without annotation: its motion and facts."""
    if not clip_id:
        examples = ", ".join(store.ids[:CLOSEST])
        raise BadInput("CLIP", f"the id of one of {len(store)} clips", "none", f"name one, such as {examples}")
    clip = store.clip(clip_id)
    title = f"{clip.verb or 'move'}: {clip.object_words}"
    facts = [
        ("clip", clip_id),
        ("dataset", f"{clip.dataset}, subject {clip.subject}, sequence {clip.sequence}"),
        ("length", f"{clip.n_frames} frames, {clip.n_frames / FPS:.2f} s"),
        ("source frames", source_frames_text(clip)),
        ("files", ", ".join(source.path for source in clip.sources) or "none are recorded"),
        ("hand model", "; ".join(filter(None, (hands.name, embedded_hand_warning(store.info))))),
        ("licence", str(store.info["licence"])),
    ]
    player = motion_player(clip, hands, title)
    values = {"title": title, "synthetic": clip.synthetic, "player": player, "facts": facts, "has_players": True}
    return write_page(out / page_name(clip_id), "store_clip.html", **values)


def _find_sequence(name: str, profile: str, datasets: list[str]) -> StagePaths | None:
    """The dataset with clips of the sequence ``name``, such as ``arctic/s01/box_use_01``; None without."""
    runs = (StagePaths(profile, dataset) for dataset in datasets)
    return next((paths for paths in runs if (store := _store(paths)) is not None and _is_sequence(store, name)), None)


def _is_sequence(store: Store, name: str) -> bool:
    """Whether clips of the store, none with this id, are from the sequence of this name."""
    dataset, _, sequence = name.partition("/")
    is_there = dataset == store.info["dataset"] and bool((store.sequences["sequence"] == sequence).any())
    return is_there and name not in store.sequences.index


def dataset_of_clip(clip_id: str, profile: str, datasets: list[str]) -> StagePaths:
    """The dataset that has a clip."""
    stores = {name: store for name in datasets if (store := _store(StagePaths(profile, name))) is not None}
    for name, store in stores.items():
        if clip_id in store.sequences.index:
            return StagePaths(profile, name)
    if not stores:
        raise MissingResource(f"no dataset of the profile {profile} is converted; run `dvc repro` first")
    raise _unknown_id(clip_id, f"the profile {profile}", stores)


def _store(paths: StagePaths) -> Store | None:
    """The store of a dataset, or None if it has no clips."""
    if empty_reason(paths.clips) or not (paths.clips / "meta" / "info.json").is_file():
        return None
    return open_store(paths.clips)


def _unknown_id(clip_id: str, source: str, stores: dict[str, Store]) -> BadInput:
    """The error for an unknown id: why the sequence was skipped in conversion, or the closest ids."""
    for store in stores.values():
        for skipped in store.quarantine.to_dict("records"):
            if skipped["source_key"] == clip_id:
                reason = f"{skipped['where']}: expected {skipped['expected']}, got {skipped['got']}"
                return BadInput(clip_id, "a clip", f"skipped in conversion: {reason}", str(skipped["remedy"]))
    counts = ", ".join(f"{name} {len(store)}" for name, store in stores.items())
    closest = closest_ids(clip_id, [existing for store in stores.values() for existing in store.ids])
    expected = f"the id of one of the clips of {source} ({counts}) or a dataset"
    return BadInput("CLIP", expected, clip_id, f"closest: {', '.join(closest)}")


def closest_ids(query: str, ids: list[str]) -> list[str]:
    """Up to five ids: those that contain the query first, then those with the most similar spelling."""
    containing = [name for name in ids if query.lower() in name.lower()]
    similar = difflib.get_close_matches(query, ids, n=CLOSEST, cutoff=0.0)
    return list(dict.fromkeys([*containing[:CLOSEST], *similar]))[:CLOSEST]
