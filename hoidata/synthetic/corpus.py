"""Writing a whole embedded corpus in the raw format of one dataset."""

from functools import partial
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

from hoidata.errors import HoidataError
from hoidata.files import atomic_folder
from hoidata.hands import load_embedded_hands
from hoidata.synthetic.generate import make_action, place_in_raw_sequences, tasks_of
from hoidata.synthetic.plan import DATASET_IDS, Size
from hoidata.synthetic.truth import TruthSequence
from hoidata.synthetic.write_arctic import write_arctic_meta, write_arctic_sequence
from hoidata.synthetic.write_grab import write_grab_meshes, write_grab_sequence
from hoidata.synthetic.write_h2o import write_h2o_objects_and_lists, write_h2o_sequence
from hoidata.workers import in_workers

# Per dataset, who writes what all sequences share, and who writes one raw sequence.
_WRITERS = {
    "h2o": (write_h2o_objects_and_lists, write_h2o_sequence),
    "grab": (write_grab_meshes, write_grab_sequence),
    "arctic": (write_arctic_meta, write_arctic_sequence),
}


def write_corpus(
    dataset: str, root: str | Path, seed: int = 0, size: Size = "full", jobs: int = 2
) -> list[TruthSequence]:
    """Make and write the embedded corpus of "h2o", "grab" or "arctic"; what was below ``root`` is replaced whole.

    Returns the truth it was written from. Bytes depend on dataset, seed and size alone, never on ``jobs``.
    Raises HoidataError for an unknown dataset or an action that cannot be made sound.
    """
    if dataset not in DATASET_IDS:
        raise HoidataError(f"no embedded corpus named {dataset!r}; there are {', '.join(DATASET_IDS)}")
    tasks = tasks_of(dataset, seed, size)
    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns) as progress, atomic_folder(root) as partial_root:
        making = progress.track(in_workers(make_action, tasks, jobs), len(tasks), description=f"{dataset}: making")
        sequences = place_in_raw_sequences(dataset, [pair for _, pairs in making for pair in pairs])
        write_shared_files(dataset, partial_root, sequences)
        groups = by_raw_sequence(sequences)
        writing = in_workers(partial(write_raw_sequence, dataset, partial_root), groups, jobs)
        list(progress.track(writing, len(groups), description=f"{dataset}: writing"))
    return sequences


def write_shared_files(dataset: str, root: Path, sequences: list[TruthSequence]) -> None:
    """Everything that does not belong to one sequence: meshes, subjects, splits."""
    _WRITERS[dataset][0](root, sequences)


def write_raw_sequence(dataset: str, root: Path, members: list[TruthSequence]) -> None:
    """The files of one raw sequence, which holds ``members`` in their order."""
    _WRITERS[dataset][1](root, members, load_embedded_hands())


def by_raw_sequence(sequences: list[TruthSequence]) -> list[list[TruthSequence]]:
    """The actions of each raw sequence, in time order."""
    groups: dict[str, list[TruthSequence]] = {}
    for truth in sequences:
        groups.setdefault(truth.source_key, []).append(truth)
    return [sorted(members, key=lambda truth: truth.raw_start) for members in groups.values()]
