"""The import closure of a module, on packages in a temporary folder."""

import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.lineage.closure import CACHED_IMPORTS, Choice, SourceTree
from tests.builders.folders import write_text

STAGE = """import numpy

def run():
    try:
        from hoidata.kit import inside
    except OSError:
        pass
"""
FILES = {
    "hoidata/__init__.py": "",
    "hoidata/stage.py": STAGE,
    "hoidata/kit/__init__.py": "from hoidata.kit.shown import something",
    "hoidata/kit/inside.py": "from . import sibling",
    "hoidata/kit/sibling.py": "",
    "hoidata/kit/shown.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import hoidata.typed\n",
    "hoidata/kit/unused.py": "import hoidata.typed",
    "hoidata/kit/words.csv": "",
    "hoidata/kit/assets/hand.npz": "",
    "hoidata/kit/README.md": "",
    "hoidata/kit/below/module.py": "",
    "hoidata/kit/below/table.csv": "",
    "hoidata/typed.py": "",
    "hoidata/registry.py": "",
    "hoidata/reader.py": "",
    "hoidata/datasets/grab/adapter.py": "",
    "hoidata/datasets/grab/words.csv": "",
    "hoidata/datasets/grab/splits.json": "",
    "hoidata/datasets/h2o/adapter.py": "",
}
STAGE_FILES = {
    "hoidata/__init__.py",
    "hoidata/stage.py",
    "hoidata/kit/__init__.py",
    "hoidata/kit/inside.py",
    "hoidata/kit/sibling.py",
    "hoidata/kit/shown.py",
    "hoidata/kit/words.csv",
    "hoidata/kit/assets/hand.npz",
}
MODULES = ("hoidata/stage.py", "hoidata/kit/__init__.py", "hoidata/kit/inside.py", "hoidata/kit/sibling.py")
IMPORTS = ("", "import hoidata.typed", "from hoidata.kit import unused", "from . import sibling")
ADAPTER = Choice(modules=("hoidata.datasets.grab.adapter",))
SPLITS = Choice(package="hoidata.datasets.grab", files=("*.json",))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_text(tmp_path, FILES)


def test_the_closure_has_lazy_relative_and_package_imports_and_data_files(root):
    assert set(SourceTree(root).closure(["hoidata.stage"], {})) == STAGE_FILES


@pytest.mark.parametrize("name", sorted(STAGE_FILES))
def test_an_edit_of_a_file_changes_its_digest_alone(root, name):
    before = SourceTree(root).closure(["hoidata.stage"], {})
    (root / name).write_text(f"{FILES[name]}\n")
    after = SourceTree(root).closure(["hoidata.stage"], {})
    assert {key for key in after if after[key] != before[key]} == {name}


def test_the_choices_of_a_registry_count_only_if_the_registry_is_reached(root):
    chosen = {"hoidata.registry": [ADAPTER]}
    assert set(SourceTree(root).closure(["hoidata.stage"], chosen)) == STAGE_FILES
    closure = set(SourceTree(root).closure(["hoidata.registry"], chosen))
    assert {"hoidata/datasets/grab/adapter.py", "hoidata/datasets/grab/words.csv"} <= closure
    assert "hoidata/datasets/h2o/adapter.py" not in closure


def test_of_a_registry_only_the_selection_counts(root):
    chosen = {"hoidata.registry": [replace(ADAPTER, is_registry=True)]}
    closure = SourceTree(root).closure(["hoidata.registry"], chosen)
    assert "hoidata/datasets/grab/adapter.py" in closure
    assert "hoidata/registry.py" not in closure


def test_files_that_a_module_selects_count_for_the_module_and_not_for_their_package(root):
    chosen = {"hoidata.registry": [ADAPTER], "hoidata.reader": [SPLITS]}
    assert "hoidata/datasets/grab/splits.json" not in SourceTree(root).closure(["hoidata.registry"], chosen)
    closure = SourceTree(root).closure(["hoidata.reader"], chosen)
    assert set(closure) == {"hoidata/__init__.py", "hoidata/reader.py", "hoidata/datasets/grab/splits.json"}


def test_files_of_a_package_outside_of_the_project_have_their_import_path_as_key(root, tmp_path_factory):
    folder = tmp_path_factory.mktemp("outside") / "kitchen"
    write_text(folder, {"adapter.py": "from hoidata.datasets.kitchen import words", "words.py": "", "facts.toml": ""})
    tree = SourceTree(root, {"hoidata.datasets.kitchen": folder})
    modules = tree.modules_below("hoidata.datasets.kitchen")
    assert modules == ["hoidata.datasets.kitchen.adapter", "hoidata.datasets.kitchen.words"]
    closure = tree.closure(modules[:1], {})
    assert {f"hoidata/datasets/kitchen/{name}" for name in ("adapter.py", "words.py", "facts.toml")} <= set(closure)


def test_a_package_that_registers_an_adapter_counts_with_its_files_and_version(root, tmp_path_factory, monkeypatch):
    site = tmp_path_factory.mktemp("site")
    write_text(
        site,
        {
            "toy_hoi/__init__.py": "",
            "toy_hoi/adapter.py": "from toy_hoi import words\nfrom hoidata.kit import sibling",
            "toy_hoi/words.py": "",
            "toy_hoi-1.2.dist-info/METADATA": "Metadata-Version: 2.1\nName: toy-hoi\nVersion: 1.2\n",
            "toy_hoi-1.2.dist-info/entry_points.txt": "[hoidata.adapters]\ntoy = toy_hoi.adapter:Toy\n",
        },
    )
    monkeypatch.syspath_prepend(str(site))
    tree = SourceTree(root)
    assert tree.entry_point_modules("hoidata.adapters", "toy") == ["toy_hoi.adapter"]
    closure = tree.closure(["toy_hoi.adapter"], {})
    assert closure["distribution toy-hoi"] == "1.2"
    assert {"toy_hoi/adapter.py", "toy_hoi/words.py", "hoidata/kit/sibling.py"} <= set(closure)


@pytest.mark.parametrize("damage", ["", "[]", '{"x": 1}', '{"scanner": "another", "imports": %s}'])
def test_cached_imports_change_no_result_and_a_damaged_cache_is_ignored(root, damage):
    (root / ".hoidata").mkdir()
    for _ in range(2):
        tree = SourceTree(root)
        assert set(tree.closure(["hoidata.stage"], {})) == STAGE_FILES
        tree.save_imports()
    assert (root / CACHED_IMPORTS).is_file()
    (root / "hoidata/kit/sibling.py").write_text("import hoidata.typed")
    assert "hoidata/typed.py" in SourceTree(root).closure(["hoidata.stage"], {})
    no_imports = {digest: [] for digest in SourceTree(root).closure(["hoidata.stage"], {}).values()}
    (root / CACHED_IMPORTS).write_text(damage.replace("%s", json.dumps(no_imports)))
    assert "hoidata/typed.py" in SourceTree(root).closure(["hoidata.stage"], {})


@settings(max_examples=10, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(MODULES), st.sampled_from(IMPORTS)), min_size=1, max_size=6))
def test_cached_and_parsed_imports_give_the_same_digests_after_edits(edits):
    with TemporaryDirectory() as folder:
        root = Path(folder)
        write_text(root, {".hoidata/x": "", **FILES})
        for name, text in edits:
            write_text(root, {name: text})
            tree = SourceTree(root)
            with_cache = tree.closure(["hoidata.stage"], {})
            tree.save_imports()
            (root / CACHED_IMPORTS).rename(root / "hidden")
            assert with_cache == SourceTree(root).closure(["hoidata.stage"], {})
            (root / "hidden").rename(root / CACHED_IMPORTS)
