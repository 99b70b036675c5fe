"""A stage that depends on settings which params.yaml lacks is refused with what to add."""

from pathlib import Path

import pytest

from hoidata.errors import BadInput
from pipelines.repro import require_settings

STAGES = """
stages:
  train:
    wdir: ../..
    cmd: python -m pipelines.stages train --model toy
    params:
      - train.seed
      - train.${train.preset}.toy
    outs: [checkpoints/toy]
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "models/toy").mkdir(parents=True)
    (tmp_path / "models/toy/dvc.yaml").write_text(STAGES)
    (tmp_path / "dvc.yaml").write_text("stages: {}\n")
    return tmp_path


def test_a_stage_whose_section_is_missing_is_refused_with_the_line_to_add(project: Path) -> None:
    (project / "params.yaml").write_text("train: {preset: ours, seed: 0, ours: {contact: {}}}\n")
    with pytest.raises(
        BadInput, match=r"params.yaml: train.ours.toy: expected a section .*add `toy: {}` under `train.ours`"
    ):
        require_settings(project)


def test_an_empty_section_is_enough(project: Path) -> None:
    (project / "params.yaml").write_text("train: {preset: ours, seed: 0, ours: {toy: {}}}\n")
    require_settings(project)


def test_this_projects_settings_are_complete() -> None:
    require_settings(Path(__file__).parents[2])
