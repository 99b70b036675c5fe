"""The tables made of all datasets: conventions from their facts, problems of input from their contracts."""

import re
from collections.abc import Iterable
from pathlib import Path

import pytest

import hoidata.datasets
import hoidata.files
from hoidata.dataset_folders import built_in_names
from hoidata.datasets.convention_table import table
from tests.hoidata.datasets.arctic.test_contract import TestArctic as Arctic
from tests.hoidata.datasets.contract import AdapterContract
from tests.hoidata.datasets.grab.test_contract import TestGrab as Grab
from tests.hoidata.datasets.h2o.test_contract import TestH2O as OfH2O
from tests.hoidata.datasets.hoi4d.test_contract import TestHoi4d as Hoi4d
from tests.hoidata.datasets.hot3d.test_contract import TestHot3d as Hot3d
from tests.hoidata.datasets.manipnet.test_contract import TestManipNet as ManipNet
from tests.hoidata.datasets.oakink2.test_contract import TestOakink2 as Oakink2
from tests.hoidata.datasets.taco.test_contract import TestTaco as Taco

CONTRACTS: tuple[type[AdapterContract], ...] = (OfH2O, Grab, Arctic, ManipNet, Taco, Hoi4d, Hot3d, Oakink2)
ROOM = Path(hoidata.datasets.__file__).parent


def as_markdown(contracts: Iterable[type[AdapterContract]]) -> str:
    """One line per problem, one column per dataset: the words of the error, or a dash where it cannot occur."""
    names, cells = [kind.name for kind in contracts], {}
    for kind in contracts:
        for row in kind.rows():
            cells.setdefault(row.problem, {})[kind.name] = f"{Path(row.where).name}: {row.says}"
    lines = [f"| problem | {' | '.join(names)} |", f"|---|{'---|' * len(names)}"]
    lines += [
        f"| {problem} | {' | '.join(found.get(name, '-') for name in names)} |" for problem, found in cells.items()
    ]
    return "\n".join(lines)


def test_every_built_in_dataset_is_under_contract() -> None:
    assert sorted(kind.name for kind in CONTRACTS) == built_in_names()


@pytest.mark.slow
def test_the_readme_of_files_prints_the_problems_of_all_contracts() -> None:
    assert as_markdown(CONTRACTS) in Path(hoidata.files.__file__).with_name("README.md").read_text()


def test_the_committed_table_of_conventions_is_made_of_the_facts() -> None:
    hint = "run: python -m hoidata.datasets.convention_table > hoidata/datasets/CONVENTIONS.md"
    assert (ROOM / "CONVENTIONS.md").read_text() == table(), hint
    assert sum(len(kind.conventions) for kind in CONTRACTS) >= 60


def test_no_dataset_imports_another_and_the_shared_code_imports_none() -> None:
    for path in (ROOM.parent / "dataset_folders.py", *ROOM.rglob("*.py")):
        owner = path.parent.name if path.parent.parent == ROOM else ""
        named = set(re.findall(r"hoidata\.datasets\.(\w+)", path.read_text())) & set(built_in_names())
        assert named <= {owner}, path


if __name__ == "__main__":
    print(as_markdown(CONTRACTS))
