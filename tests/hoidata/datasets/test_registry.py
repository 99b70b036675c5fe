"""Built-in adapters and those of other packages: found by entry point, listed with their origin, settings checked."""

import importlib
from pathlib import Path

import pytest

from hoidata.dataset_folders import built_in_names
from hoidata.datasets import adapter_names, get_adapter
from hoidata.datasets.base import Adapter
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.datasets.registry import ENTRY_POINT_GROUP, FACTS, registered_adapters
from hoidata.errors import BadInput, MissingResource


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Make it look as if a package registered an adapter: metadata in a folder of ``sys.path``."""

    def write(package: str, adapter: str, target: str) -> None:
        folder = tmp_path / package / f"{package}-3.1.dist-info"
        folder.mkdir(parents=True)
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 3.1\n")
        (folder / "entry_points.txt").write_text(f"[{ENTRY_POINT_GROUP}]\n{adapter} = {target}\n")
        monkeypatch.syspath_prepend(str(tmp_path / package))
        importlib.invalidate_caches()

    return write


def row(name: str):
    return next(item for item in registered_adapters() if item.name == name)


def test_an_adapter_of_another_package_is_found_after_the_built_in_ones(install) -> None:
    install("attic", "attic", "hoidata.datasets.grab.adapter:GrabAdapter")
    assert adapter_names() == [*built_in_names(), "attic"]
    assert get_adapter("attic", margin_frames=4) == GrabAdapter(margin_frames=4)
    assert row("attic").origin == "attic 3.1"
    assert row("grab").origin == "built in"


def test_a_package_cannot_take_the_place_of_a_built_in_adapter(install) -> None:
    install("impostor", "grab", "hoidata.datasets.h2o.adapter:H2OAdapter")
    assert isinstance(get_adapter("grab"), GrabAdapter)
    assert adapter_names() == built_in_names()


def test_a_package_that_cannot_be_imported_is_named_and_hides_no_other(install) -> None:
    install("broken", "attic", "no_such_module:Adapter")
    with pytest.raises(MissingResource, match=r"'attic' of broken 3.1 cannot be imported: ModuleNotFoundError"):
        get_adapter("attic")
    assert "no_such_module" in row("attic").problem
    assert isinstance(row("h2o").adapter, Adapter)


def test_two_packages_with_one_name_are_both_named(install) -> None:
    install("one", "attic", "hoidata.datasets.grab.adapter:GrabAdapter")
    install("two", "attic", "hoidata.datasets.grab.adapter:GrabAdapter")
    with pytest.raises(MissingResource, match=r"one 3.1, two 3.1\): uninstall all but one"):
        get_adapter("attic")
    assert adapter_names().count("attic") == 1


def test_settings_are_the_fields_that_are_no_facts() -> None:
    assert row("grab").settings["margin_frames"] == 0
    assert not set(row("grab").settings) & set(FACTS)
    with pytest.raises(BadInput, match=r"margin_frames.*got licence"):
        get_adapter("grab", licence="mine")


def test_every_built_in_adapter_has_a_margin() -> None:
    assert all("margin_frames" in row(name).settings for name in built_in_names())
