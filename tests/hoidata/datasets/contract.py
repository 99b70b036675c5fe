"""Tests that every adapter must pass: one class, subclassed once per dataset with a small raw tree."""

import hashlib
import re
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pytest

from hoidata.clips.clip import Clip
from hoidata.clips.quarantine import Quarantined
from hoidata.conformance.check import check_adapter
from hoidata.conversion.convert import convert_dataset
from hoidata.dataset_folders import dataset_facts, dataset_folder
from hoidata.datasets import RawTree, get_adapter
from hoidata.errors import BadInput
from hoidata.hands import load_embedded_hands
from hoidata.splits.definitions import definitions_for, published
from hoidata.store.store import open_store
from tests.builders.corruption import CANARY, Corrupt
from tests.builders.formulas import has_correct_handedness, is_seated_correctly, seated_person

HERE = Path(__file__).parent


class FileProblem(NamedTuple):
    """A way to corrupt a file, and the error it must cause."""

    name: str
    location: str  # part of the error's location
    corrupt: Corrupt
    message: str  # part of the error's text


Problem = tuple[str, str, Corrupt, str]  # the fields of ``FileProblem``


class AdapterContract:
    """Tests of one adapter. A subclass sets the class variables and implements ``write`` and ``file_problems``."""

    name: ClassVar[str]  # of the dataset
    corrupted_sequence: ClassVar[str]  # the sequence of ``write`` whose files the problems corrupt
    bad_settings: ClassVar[Mapping[str, tuple[Any, str]]]  # by name: a bad value, and words of the error
    # Test that fails when a convention is flipped, by row of CONVENTIONS.md: its name in test_conventions.py of the
    # dataset, or ``path::name`` with a path below this folder.
    conventions: ClassVar[Mapping[str, str]]
    slow: ClassVar[bool] = False  # each file problem takes seconds
    common_sources: ClassVar[bool] = False  # clips of one sequence have files of other sequences as sources

    @staticmethod
    def write(root: Path) -> object:
        """Write a raw tree of two sequences with different objects."""
        raise NotImplementedError

    @staticmethod
    def file_problems() -> Iterable[Problem]:
        """Problems of the table in ``hoidata/files/README.md``, tested through a whole conversion."""
        raise NotImplementedError

    @staticmethod
    def format_problems() -> Iterable[Problem]:
        """Problems of this format alone, tested on one sequence."""
        return ()

    @pytest.fixture(scope="class")
    @classmethod
    def intact(cls, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
        """The raw tree, and the fingerprint of each of its clips."""
        folder = tmp_path_factory.mktemp(cls.name)
        (folder / "raw").mkdir()
        cls.write(folder / "raw")
        whole, left_out = cls.converted(folder / "raw", folder / "whole")
        assert not [item for item in left_out if item.source_key.startswith(cls.corrupted_sequence)]
        assert len({clip_id.startswith(cls.corrupted_sequence) for clip_id in whole}) == 2
        return folder / "raw", whole

    @pytest.fixture
    def root(self, intact, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        """A copy of the raw tree."""
        monkeypatch.chdir(tmp_path)
        return shutil.copytree(intact[0], tmp_path / "raw")

    @classmethod
    def converted(cls, root: Path, out: Path) -> tuple[dict[str, str], tuple[Quarantined, ...]]:
        """Fingerprint of each clip by id, and the quarantined sequences."""
        summary = convert_dataset(get_adapter(cls.name), root, load_embedded_hands(), out, progress=False)
        store = open_store(out)
        clips = {clip_id: store.clip(clip_id) for clip_id in store.ids}
        if cls.common_sources:
            clips = {clip_id: replace(clip, sources=()) for clip_id, clip in clips.items()}
        return {clip_id: fingerprint(clip) for clip_id, clip in clips.items()}, summary.quarantined

    def load(self, raw: RawTree) -> list[Clip | Quarantined]:
        """The results of the sequence that the problems corrupt."""
        adapter = get_adapter(self.name)
        (key,) = (key for key in adapter.sequences(raw.root) if str(key) == self.corrupted_sequence)
        return adapter.load(raw, key, load_embedded_hands())

    @pytest.mark.slow
    def test_it_passes_every_rule_of_the_conformance_check(self, root: Path) -> None:
        """Hands of these trees touch nothing, so warnings are ignored."""
        findings = check_adapter(get_adapter(self.name), root, load_embedded_hands(), worker=False)
        assert [item for item in findings if item.outcome == "fail"] == []
        assert [item.rule for item in findings if item.outcome == "pass"]

    def test_its_facts_are_in_its_folder_and_nowhere_else(self) -> None:
        folder, facts = dataset_folder(self.name), dataset_facts(self.name)
        assert folder
        assert facts == get_adapter(self.name).facts  # type: ignore[attr-defined]
        code = "".join(path.read_text() for path in folder.glob("*.py"))
        assert not [fact for fact in (facts.licence, facts.where_to_register, facts.paper) if fact in code]
        assert facts.split in definitions_for(self.name)

    def test_every_convention_it_states_has_a_test_and_no_other(self) -> None:
        facts = dataset_facts(self.name)
        assert facts
        assert set(facts.conventions) == set(self.conventions)
        for test_path in self.conventions.values():
            file, _, test = test_path.rpartition("::")
            path = HERE / (file or f"{self.name}/test_conventions.py")
            assert re.search(rf"def {test}\(", path.read_text()), test_path

    def test_a_bad_setting_is_refused(self, setting: str) -> None:
        value, expected = self.bad_settings[setting]
        with pytest.raises(BadInput, match=rf"settings of the adapter {self.name}: {setting}: expected .*{expected}"):
            get_adapter(self.name, **{setting: value})

    def test_clips_name_the_files_that_hold_motion_and_others(self, root: Path) -> None:
        (clip, *_) = (item for item in self.load(RawTree(root)) if isinstance(item, Clip))
        holds = [any(fnmatch(item.path, p) for p in published(self.name).motion_files) for item in clip.sources]
        assert any(holds)
        assert not all(holds)

    def test_a_file_that_differs_from_its_manifest_is_refused(self, root: Path) -> None:
        raw = RawTree(root)
        self.load(raw)
        listed = {source.path: source for source in raw.sources}
        self.load(RawTree(root, listed))
        for path in listed:
            changed = listed | {path: replace(listed[path], sha256="0" * 64)}
            for manifest, problem in ((changed, "SHA-256"), (listed.keys() - {path}, "listed in the manifest")):
                with pytest.raises(BadInput, match=problem) as caught:
                    self.load(RawTree(root, {name: changed[name] for name in manifest}))
                assert caught.value.where.startswith(path)

    def test_a_corrupted_file_quarantines_its_sequence_only(
        self, file_problem: FileProblem, intact, root, tmp_path: Path
    ) -> None:
        file_problem.corrupt(root)
        clips, left_out = self.converted(root, tmp_path / "store")
        assert not CANARY.exists()
        result = [item for item in left_out if item.source_key.startswith(self.corrupted_sequence)]
        assert result, f"not left out: {left_out}"
        text = f"{result[0].where}: expected {result[0].expected}, got {result[0].got}; {result[0].remedy}"
        assert file_problem.location in result[0].where, text
        assert file_problem.message in text
        assert "defect of hoidata" not in text
        assert all((result[0].expected, result[0].got, result[0].remedy))
        assert clips == {
            name: digest for name, digest in intact[1].items() if not name.startswith(self.corrupted_sequence)
        }

    def test_the_error_for_a_bad_file_names_it_and_the_expected_content(
        self, format_problem: FileProblem, root: Path
    ) -> None:
        format_problem.corrupt(root)
        with pytest.raises(BadInput) as caught:
            self.load(RawTree(root))
        assert not CANARY.exists()
        assert format_problem.location in caught.value.where
        assert format_problem.message in str(caught.value)


class SeatedPersonContract:
    """Tests that an adapter does not mirror the world, with a person of known pose and the mirror image.

    A subclass has the fixture ``look``: it maps a ``seated_person`` to joints of both hands and three edges in the
    world.
    """

    edges_seen = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])

    def test_the_numbers_of_each_hand_bend_a_hand_of_that_side(self, look):
        assert has_correct_handedness(look(seated_person())[0])
        assert not has_correct_handedness(look(seated_person(swapped=True))[0])

    @pytest.mark.parametrize("axis", [0, 1, 2])
    def test_the_world_is_not_seen_in_a_mirror(self, look, axis):
        assert is_seated_correctly(*look(seated_person()), self.edges_seen)
        assert not is_seated_correctly(*look(seated_person(mirrored=axis)), self.edges_seen)


def fingerprint(value: Any) -> str:
    """A digest of all fields of a clip."""
    digest = hashlib.sha256()

    def visit(item: Any) -> None:
        if is_dataclass(item) and not isinstance(item, type):
            for part in fields(item):
                visit(getattr(item, part.name))
        elif isinstance(item, dict):
            for key in sorted(item):
                visit(item[key])
        elif isinstance(item, list | tuple):
            for part in item:
                visit(part)
        elif isinstance(item, np.ndarray):
            digest.update(item.dtype.str.encode() + repr(item.shape).encode() + item.tobytes())
        else:
            digest.update(repr(item).encode())

    visit(value)
    return digest.hexdigest()
