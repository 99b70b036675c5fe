"""Which files the code behind a module is, on packages in a temporary folder."""

import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.lineage.closure import KNOWN_IMPORTS, Choice, SourceTree
from tests.builders.folders import write_text

STAGE = """import numpy

def run():
    try:
        from hoidata.room import inside
    except OSError:
        pass
"""
FILES = {
    "hoidata/__init__.py": "",
    "hoidata/stage.py": STAGE,
    "hoidata/room/__init__.py": "from hoidata.room.shown import something",
    "hoidata/room/inside.py": "from . import beside",
    "hoidata/room/beside.py": "",
    "hoidata/room/shown.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import hoidata.typed\n",
    "hoidata/room/unused.py": "import hoidata.typed",
    "hoidata/room/words.csv": "",
    "hoidata/room/assets/hand.npz": "",
    "hoidata/room/README.md": "",
    "hoidata/room/below/module.py": "",
    "hoidata/room/below/table.csv": "",
    "hoidata/typed.py": "",
    "hoidata/registry.py": "",
    "hoidata/reader.py": "",
    "hoidata/datasets/grab/adapter.py": "",
    "hoidata/datasets/grab/words.csv": "",
    "hoidata/datasets/grab/splits.json": "",
    "hoidata/datasets/h2o/adapter.py": "",
}
OF_STAGE = {
    "hoidata/__init__.py",
    "hoidata/stage.py",
    "hoidata/room/__init__.py",
    "hoidata/room/inside.py",
    "hoidata/room/beside.py",
    "hoidata/room/shown.py",
    "hoidata/room/words.csv",
    "hoidata/room/assets/hand.npz",
}
MODULES = ("hoidata/stage.py", "hoidata/room/__init__.py", "hoidata/room/inside.py", "hoidata/room/beside.py")
IMPORTS = ("", "import hoidata.typed", "from hoidata.room import unused", "from . import beside")
ADAPTER = Choice(modules=("hoidata.datasets.grab.adapter",))
SPLITS = Choice(package="hoidata.datasets.grab", files=("*.json",))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_text(tmp_path, FILES)


def test_lazy_relative_and_package_imports_count_and_so_does_data_beside_them(root):
    assert set(SourceTree(root).closure(["hoidata.stage"], {})) == OF_STAGE


@pytest.mark.parametrize("name", sorted(OF_STAGE))
def test_each_file_of_it_changes_a_digest(root, name):
    before = SourceTree(root).closure(["hoidata.stage"], {})
    (root / name).write_text(f"{FILES[name]}\n")
    after = SourceTree(root).closure(["hoidata.stage"], {})
    assert {key for key in after if after[key] != before[key]} == {name}


def test_what_a_registry_picks_counts_only_for_those_who_reach_the_registry(root):
    chosen = {"hoidata.registry": [ADAPTER]}
    assert set(SourceTree(root).closure(["hoidata.stage"], chosen)) == OF_STAGE
    found = set(SourceTree(root).closure(["hoidata.registry"], chosen))
    assert {"hoidata/datasets/grab/adapter.py", "hoidata/datasets/grab/words.csv"} <= found
    assert "hoidata/datasets/h2o/adapter.py" not in found


def test_of_a_table_of_names_only_what_is_picked_counts(root):
    chosen = {"hoidata.registry": [replace(ADAPTER, is_table=True)]}
    found = SourceTree(root).closure(["hoidata.registry"], chosen)
    assert "hoidata/datasets/grab/adapter.py" in found
    assert "hoidata/registry.py" not in found


def test_files_that_a_module_reads_by_name_count_for_it_and_not_for_the_package_they_lie_in(root):
    chosen = {"hoidata.registry": [ADAPTER], "hoidata.reader": [SPLITS]}
    assert "hoidata/datasets/grab/splits.json" not in SourceTree(root).closure(["hoidata.registry"], chosen)
    found = SourceTree(root).closure(["hoidata.reader"], chosen)
    assert set(found) == {"hoidata/__init__.py", "hoidata/reader.py", "hoidata/datasets/grab/splits.json"}


def test_a_package_whose_folder_lies_elsewhere_is_named_as_it_is_imported(root, tmp_path_factory):
    folder = tmp_path_factory.mktemp("outside") / "kitchen"
    write_text(folder, {"adapter.py": "from hoidata.datasets.kitchen import words", "words.py": "", "facts.toml": ""})
    tree = SourceTree(root, {"hoidata.datasets.kitchen": folder})
    modules = tree.modules_below("hoidata.datasets.kitchen")
    assert modules == ["hoidata.datasets.kitchen.adapter", "hoidata.datasets.kitchen.words"]
    found = tree.closure(modules[:1], {})
    assert {f"hoidata/datasets/kitchen/{name}" for name in ("adapter.py", "words.py", "facts.toml")} <= set(found)


def test_a_package_that_registers_an_adapter_counts_with_its_files_and_version(root, tmp_path_factory, monkeypatch):
    site = tmp_path_factory.mktemp("site")
    write_text(
        site,
        {
            "toy_hoi/__init__.py": "",
            "toy_hoi/adapter.py": "from toy_hoi import words\nfrom hoidata.room import beside",
            "toy_hoi/words.py": "",
            "toy_hoi-1.2.dist-info/METADATA": "Metadata-Version: 2.1\nName: toy-hoi\nVersion: 1.2\n",
            "toy_hoi-1.2.dist-info/entry_points.txt": "[hoidata.adapters]\ntoy = toy_hoi.adapter:Toy\n",
        },
    )
    monkeypatch.syspath_prepend(str(site))
    tree = SourceTree(root)
    assert tree.added("hoidata.adapters", "toy") == ["toy_hoi.adapter"]
    found = tree.closure(["toy_hoi.adapter"], {})
    assert found["distribution toy-hoi"] == "1.2"
    assert {"toy_hoi/adapter.py", "toy_hoi/words.py", "hoidata/room/beside.py"} <= set(found)


@pytest.mark.parametrize("damage", ["", "[]", '{"x": 1}', '{"scanner": "another", "imports": %s}'])
def test_kept_imports_change_no_answer_and_damaged_ones_are_parsed_again(root, damage):
    (root / ".hoidata").mkdir()
    for _ in range(2):
        tree = SourceTree(root)
        assert set(tree.closure(["hoidata.stage"], {})) == OF_STAGE
        tree.keep_imports()
    assert (root / KNOWN_IMPORTS).is_file()
    (root / "hoidata/room/beside.py").write_text("import hoidata.typed")
    assert "hoidata/typed.py" in SourceTree(root).closure(["hoidata.stage"], {})
    nothing = {digest: [] for digest in SourceTree(root).closure(["hoidata.stage"], {}).values()}
    (root / KNOWN_IMPORTS).write_text(damage.replace("%s", json.dumps(nothing)))
    assert "hoidata/typed.py" in SourceTree(root).closure(["hoidata.stage"], {})


@settings(max_examples=10, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(MODULES), st.sampled_from(IMPORTS)), min_size=1, max_size=6))
def test_kept_imports_give_the_digests_of_a_fresh_look_whatever_was_edited(edits):
    with TemporaryDirectory() as folder:
        root = Path(folder)
        write_text(root, {".hoidata/x": "", **FILES})
        for name, text in edits:
            write_text(root, {name: text})
            tree = SourceTree(root)
            with_kept = tree.closure(["hoidata.stage"], {})
            tree.keep_imports()
            (root / KNOWN_IMPORTS).rename(root / "kept")
            assert with_kept == SourceTree(root).closure(["hoidata.stage"], {})
            (root / "kept").rename(root / KNOWN_IMPORTS)
