"""Examples and notebooks run unchanged in a project."""

import json
import runpy
import sys
from pathlib import Path

import matplotlib
import pytest

PROJECT = Path(__file__).parents[2]
EXAMPLES = {
    "read_a_clip.py": ("data/embedded/grab",),
    "convert_a_folder.py": ("grab", ".hoidata/raw/embedded/grab", "example-store"),
    "train_on_batches.py": ("data/embedded/grab",),
    "measure_a_store.py": ("samples/embedded/grab/text2hoi/clips", "data/embedded/grab"),
}
NOTEBOOKS = sorted((PROJECT / "notebooks").glob("*.ipynb"))


def test_examples_are_short_and_every_one_is_run():
    lines_by_file = {path.name: path.read_text().splitlines() for path in (PROJECT / "examples").glob("*.py")}
    assert lines_by_file.keys() == EXAMPLES.keys()
    assert all(len(lines) <= 40 for lines in lines_by_file.values())


@pytest.mark.long
@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs(name, built, monkeypatch, capsys):
    monkeypatch.chdir(built)
    monkeypatch.setattr(sys, "argv", [name, *EXAMPLES[name]])
    runpy.run_path(str(PROJECT / "examples" / name), run_name="__main__")
    assert capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_is_stored_without_outputs(path, built, monkeypatch, capsys):
    matplotlib.use("agg")
    monkeypatch.chdir(built)
    names: dict = {}
    for cell in json.loads(path.read_text())["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            exec(compile("".join(cell["source"]), path.name, "exec"), names)
    matplotlib.pyplot.close("all")
    assert capsys.readouterr().out
