"""An error about a missing file names the adapter's setting that makes it unnecessary."""

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hoidata.conformance.check import check_adapter
from hoidata.datasets import RawTree, SequenceKey, get_adapter
from hoidata.errors import BadInput, MissingResource
from hoidata.hands import load_embedded_hands
from pipelines.cli import app
from pipelines.commands.raw import _require_parts
from pipelines.stages.base import StagePaths
from pipelines.stages.raw import require_hand
from tests.builders import arctic, h2o, hoi4d, oakink2


def arctic_without_descriptions(root: Path) -> Path:
    arctic.write_two(root)
    shutil.rmtree(root / "description")
    return root


def oakink2_without_programs(root: Path) -> Path:
    oakink2.write_two(root)
    shutil.rmtree(root / "program")
    return root


def hoi4d_without_events(root: Path) -> Path:
    hoi4d.write_two(root)
    for path in root.rglob("action/color.json"):
        path.unlink()
    return root


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("arctic", arctic_without_descriptions),
        ("hoi4d", hoi4d_without_events),
        ("oakink2", oakink2_without_programs),
    ],
)
def test_a_scan_that_lacks_a_part_names_the_setting_that_makes_it_unnecessary(name: str, write, tmp_path: Path) -> None:
    root = write(tmp_path / "raw")
    with pytest.raises(BadInput) as caught:
        _require_parts(get_adapter(name), root)
    assert f"or set `{name}: {{clips: segments}}` under `convert.adapters` in params.yaml" in caught.value.remedy
    _require_parts(get_adapter(name, clips="segments"), root)
    findings = check_adapter(get_adapter(name), root, load_embedded_hands(), sequences=1, worker=False)
    (parts,) = (item for item in findings if "every part" in item.rule)
    assert parts.detail.endswith("; it is not needed with the setting clips=segments")


def test_a_conversion_that_lacks_events_or_descriptions_names_the_setting_too(tmp_path: Path) -> None:
    for name, root in (("arctic", arctic_without_descriptions), ("hoi4d", hoi4d_without_events)):
        adapter, raw = get_adapter(name), RawTree(root(tmp_path / name))
        with pytest.raises(BadInput) as caught:
            adapter.load(raw, adapter.sequences(raw.root)[0], load_embedded_hands())
        assert "set clips: " in caught.value.remedy


@pytest.mark.parametrize(("name", "setting"), [("h2o", "hands=keypoints"), ("hot3d", "hands=umetrack")])
def test_the_error_about_missing_mano_files_names_the_setting_that_needs_none(
    name: str, setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOIDATA_MANO", raising=False)
    result = CliRunner().invoke(app, ["convert", name, "--root", str(tmp_path), "--out", str(tmp_path / "store")])
    assert isinstance(result.exception, MissingResource)
    assert str(result.exception).endswith(f", or use --setting {setting}")
    key, _, value = setting.partition("=")
    (tmp_path / "params.yaml").write_text("profile: own\n")
    with pytest.raises(MissingResource, match="no MANO files are registered") as caught:
        require_hand(StagePaths("own", name))
    assert f"or set `{name}: {{{key}: {value}}}` under `convert.adapters`" in str(caught.value)
    (tmp_path / "params.yaml").write_text(f"convert: {{adapters: {{{name}: {{{key}: {value}}}}}}}\n")
    require_hand(StagePaths("own", name))


def test_a_copy_of_h2o_with_the_other_hands_names_the_setting_that_reads_them(tmp_path: Path) -> None:
    root, key = h2o.write_root(tmp_path), SequenceKey("h2o", "subject2", "subject2/k1/3")
    (folder,) = root.glob("subject2/k1/3/cam4/hand_pose_*")
    folder.rename(folder.with_name("hand_pose"))
    with pytest.raises(BadInput) as caught:
        get_adapter("h2o").load(RawTree(root), key, load_embedded_hands())
    assert "set hands: keypoints, which reads what is there" in caught.value.remedy
