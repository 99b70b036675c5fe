"""The registry finds built-in adapters and those of other packages, lists their origin and checks their settings.

Also the generated table of conventions, and the imports between dataset packages.
"""

import importlib
import re
from pathlib import Path

import pytest

import hoidata.datasets
import hoidata.files
from hoidata.dataset_folders import built_in_names
from hoidata.datasets import adapter_names, get_adapter
from hoidata.datasets.base import Adapter
from hoidata.datasets.convention_table import table
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.datasets.registry import ENTRY_POINT_GROUP, FACTS, registered_adapters
from hoidata.errors import BadInput, MissingResource
from tests.hoidata.datasets.arctic.test_contract import TestArctic as Arctic
from tests.hoidata.datasets.contract import AdapterContract
from tests.hoidata.datasets.grab.test_contract import TestGrab as Grab
from tests.hoidata.datasets.h2o.test_contract import TestH2O as OfH2O
from tests.hoidata.datasets.hoi4d.test_contract import TestHoi4d as Hoi4d
from tests.hoidata.datasets.hot3d.test_contract import TestHot3d as Hot3d
from tests.hoidata.datasets.manipnet.test_contract import TestManipNet as ManipNet
from tests.hoidata.datasets.oakink2.test_contract import TestOakink2 as Oakink2
from tests.hoidata.datasets.taco.test_contract import TestTaco as Taco


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Simulate an installed package that registers an adapter: its metadata is in a folder of ``sys.path``."""

    def write(package: str, adapter: str, target: str) -> None:
        folder = tmp_path / package / f"{package}-3.1.dist-info"
        folder.mkdir(parents=True)
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 3.1\n")
        (folder / "entry_points.txt").write_text(f"[{ENTRY_POINT_GROUP}]\n{adapter} = {target}\n")
        monkeypatch.syspath_prepend(str(tmp_path / package))
        importlib.invalidate_caches()

    return write


def registered(name: str):
    return next(item for item in registered_adapters() if item.name == name)


def test_an_adapter_of_another_package_is_found_after_the_built_in_ones(install) -> None:
    install("attic", "attic", "hoidata.datasets.grab.adapter:GrabAdapter")
    assert adapter_names() == [*built_in_names(), "attic"]
    assert get_adapter("attic", margin_frames=4) == GrabAdapter(margin_frames=4)
    assert registered("attic").origin == "attic 3.1"
    assert registered("grab").origin == "built in"


def test_a_package_cannot_replace_a_built_in_adapter(install) -> None:
    install("impostor", "grab", "hoidata.datasets.h2o.adapter:H2OAdapter")
    assert isinstance(get_adapter("grab"), GrabAdapter)
    assert adapter_names() == built_in_names()


def test_a_package_that_cannot_be_imported_is_named_and_hides_no_other(install) -> None:
    install("broken", "attic", "no_such_module:Adapter")
    with pytest.raises(MissingResource, match=r"'attic' of broken 3.1 cannot be imported: ModuleNotFoundError"):
        get_adapter("attic")
    assert "no_such_module" in registered("attic").problem
    assert isinstance(registered("h2o").adapter, Adapter)


def test_two_packages_with_one_name_are_both_named(install) -> None:
    install("one", "attic", "hoidata.datasets.grab.adapter:GrabAdapter")
    install("two", "attic", "hoidata.datasets.grab.adapter:GrabAdapter")
    with pytest.raises(MissingResource, match=r"one 3.1, two 3.1\): uninstall all but one"):
        get_adapter("attic")
    assert adapter_names().count("attic") == 1


def test_settings_are_the_fields_that_are_not_facts() -> None:
    assert registered("grab").settings["margin_frames"] == 0
    assert not set(registered("grab").settings) & set(FACTS)
    with pytest.raises(BadInput, match=r"margin_frames.*got licence"):
        get_adapter("grab", licence="mine")


def test_every_built_in_adapter_has_the_setting_margin_frames() -> None:
    """``convert.margin_frames`` in params.yaml is passed to the adapter of every dataset."""
    lacking = [name for name in built_in_names() if "margin_frames" not in registered(name).settings]
    assert not lacking, (
        f"add the field `margin_frames: int = 0` to the adapter of {', '.join(lacking)}: `convert.margin_frames` in "
        "params.yaml sets it for every dataset (frames at 30 fps that a clip keeps before and after its interaction; "
        "see 'Settings' in hoidata/datasets/README.md)"
    )


CONTRACTS: tuple[type[AdapterContract], ...] = (OfH2O, Grab, Arctic, ManipNet, Taco, Hoi4d, Hot3d, Oakink2)
PACKAGE = Path(hoidata.datasets.__file__).parent


def test_every_built_in_dataset_has_a_contract_test() -> None:
    hint = "list the subclass of AdapterContract of every dataset in CONTRACTS"
    assert sorted(kind.name for kind in CONTRACTS) == built_in_names(), hint


def test_the_committed_table_of_conventions_is_generated_from_the_facts() -> None:
    hint = "run: python -m hoidata.datasets.convention_table > hoidata/datasets/CONVENTIONS.md"
    assert (PACKAGE / "CONVENTIONS.md").read_text() == table(), hint
    assert sum(len(kind.conventions) for kind in CONTRACTS) >= 60


def test_no_dataset_imports_another_and_the_shared_code_imports_none() -> None:
    for path in (PACKAGE.parent / "dataset_folders.py", *PACKAGE.rglob("*.py")):
        owner = path.parent.name if path.parent.parent == PACKAGE else ""
        named = set(re.findall(r"hoidata\.datasets\.(\w+)", path.read_text())) & set(built_in_names())
        assert named <= {owner}, path
