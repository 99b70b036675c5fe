"""Loading sequences again from altered copies of the raw folder: elsewhere, partly missing, damaged, in a worker.

Copies hold the files the clips name as their sources and nothing else, as hard links where the disk allows it; a file
to be damaged is replaced, so the original is never touched.
"""

import multiprocessing
import os
import shutil
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from hoidata.clips.clip import Clip
from hoidata.clips.validation import check_clip
from hoidata.conformance.loading import Loaded, first_difference, load_recorded
from hoidata.conformance.report import Finding, finding, skipped, undecided
from hoidata.datasets.base import Adapter, SequenceKey
from hoidata.errors import BadInput
from hoidata.hands import HandPair
from hoidata.lifetime import begin_worker, ctrl_c_blocked

MOST_DAMAGED = 6
DAMAGES = ("removed", "emptied", "cut in half")


def trial_findings(
    adapter: Adapter, root: Path, folder: Path, loaded: list[Loaded], hands: HandPair, worker: bool
) -> list[Finding]:
    """The rules that need a copy of the raw folder; ``folder`` is an empty one for the copies."""
    trials = Trials(adapter, root, folder, loaded, hands)
    return [
        trials.again(),
        trials.elsewhere(),
        trials.in_worker() if worker else skipped("a worker process gives the same", "not asked for"),
        *trials.without_one_sequence(),
        *trials.damaged(),
    ]


class Trials:
    """The loaded sequences of one adapter and the copies they are loaded from again."""

    def __init__(self, adapter: Adapter, root: Path, folder: Path, loaded: list[Loaded], hands: HandPair) -> None:
        self.adapter, self.root, self.folder, self.loaded, self.hands = adapter, root, folder, loaded, hands
        self.needed = sorted({path for item in loaded for path in item.needed})

    def again(self) -> Finding:
        item = self.loaded[0]
        return finding("a second run gives the same", self._differences(self.root, [item]))

    def elsewhere(self) -> Finding:
        copy = self._copy("elsewhere", self.needed)
        problems = _keys_of_copy(self.adapter, copy, self.root, [item.key for item in self.loaded])
        rule = "a copy of the named source files in another folder gives the same"
        return finding(rule, problems + self._differences(copy, self.loaded))

    def in_worker(self) -> Finding:
        rule, item = "a worker process gives the same", self.loaded[0]
        context = multiprocessing.get_context("spawn")
        try:
            with ProcessPoolExecutor(1, context, begin_worker) as pool:
                with ctrl_c_blocked():
                    future = pool.submit(load_recorded, self.adapter, self.root, item.key, self.hands)
                there = future.result()
        except Exception as error:  # an adapter that cannot be imported or pickled there breaks the pool
            return finding(rule, [f"it cannot be sent there: {error!r}"])
        return finding(rule, _compared(item, there))

    def without_one_sequence(self) -> list[Finding]:
        """Remove the files of one sequence and see what the others give."""
        rules = (
            "sequences stay the same when another is removed",
            "clips stay the same when another sequence is removed",
        )
        if len(self.loaded) < 2:
            return [skipped(rule, "there is only one sequence") for rule in rules]
        gone, others = self.loaded[0], self.loaded[1:]
        removed = self._own(gone)
        if not removed:
            return [skipped(rule, f"{gone.key} has no file of its own") for rule in rules]
        copy = self._copy("without", set(self.needed) - set(removed))
        keys = [item.key for item in others]
        return [
            finding(rules[0], _keys_of_copy(self.adapter, copy, self.root, keys)),
            self._unchanged(rules[1], copy, others, removed),
        ]

    def damaged(self) -> list[Finding]:
        """Remove, empty and halve the files of one sequence, one at a time; and once see that the others go on."""
        item = self.loaded[-1]
        copy = self._copy("damaged", self.needed)
        own = self._own(item)
        paths = sorted(item.needed, key=lambda path: (path not in own, item.key.name not in path, path))
        crashes, unclear = [], []
        for path in paths[:MOST_DAMAGED]:
            file = _one_file(copy, path)
            for damage in DAMAGES:
                _damage(file, damage)
                found = load_recorded(self.adapter, copy, item.key, self.hands)
                crash, vague = _reaction(found, file.relative_to(copy), damage)
                crashes += crash
                unclear += vague
                _link(self.root / file.relative_to(copy), file)
        rules = (
            "a damaged file raises BadInput, or gives valid clips",
            "errors name the file and say what was expected, what came and what to do",
        )
        nothing = "the clips name no file that could be damaged"
        return [
            finding(rules[0], crashes) if paths else undecided(rules[0], nothing),
            finding(rules[1], unclear) if paths else undecided(rules[1], nothing),
            self._others_go_on(copy, item, own),
        ]

    def _others_go_on(self, copy: Path, item: Loaded, own: list[str]) -> Finding:
        rule = "other sequences go on when a file is cut short"
        others = [other for other in self.loaded if other is not item]
        if not others or not own:
            return skipped(rule, "there is no other sequence" if own else f"{item.key} has no file of its own")
        _damage(_one_file(copy, own[0]), "cut in half")
        return self._unchanged(rule, copy, others[:1], own[:1])

    def _unchanged(self, rule: str, copy: Path, items: list[Loaded], touched: list[str]) -> Finding:
        """Compare with what was loaded; clips that name a touched file as a source may differ, but not in their ids."""
        problems = []
        for item in items:
            found = load_recorded(self.adapter, copy, item.key, self.hands)
            depends = set(item.needed) & set(touched)
            if depends and not found.error and [c.clip_id for c in found.clips] == [c.clip_id for c in item.clips]:
                if _compared(item, found):
                    text = f"{item.key} is also made from {min(depends)}: keep all files together, or its bytes change"
                    return finding(rule, [text], "warn")
                continue
            problems += _compared(item, found)
        return finding(rule, problems)

    def _own(self, item: Loaded) -> list[str]:
        """Files of one sequence: with its name in their path, or needed by no other."""
        elsewhere = {path for other in self.loaded if other is not item for path in other.needed}
        return [path for path in item.needed if item.key.name in path or path not in elsewhere]

    def _differences(self, root: Path, items: list[Loaded]) -> list[str]:
        loaded = [load_recorded(self.adapter, root, item.key, self.hands) for item in items]
        return [text for item, found in zip(items, loaded, strict=True) for text in _compared(item, found)]

    def _copy(self, name: str, paths: Iterable[str]) -> Path:
        copy = self.folder / name
        copy.mkdir()
        for path in sorted(paths):
            source = self.root / path
            files = [item for item in sorted(source.iterdir()) if item.is_file()] if source.is_dir() else [source]
            for file in files:
                _link(file, copy / file.relative_to(self.root))
        return copy


def _keys_of_copy(adapter: Adapter, copy: Path, root: Path, wanted: list[SequenceKey]) -> list[str]:
    """Problems when a copy's sequences are not sorted, not all of the wanted ones, or unknown in the original."""
    keys, known = adapter.sequences(copy), set(adapter.sequences(root))
    problems = [] if keys == sorted(keys) else ["they are not sorted"]
    problems += [f"{key} is not found in the copy" for key in wanted if key not in keys]
    return problems + [f"the copy has {key}, the original has not" for key in keys if key not in known]


def _compared(item: Loaded, found: Loaded) -> list[str]:
    if found.error is not None:
        return [f"{item.key}: {found.problem}"]
    difference = first_difference(item.results, found.results)
    return [] if difference is None else [f"{item.key} differs in {difference}"]


def _reaction(found: Loaded, file: Path, damage: str) -> tuple[list[str], list[str]]:
    """(crashes, unclear errors) of one load with one damaged file."""
    what = f"{file} {damage}"
    if found.crashed:
        return [f"{what}: {found.problem}"], []
    if isinstance(found.error, BadInput):
        error = found.error
        parts = (error.where, error.expected, error.got, error.remedy)
        names = file.name in str(error) or file.parent.as_posix() in str(error)
        if damage == "cut in half" and not names:  # it may be readable, and contradict another file
            names = any(Path(source.path).name in str(error) for source in found.sources)
        return [], [] if names and all(map(str.strip, parts)) else [f"{what}: {error}"]
    return [f"{what}: {text}" for clip in found.clips for text in _invalid(clip)], []


def _invalid(clip: Clip) -> list[str]:
    try:
        check_clip(clip)
    except BadInput:
        return []  # conversion checks every clip and leaves this one out with this reason
    except Exception as error:
        return [repr(error)]
    return []


def _one_file(copy: Path, path: str) -> Path:
    """The file itself, or the one in the middle of a folder of many."""
    place = copy / path
    files = sorted(item for item in place.iterdir() if item.is_file()) if place.is_dir() else [place]
    return files[len(files) // 2]


def _damage(file: Path, damage: str) -> None:
    data = file.read_bytes()
    file.unlink()
    if damage != "removed":
        file.write_bytes(b"" if damage == "emptied" else data[: len(data) // 2])


def _link(source: Path, target: Path) -> None:
    """A hard link, or a copy across file systems; ``target`` is replaced."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    try:
        os.link(os.path.realpath(source), target)
    except OSError:
        shutil.copyfile(source, target)
