"""What every adapter promises, whatever its dataset: one class, subclassed once per dataset with a small raw tree."""

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
from tests.builders.formulas import has_its_own_side, seated_person, sits_as_described
from tests.builders.spoilt import CANARY, Spoil

HERE = Path(__file__).parent


class Row(NamedTuple):
    """One way to spoil a file. where: what the error must name; says: words of the error."""

    problem: str
    where: str
    spoil: Spoil
    says: str


class AdapterContract:
    """name: of the dataset. spoilt: the sequence of ``write``'s two whose files the rows spoil.

    bad_settings: name -> (value, what is expected). conventions: row of ``CONVENTIONS.md`` -> the test that fails when
    it is flipped, in test_conventions.py beside the subclass unless a path below this folder is given.
    slow: rows take seconds each. common_sources: clips of one sequence list files of all as their sources.
    """

    name: ClassVar[str]
    spoilt: ClassVar[str]
    bad_settings: ClassVar[Mapping[str, tuple[Any, str]]]
    conventions: ClassVar[Mapping[str, str]]
    slow: ClassVar[bool] = False
    common_sources: ClassVar[bool] = False

    @staticmethod
    def write(root: Path) -> object:
        """A raw tree of two sequences, each with an object of its own."""
        raise NotImplementedError

    @staticmethod
    def rows() -> Iterable[Row]:
        """Problems of ``hoidata/files/README.md``'s table, tried through a whole conversion."""
        raise NotImplementedError

    @staticmethod
    def further_rows() -> Iterable[Row]:
        """Problems of this format alone, tried on the one sequence."""
        return ()

    @pytest.fixture(scope="class")
    @classmethod
    def intact(cls, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
        """The raw tree, and the fingerprint of each of its clips."""
        folder = tmp_path_factory.mktemp(cls.name)
        (folder / "raw").mkdir()
        cls.write(folder / "raw")
        whole, left_out = cls.converted(folder / "raw", folder / "whole")
        assert not [item for item in left_out if item.source_key.startswith(cls.spoilt)]
        assert len({clip_id.startswith(cls.spoilt) for clip_id in whole}) == 2
        return folder / "raw", whole

    @pytest.fixture
    def root(self, intact, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        """A copy of the raw tree."""
        monkeypatch.chdir(tmp_path)
        return shutil.copytree(intact[0], tmp_path / "raw")

    @classmethod
    def converted(cls, root: Path, out: Path) -> tuple[dict[str, str], tuple[Quarantined, ...]]:
        """Fingerprint of each clip by id, and what was left out."""
        summary = convert_dataset(get_adapter(cls.name), root, load_embedded_hands(), out, progress=False)
        store = open_store(out)
        clips = {clip_id: store.clip(clip_id) for clip_id in store.ids}
        if cls.common_sources:
            clips = {clip_id: replace(clip, sources=()) for clip_id, clip in clips.items()}
        return {clip_id: fingerprint(clip) for clip_id, clip in clips.items()}, summary.left_out

    def load(self, raw: RawTree) -> list[Clip | Quarantined]:
        """The results of the sequence the rows spoil."""
        adapter = get_adapter(self.name)
        (key,) = (key for key in adapter.sequences(raw.root) if str(key) == self.spoilt)
        return adapter.load(raw, key, load_embedded_hands())

    @pytest.mark.slow
    def test_it_keeps_every_rule_of_the_conformance_check(self, root: Path) -> None:
        """Hands of these trees touch nothing, so warnings about touch are of no account."""
        findings = check_adapter(get_adapter(self.name), root, load_embedded_hands(), worker=False)
        assert [item for item in findings if item.outcome == "fail"] == []
        assert [item.rule for item in findings if item.outcome == "pass"]

    def test_its_facts_stand_in_its_folder_and_nowhere_else(self) -> None:
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
        for place in self.conventions.values():
            file, _, test = place.rpartition("::")
            path = HERE / (file or f"{self.name}/test_conventions.py")
            assert re.search(rf"def {test}\(", path.read_text()), place

    def test_a_setting_that_means_nothing_is_refused(self, setting: str) -> None:
        value, expected = self.bad_settings[setting]
        with pytest.raises(BadInput, match=rf"settings of the adapter {self.name}: {setting}: expected .*{expected}"):
            get_adapter(self.name, **{setting: value})

    def test_clips_name_the_files_that_hold_motion_and_others(self, root: Path) -> None:
        (clip, *_) = (item for item in self.load(RawTree(root)) if isinstance(item, Clip))
        holds = [any(fnmatch(item.path, p) for p in published(self.name).motion_files) for item in clip.sources]
        assert any(holds)
        assert not all(holds)

    def test_a_file_that_is_not_as_its_manifest_says_is_refused(self, root: Path) -> None:
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

    def test_a_spoilt_file_costs_its_sequence_and_nothing_else(self, row: Row, intact, root, tmp_path: Path) -> None:
        row.spoil(root)
        clips, left_out = self.converted(root, tmp_path / "store")
        assert not CANARY.exists()
        found = [item for item in left_out if item.source_key.startswith(self.spoilt)]
        assert found, f"not left out: {left_out}"
        text = f"{found[0].where}: expected {found[0].expected}, got {found[0].got}; {found[0].remedy}"
        assert row.where in found[0].where, text
        assert row.says in text
        assert "defect of hoidata" not in text
        assert all((found[0].expected, found[0].got, found[0].remedy))
        assert clips == {name: digest for name, digest in intact[1].items() if not name.startswith(self.spoilt)}

    def test_a_bad_file_is_named_with_what_was_expected(self, further_row: Row, root: Path) -> None:
        further_row.spoil(root)
        with pytest.raises(BadInput) as caught:
            self.load(RawTree(root))
        assert not CANARY.exists()
        assert further_row.where in caught.value.where
        assert further_row.says in str(caught.value)


class SeatedPersonContract:
    """Numbers of a known person, and of her mirror image, as a source would write them.

    A subclass has the fixture ``look``: of a ``seated_person`` the joints of both hands and three edges in the world.
    """

    edges_seen = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])

    def test_each_hands_numbers_bend_a_hand_of_that_side(self, look):
        assert has_its_own_side(look(seated_person())[0])
        assert not has_its_own_side(look(seated_person(swapped=True))[0])

    @pytest.mark.parametrize("axis", [0, 1, 2])
    def test_the_world_is_not_seen_in_a_mirror(self, look, axis):
        assert sits_as_described(*look(seated_person()), self.edges_seen)
        assert not sits_as_described(*look(seated_person(mirrored=axis)), self.edges_seen)


def fingerprint(value: Any) -> str:
    """A digest of all that a clip holds."""
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
