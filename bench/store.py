"""Store against one NPZ per clip: a million frames, opened and fetched at random, in one run.

``python -m bench.store [FRAMES]``. Clips are random arrays of 150 frames; the NPZ holds every array of the clip,
written by ``numpy.savez``, and all are read. Runs of both layouts alternate, each with other clips; figures are
medians. The page cache is warm.
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import trimesh

from hoidata.clips import SIDES, Clip, HandTrack, ObjectTrack, SourceFile
from hoidata.objects.model import ObjectModel
from hoidata.store.info import generated_info
from hoidata.store.mapped import map_npz
from hoidata.store.store import Store, open_store, write_store

CLIP_FRAMES, FETCHED, RUNS = 150, 64, 9


def random_clip(number: int, model: ObjectModel) -> Clip:
    rng = np.random.default_rng(number)

    def rows(columns: int) -> np.ndarray:
        return rng.random((CLIP_FRAMES, columns), np.float32)

    hands: dict = {
        side: HandTrack(rows(3), rows(3), rows(45), rng.random((1, 10), np.float32), np.ones(CLIP_FRAMES, bool))
        for side in SIDES
    }
    return Clip(
        clip_id=f"bench/s{number % 10}/{number:05d}",
        dataset="bench",
        subject=f"s{number % 10}",
        sequence=f"s{number % 10}/{number:05d}",
        hands=hands,
        object=ObjectTrack(model, rows(3), rows(3)),
        source_frames=np.arange(CLIP_FRAMES, dtype=np.int32),
        gravity=np.array([0.0, 0.0, -1.0]),
        verb="lift",
        object_words="box",
        sources=(SourceFile(f"s{number % 10}/{number:05d}.npz", number, f"{number:064x}"),),
    )


def members(clip: Clip) -> dict[str, np.ndarray]:
    """Every array of a clip as members of one NPZ."""
    assert clip.gravity is not None
    names = ("wrist_m", "global_orient", "hand_pose", "betas", "valid")
    hands = {f"{side}_{name}": getattr(clip.hands[side], name) for side in SIDES for name in names}
    pose = {"object_rotvec": clip.object.rotvec, "object_translation_m": clip.object.translation_m}
    world = {"gravity": clip.gravity, "source_from_world": clip.source_from_world}
    return {"source_frames": clip.source_frames, **hands, **pose, **world}


def build(folder: Path, clips: int) -> None:
    """The same clips in both layouts."""
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    model = ObjectModel("box", np.array(box.vertices), np.array(box.faces), np.zeros(8, np.uint8))
    (folder / "npz").mkdir()

    def both() -> Iterator[Clip]:
        for number in range(clips):
            clip = random_clip(number, model)
            np.savez(npz_path(folder, clip.clip_id), allow_pickle=False, **members(clip))
            yield clip

    write_store(folder / "store", both(), generated_info("bench"))


def npz_path(folder: Path, clip_id: str) -> Path:
    return folder / "npz" / f"{clip_id.replace('/', '-')}.npz"


def fetch_npz(folder: Path, ids: list[str]) -> list[dict[str, np.ndarray]]:
    fetched = []
    for clip_id in ids:
        with np.load(npz_path(folder, clip_id), allow_pickle=False) as archive:
            fetched.append({name: archive[name] for name in archive.files})
    return fetched


def fetch_store(store: Store, ids: list[str]) -> list[Clip]:
    return [store.clip(clip_id) for clip_id in ids]


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def same_values(clips: list[Clip], archives: list[dict[str, np.ndarray]]) -> bool:
    return all(
        np.array_equal(array, archive[name]) and array.dtype == archive[name].dtype
        for clip, archive in zip(clips, archives, strict=True)
        for name, array in members(clip).items()
    )


def open_and_index(folder: Path) -> Store:
    store = open_store(folder)
    store.clip(store.ids[0])
    return store


def measure(folder: Path) -> dict[str, float]:
    """Medians in seconds: open, open_and_first, store, npz; ratio: the median of each run's npz / store."""
    store, rng = open_and_index(folder / "store"), np.random.default_rng(0)
    times: dict[str, list[float]] = {name: [] for name in ("open", "open_and_first", "store", "npz", "ratio")}
    for run in range(RUNS + 1):
        ids = [str(clip_id) for clip_id in rng.choice(store.ids, FETCHED, replace=False)]
        npz = seconds(lambda ids=ids: fetch_npz(folder, ids))
        ours = seconds(lambda ids=ids: fetch_store(store, ids))
        opened = seconds(lambda: open_store(folder / "store"))
        first = seconds(lambda: open_and_index(folder / "store"))
        if not same_values(fetch_store(store, ids), fetch_npz(folder, ids)):
            raise AssertionError("the two layouts differ")
        if run:  # the first warms everything up
            for name, value in zip(times, (opened, first, ours, npz, npz / ours), strict=True):
                times[name].append(value)
    return {name: statistics.median(values) for name, values in times.items()}


def bytes_per_frame(store: Store) -> dict[str, float]:
    """Bytes of each member of the frame shards, per frame of the store."""
    sizes: dict[str, int] = {}
    for path in sorted((store.folder / "arrays").glob("frames-*.npz")):
        for name, array in map_npz(path).items():
            sizes[name] = sizes.get(name, 0) + array.nbytes
    frames = store.info["counts"]["frames"]
    return {name: size / frames for name, size in sizes.items()}


def report(folder: Path) -> str:
    store, found = open_store(folder / "store"), measure(folder)
    sizes = bytes_per_frame(store)
    on_disk = sum(path.stat().st_size for path in (folder / "store").rglob("*") if path.is_file())
    frames = store.info["counts"]["frames"]
    rows = [
        ("frames / clips", f"{frames:,} / {len(store):,}"),
        ("open the store", f"{found['open'] * 1000:.1f} ms"),
        ("open it and fetch a first clip", f"{found['open_and_first'] * 1000:.1f} ms"),
        (f"{FETCHED} random clips, store", f"{found['store'] * 1000:.2f} ms"),
        (f"{FETCHED} random clips, one NPZ each", f"{found['npz'] * 1000:.2f} ms"),
        ("ratio", f"{found['ratio']:.1f}x"),
        ("values equal", "yes"),
        *((f"bytes per frame: {name}", f"{size:.1f}") for name, size in sizes.items() if size),
        ("bytes per frame: all parameters", f"{sum(sizes.values()):.1f}"),
        ("bytes per frame: whole store on disk", f"{on_disk / frames:.1f}"),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value:>18}" for name, value in rows)


def main(frames: int = 1_000_000) -> None:
    with tempfile.TemporaryDirectory(prefix="hoidata-bench-store-") as folder:
        start = time.perf_counter()
        build(Path(folder), -(-frames // CLIP_FRAMES))
        print(f"built both layouts in {time.perf_counter() - start:.1f} s")
        print(report(Path(folder)))


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:2]))
