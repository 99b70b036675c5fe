"""Writes a whole synthetic corpus in the raw format of one dataset."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

from hoidata.errors import HoidataError
from hoidata.files import atomic_folder
from hoidata.hands import load_embedded_hands
from hoidata.synthetic.actions import DATASET_IDS, Size
from hoidata.synthetic.catalogue import OBJECTS, ObjectSpec
from hoidata.synthetic.generate import make_action, place_in_raw_sequences, tasks_of
from hoidata.synthetic.study import clip_tasks, find_grasps, make_clips, pool_tasks
from hoidata.synthetic.study_plan import STUDY_OBJECTS, StudySize
from hoidata.synthetic.truth import TruthSequence
from hoidata.synthetic.write_arctic import write_arctic_meta, write_arctic_sequence
from hoidata.synthetic.write_grab import write_grab_meshes, write_grab_sequence
from hoidata.synthetic.write_h2o import write_h2o_objects_and_lists, write_h2o_sequence
from hoidata.workers import map_in_workers

# "full" and "small" are the embedded corpora; "study" and "study-small" are the corpus ``study``.
AnySize = Size | StudySize

# By dataset: the writer of shared files, and the writer of one raw sequence.
_WRITERS = {
    "h2o": (write_h2o_objects_and_lists, write_h2o_sequence),
    "grab": (write_grab_meshes, write_grab_sequence),
    "arctic": (write_arctic_meta, write_arctic_sequence),
}


def write_corpus(
    dataset: str, root: str | Path, seed: int = 0, size: AnySize = "full", jobs: int = 2
) -> list[TruthSequence]:
    """Generate and write a corpus; it replaces the folder ``root``. Returns its ground truth.

    dataset: "h2o", "grab" or "arctic"; the study sizes have only "grab" and "arctic". jobs: worker processes, on which
    the result does not depend. Raises HoidataError if the dataset is unknown, or if no plausible sequence was found.
    """
    if dataset not in datasets_of(size):
        raise HoidataError(f"no corpus {size} named {dataset!r}; there are {', '.join(datasets_of(size))}")
    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns) as progress, atomic_folder(root) as partial_root:
        sequences = _make_corpus(dataset, seed, size, jobs, progress)
        write_shared_files(dataset, partial_root, sequences, size)
        groups: dict[str, list[TruthSequence]] = {}
        for truth in sequences:
            groups.setdefault(truth.source_key, []).append(truth)
        writing = map_in_workers(partial(write_raw_sequence, dataset, partial_root), list(groups.values()), jobs)
        list(progress.track(writing, len(groups), description=f"{dataset}: writing"))
    return sequences


def _make_corpus(dataset: str, seed: int, size: AnySize, jobs: int, progress: Progress) -> list[TruthSequence]:
    """Generate all actions of a corpus in plan order."""

    def run(function: Callable, tasks: Sequence, step: str) -> Iterable[tuple]:
        return progress.track(map_in_workers(function, tasks, jobs), len(tasks), description=f"{dataset}: {step}")

    if size in ("full", "small"):
        generated = run(make_action, tasks_of(dataset, seed, size), "making")
    else:
        grasps_of_tasks = run(find_grasps, pool_tasks(dataset, seed, size), "grasps")
        pools = {(task.object_index, task.region): grasps for task, grasps in grasps_of_tasks}
        generated = run(make_clips, clip_tasks(dataset, seed, size, pools), "making")
    return place_in_raw_sequences(dataset, [pair for _, pairs in generated for pair in pairs])


def datasets_of(size: AnySize) -> tuple[str, ...]:
    """Return the datasets that have a corpus of this size."""
    return tuple(DATASET_IDS if size in ("full", "small") else STUDY_OBJECTS)


def write_shared_files(dataset: str, root: Path, sequences: list[TruthSequence], size: AnySize = "full") -> None:
    """Write the files that all sequences share: meshes, subjects, splits."""
    specs: tuple[ObjectSpec, ...] = OBJECTS[dataset]
    if size not in ("full", "small"):
        specs = tuple(item.spec for item in STUDY_OBJECTS[dataset])
    _WRITERS[dataset][0](root, sequences, specs)


def write_raw_sequence(dataset: str, root: Path, members: list[TruthSequence]) -> None:
    """Write the files of one raw sequence with the actions ``members`` in their order."""
    _WRITERS[dataset][1](root, members, load_embedded_hands())
