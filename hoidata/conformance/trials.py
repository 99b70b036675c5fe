"""Loads sequences again from copies of the raw folder: complete, partial, damaged, and in a worker process.

A copy has only the files that the clips name as sources, as hard links if the file system allows. Damaging a file
replaces the link, so the original is unchanged.
"""

import multiprocessing
import os
import shutil
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from hoidata.clips.clip import Clip
from hoidata.clips.validation import check_clip
from hoidata.conformance.loading import Finding, Loaded, finding, first_difference, load_recorded, skipped, undecided
from hoidata.datasets.base import Adapter, SequenceKey
from hoidata.errors import BadInput
from hoidata.hands import HandPair
from hoidata.lifetime import block_ctrl_c, init_worker

MAX_DAMAGED_FILES = 6
DAMAGES = ("removed", "emptied", "cut in half")


def trial_findings(
    adapter: Adapter, root: Path, folder: Path, loaded: list[Loaded], hands: HandPair, worker: bool
) -> list[Finding]:
    """Try the rules that need a copy of the raw folder. folder: an empty folder for the copies."""
    trials = Trials(adapter, root=root, folder=folder, loaded=loaded, hands=hands)
    return [
        trials.again(),
        trials.elsewhere(),
        trials.in_worker() if worker else skipped("a worker process gives the same", "not requested"),
        *trials.without_one_sequence(),
        *trials.damaged(),
    ]


class Trials:
    """Reloads the sequences of one adapter from copies and compares the results."""

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
            with ProcessPoolExecutor(1, context, init_worker) as pool:
                with block_ctrl_c():
                    future = pool.submit(load_recorded, self.adapter, self.root, item.key, self.hands)
                loaded_there = future.result()
        except Exception as error:  # an adapter that cannot be imported or pickled there breaks the pool
            return finding(rule, [f"it cannot be sent there: {error!r}"])
        return finding(rule, _compared(item, loaded_there))

    def without_one_sequence(self) -> list[Finding]:
        """Remove the files of one sequence and compare the results of the others."""
        rules = (
            "sequences stay the same when another is removed",
            "clips stay the same when another sequence is removed",
        )
        if len(self.loaded) < 2:
            return [skipped(rule, "there is only one sequence") for rule in rules]
        gone, others = self.loaded[0], self.loaded[1:]
        removed = self._own_files(gone)
        if not removed:
            return [skipped(rule, f"{gone.key} has no file that others do not need") for rule in rules]
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
        own_files = self._own_files(item)
        paths = sorted(item.needed, key=lambda path: (path not in own_files, item.key.name not in path, path))
        crashes, unclear = [], []
        for path in paths[:MAX_DAMAGED_FILES]:
            file = _one_file(copy, path)
            for damage in DAMAGES:
                _damage(file, damage)
                reloaded = load_recorded(self.adapter, copy, item.key, self.hands)
                crash, vague = _reaction(reloaded, file.relative_to(copy), damage)
                crashes += crash
                unclear += vague
                _link(self.root / file.relative_to(copy), file)
        rules = (
            "a damaged file raises BadInput, or gives valid clips",
            "errors name the file, the expected and the actual content and a remedy",
        )
        nothing = "the clips name no file that could be damaged"
        return [
            finding(rules[0], crashes) if paths else undecided(rules[0], nothing),
            finding(rules[1], unclear) if paths else undecided(rules[1], nothing),
            self._others_go_on(copy, item, own_files),
        ]

    def _others_go_on(self, copy: Path, item: Loaded, own_files: list[str]) -> Finding:
        rule = "other sequences convert when a file is cut short"
        others = [other for other in self.loaded if other is not item]
        if not others or not own_files:
            return skipped(
                rule, "there is no other sequence" if own_files else f"{item.key} has no file that others do not need"
            )
        _damage(_one_file(copy, own_files[0]), "cut in half")
        return self._unchanged(rule, copy, others[:1], own_files[:1])

    def _unchanged(self, rule: str, copy: Path, items: list[Loaded], changed_files: list[str]) -> Finding:
        """Compare with the first load. Clips that name a changed file as source may differ, except in their ids."""
        problems = []
        for item in items:
            reloaded = load_recorded(self.adapter, copy, item.key, self.hands)
            depends = set(item.needed) & set(changed_files)
            if (
                depends
                and not reloaded.error
                and [c.clip_id for c in reloaded.clips] == [c.clip_id for c in item.clips]
            ):
                if _compared(item, reloaded):
                    text = f"{item.key} also depends on {min(depends)}: keep all files together, or its bytes change"
                    return finding(rule, [text], "warn")
                continue
            problems += _compared(item, reloaded)
        return finding(rule, problems)

    def _own_files(self, item: Loaded) -> list[str]:
        """Files of one sequence: those with its name in their path, or needed by this sequence alone."""
        elsewhere = {path for other in self.loaded if other is not item for path in other.needed}
        return [path for path in item.needed if item.key.name in path or path not in elsewhere]

    def _differences(self, root: Path, items: list[Loaded]) -> list[str]:
        loaded = [load_recorded(self.adapter, root, item.key, self.hands) for item in items]
        return [text for item, reloaded in zip(items, loaded, strict=True) for text in _compared(item, reloaded)]

    def _copy(self, name: str, paths: Iterable[str]) -> Path:
        copy = self.folder / name
        copy.mkdir()
        for path in sorted(paths):
            source = self.root / path
            files = [item for item in sorted(source.iterdir()) if item.is_file()] if source.is_dir() else [source]
            for file in files:
                _link(file, copy / file.relative_to(self.root))
        return copy


def _keys_of_copy(adapter: Adapter, copy: Path, root: Path, required: list[SequenceKey]) -> list[str]:
    """Problems of a copy's keys: not sorted, a required one missing, or one that the original lacks."""
    keys, original_keys = adapter.sequences(copy), set(adapter.sequences(root))
    problems = [] if keys == sorted(keys) else ["they are not sorted"]
    problems += [f"{key} is not found in the copy" for key in required if key not in keys]
    return problems + [f"the copy has {key}, the original has not" for key in keys if key not in original_keys]


def _compared(item: Loaded, reloaded: Loaded) -> list[str]:
    if reloaded.error is not None:
        return [f"{item.key}: {reloaded.problem}"]
    difference = first_difference(item.results, reloaded.results)
    return [] if difference is None else [f"{item.key} differs in {difference}"]


def _reaction(reloaded: Loaded, file: Path, damage: str) -> tuple[list[str], list[str]]:
    """(crashes, unclear errors) of one load with one damaged file."""
    damaged_file = f"{file} {damage}"
    if reloaded.crashed:
        return [f"{damaged_file}: {reloaded.problem}"], []
    if isinstance(reloaded.error, BadInput):
        error = reloaded.error
        parts = (error.where, error.expected, error.got, error.remedy)
        names_file = file.name in str(error) or file.parent.as_posix() in str(error)
        if damage == "cut in half" and not names_file:  # the file may be readable and contradict another one
            names_file = any(Path(source.path).name in str(error) for source in reloaded.sources)
        return [], [] if names_file and all(map(str.strip, parts)) else [f"{damaged_file}: {error}"]
    return [f"{damaged_file}: {text}" for clip in reloaded.clips for text in _invalid(clip)], []


def _invalid(clip: Clip) -> list[str]:
    try:
        check_clip(clip)
    except BadInput:
        return []  # conversion checks every clip and skips this one with the reason
    except Exception as error:
        return [repr(error)]
    return []


def _one_file(copy: Path, path: str) -> Path:
    """The file, or the middle one of a folder of frame files."""
    full_path = copy / path
    files = sorted(item for item in full_path.iterdir() if item.is_file()) if full_path.is_dir() else [full_path]
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
