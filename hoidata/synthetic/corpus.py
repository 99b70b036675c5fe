"""Writing a whole embedded corpus in the raw format of one dataset."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from hoidata.errors import HoidataError
from hoidata.files import atomic_folder
from hoidata.hands import load_embedded_hands
from hoidata.synthetic.generate import make_action, place_in_raw_sequences, tasks_of, worker_pool
from hoidata.synthetic.plan import DATASET_IDS, Size
from hoidata.synthetic.truth import TruthSequence
from hoidata.synthetic.write_arctic import write_arctic_meta, write_arctic_sequence
from hoidata.synthetic.write_grab import write_grab_meshes, write_grab_sequence
from hoidata.synthetic.write_h2o import write_h2o_lists, write_h2o_objects, write_h2o_sequence


class _WriteTask(NamedTuple):
    dataset: str
    root: Path
    members: list[TruthSequence]


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
    with _progress() as progress, worker_pool(min(jobs, len(tasks))) as run, atomic_folder(root) as partial:
        made = _shown(progress, f"{dataset}: making", len(tasks), run(make_action, tasks))
        ordered = sorted((pair for pairs in made for pair in pairs), key=lambda pair: pair[0])
        sequences = place_in_raw_sequences(dataset, [truth for _, truth in ordered])
        write_shared_files(dataset, sequences, partial)
        writing = [_WriteTask(dataset, partial, members) for members in _by_raw_sequence(sequences)]
        list(_shown(progress, f"{dataset}: writing", len(writing), run(_write_task, writing)))
    return sequences


def write_raw(dataset: str, sequences: list[TruthSequence], root: str | Path) -> None:
    """Write given truth below ``root``, an existing or new folder, as the dataset's own files."""
    Path(root).mkdir(parents=True, exist_ok=True)
    write_shared_files(dataset, sequences, Path(root))
    for members in _by_raw_sequence(sequences):
        _write_task(_WriteTask(dataset, Path(root), members))


def write_shared_files(dataset: str, sequences: list[TruthSequence], root: Path) -> None:
    """Everything that does not belong to one sequence: meshes, subjects, splits."""
    if dataset == "h2o":
        write_h2o_objects(root)
        write_h2o_lists(root, sequences)
    elif dataset == "grab":
        write_grab_meshes(root, sequences)
    else:
        write_arctic_meta(root, sequences)


def _by_raw_sequence(sequences: list[TruthSequence]) -> list[list[TruthSequence]]:
    groups: dict[str, list[TruthSequence]] = {}
    for truth in sequences:
        groups.setdefault(truth.source_key, []).append(truth)
    return [sorted(members, key=lambda truth: truth.raw_start) for members in groups.values()]


def _write_task(task: _WriteTask) -> None:
    pair = load_embedded_hands()
    if task.dataset == "grab":
        write_grab_sequence(task.root, task.members[0], pair)
    else:
        write: Callable[..., None] = write_h2o_sequence if task.dataset == "h2o" else write_arctic_sequence
        write(task.root, task.members, pair)


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"), TimeElapsedColumn()
    )


def _shown(progress: Progress, title: str, total: int, results: Iterator[Any]) -> Iterator[Any]:
    task = progress.add_task(title, total=total)
    for result in results:
        progress.advance(task)
        yield result
