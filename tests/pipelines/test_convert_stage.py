"""The settings of conversion in params.yaml."""

from pathlib import Path

import pytest

from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.errors import BadInput
from pipelines.stages.adapters import ConvertSettings
from pipelines.stages.base import load_settings

PROJECT = Path(__file__).parents[2]


def params_of(folder: Path, text: str) -> ConvertSettings:
    path = folder / "params.yaml"
    path.write_text(text)
    return load_settings(ConvertSettings, "convert", path)


def test_the_committed_settings_are_every_adapters_defaults():
    params = load_settings(ConvertSettings, "convert", PROJECT / "params.yaml")
    assert params.adapter("grab") == GrabAdapter()


def test_a_dataset_may_have_a_margin_of_its_own(tmp_path):
    params = params_of(tmp_path, "convert: {margin_frames: 5, adapters: {arctic: {margin_frames: 2}, h2o: null}}")
    margins = {name: getattr(params.adapter(name), "margin_frames", None) for name in ("grab", "arctic", "h2o")}
    assert margins == {"grab": 5, "arctic": 2, "h2o": 5}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("convert: {margin: 5}", "keys among: margin_frames, adapters, got margin"),
        ("convert: {margin_frames: -1}", "margin_frames"),
        ("convert: {adapters: {grab: {margin: 1}}}", "settings of the adapter grab.*margin_frames.*got margin"),
    ],
)
def test_a_wrong_setting_is_named_with_the_known_ones(tmp_path, text, problem):
    with pytest.raises(BadInput, match=problem):
        params_of(tmp_path, text).adapter("grab")
