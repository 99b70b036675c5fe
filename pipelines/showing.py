"""A clip's id, or a dataset's name, to the page that shows it."""

import difflib
from pathlib import Path

from hoidata.clips.clip import FPS
from hoidata.dataset_folders import dataset_title
from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair
from hoidata.store.annotated import load_annotated
from hoidata.store.info import stand_in_note
from hoidata.store.store import Store, open_store
from pipelines.pages.clip_page import page_name, write_clip_page
from pipelines.pages.clip_page_facts import source_frames_text
from pipelines.pages.dataset_page import write_dataset_page
from pipelines.pages.player import motion_player, write_page
from pipelines.pages.sequence_page import write_sequence_page
from pipelines.params import read_params
from pipelines.stages.base import StagePaths, empty_reason, load_hands

CLOSEST = 5


def write_shown(what: str, profile: str, out: Path) -> Path:
    """Write the page of the clip, or of the dataset, called ``what`` in ``profile`` below ``out``; returns its path.

    Raises BadInput that names the closest ids for an unknown one, MissingResource for a stage that has not run.
    """
    datasets = [str(name) for name in read_params(Path())["datasets"]]
    if what in datasets:
        paths = StagePaths(profile, what)
        return write_dataset_page(out, paths.data, what, load_hands(profile), dataset_title(what))
    if (paths := _find_sequence(what, profile)) is not None:
        annotated = load_annotated(paths.data, load_hands(profile))
        return write_sequence_page(out / page_name(what), annotated, what.partition("/")[2])
    paths = find_clip(what, profile, datasets)
    hands = load_hands(profile)
    return write_clip_page(out / page_name(what), load_annotated(paths.data, hands), what, hands)


def write_shown_of(folder: Path, clip_id: str, hands: HandPair, out: Path) -> Path:
    """Write the page of a clip of ``folder``, an annotated dataset or a bare store, below ``out``; without an id that
    of the whole dataset. Raises BadInput as ``write_shown`` does.
    """
    is_store = (folder / "meta").is_dir()
    store = open_store(folder if is_store else folder / "clips", hands)
    if not is_store and _is_sequence(store, clip_id):
        annotated = load_annotated(folder, hands)
        return write_sequence_page(out / page_name(clip_id), annotated, clip_id.partition("/")[2])
    if clip_id and clip_id not in store.sequences.index:
        raise _unknown(clip_id, str(folder), {str(store.info["dataset"]): store})
    if is_store:
        return write_stored_clip(out, store, clip_id, hands)
    if clip_id:
        return write_clip_page(out / page_name(clip_id), load_annotated(folder, hands), clip_id, hands)
    name = str(store.info["dataset"])
    return write_dataset_page(out, folder, name, hands, dataset_title(name))


def write_stored_clip(out: Path, store: Store, clip_id: str, hands: HandPair) -> Path:
    """The page of a clip of a store that is not annotated: its motion and what is known of it."""
    if not clip_id:
        near = ", ".join(store.ids[:CLOSEST])
        raise BadInput("CLIP", f"the id of one of {len(store)} clips", "none", f"name one, such as {near}")
    clip = store.clip(clip_id)
    title = f"{clip.verb or 'move'}: {clip.object_words}"
    facts = [
        ("clip", clip_id),
        ("dataset", f"{clip.dataset}, subject {clip.subject}, sequence {clip.sequence}"),
        ("length", f"{clip.n_frames} frames, {clip.n_frames / FPS:.2f} s"),
        ("source frames", source_frames_text(clip)),
        ("files", ", ".join(source.path for source in clip.sources) or "none are recorded"),
        ("hand model", "; ".join(filter(None, (hands.name, stand_in_note(store.info))))),
        ("licence", str(store.info["licence"])),
    ]
    player = motion_player(clip, hands, title)
    values = {"title": title, "synthetic": clip.synthetic, "player": player, "facts": facts, "has_players": True}
    return write_page(out / page_name(clip_id), "store_clip.html", **values)


def _find_sequence(name: str, profile: str) -> StagePaths | None:
    """The dataset with clips of the sequence ``name``, such as ``arctic/s01/box_use_01``; None without."""
    for paths in (StagePaths(profile, str(key)) for key in read_params(Path())["datasets"]):
        store = _store(paths)
        if store is not None and _is_sequence(store, name):
            return paths
    return None


def _is_sequence(store: Store, name: str) -> bool:
    """Whether clips of the store, none with this id, are from the sequence of this name."""
    dataset, _, sequence = name.partition("/")
    is_there = dataset == store.info["dataset"] and bool((store.sequences["sequence"] == sequence).any())
    return is_there and name not in store.sequences.index


def find_clip(clip_id: str, profile: str, datasets: list[str]) -> StagePaths:
    """The dataset that holds a clip."""
    stores = {name: store for name in datasets if (store := _store(StagePaths(profile, name))) is not None}
    for name, store in stores.items():
        if clip_id in store.sequences.index:
            return StagePaths(profile, name)
    if not stores:
        raise MissingResource(f"no dataset of the profile {profile} is converted; run `dvc repro` first")
    raise _unknown(clip_id, f"the profile {profile}", stores)


def _store(paths: StagePaths) -> Store | None:
    """The clips of a dataset, or None where there are none."""
    if empty_reason(paths.clips) or not (paths.clips / "meta" / "info.json").is_file():
        return None
    return open_store(paths.clips)


def _unknown(clip_id: str, where: str, stores: dict[str, Store]) -> BadInput:
    left_out = [
        row for store in stores.values() for row in store.quarantine.to_dict("records") if row["source_key"] == clip_id
    ]
    if left_out:
        row = left_out[0]
        got = f"left out when converting: {row['where']}: expected {row['expected']}, got {row['got']}"
        return BadInput(clip_id, "a clip", got, str(row["remedy"]))
    counts = ", ".join(f"{name} {len(store)}" for name, store in stores.items())
    near = closest_ids(clip_id, [known for store in stores.values() for known in store.ids])
    expected = f"the id of one of the clips of {where} ({counts}) or a dataset"
    return BadInput("CLIP", expected, clip_id, f"closest: {', '.join(near)}")


def closest_ids(wanted: str, known: list[str]) -> list[str]:
    """Up to five ids: those that hold the wanted words first, then those spelt most alike."""
    holding = [name for name in known if wanted.lower() in name.lower()]
    alike = difflib.get_close_matches(wanted, known, n=CLOSEST, cutoff=0.0)
    return list(dict.fromkeys([*holding[:CLOSEST], *alike]))[:CLOSEST]
