"""The hand-kept lists of dvc.yaml cover what the closures find, entry by entry; then the lists can go."""

from pathlib import Path

import pytest

from pipelines.lineage.graph import read_graph
from pipelines.stages.code import code_today

PROJECT = Path(__file__).parents[2]
TODAY = code_today(PROJECT)


def closure_of(name: str) -> set[str]:
    """``train-diffusion@embedded-grab`` to the file of code/ that stands for its list."""
    stage, _, rest = name.partition("@")
    parts = rest.split("-")[1:]
    if stage.startswith("train-"):
        return set(TODAY[f"train/{stage.removeprefix('train-')}"])
    return set(TODAY["/".join([stage, *parts[-1:]]) if stage not in ("evaluate", "report") else stage])


@pytest.mark.parametrize("name", sorted(read_graph(PROJECT)))
def test_the_list_and_the_closure_cover_the_same_files(name):
    listed = read_graph(PROJECT)[name].code
    files = closure_of(name)

    def covers(entry: str, file: str) -> bool:
        return file == entry or file.startswith(f"{entry}/")

    # The lists leave out the packages' own __init__, which hold a docstring, and lineage's.
    uncovered = [file for file in files if not any(covers(entry, file) for entry in listed)]
    assert [file for file in uncovered if not file.endswith("__init__.py")] == []
    # A list stands for all datasets: that of convert names what ManipNet's adapter alone imports.
    stage = name.partition("@")[0]
    of_all = {file for other in read_graph(PROJECT) if other.partition("@")[0] == stage for file in closure_of(other)}
    assert [entry for entry in listed if not any(covers(entry, file) for file in of_all)] == []
