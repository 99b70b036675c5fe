"""Options of ``hoidata generate`` that cannot be meant are refused before anything is generated."""

import pytest
from typer.testing import CliRunner

from hoidata.errors import BadInput
from pipelines.cli import app


@pytest.mark.parametrize("length", ["nan", "inf", "-inf"])
def test_a_length_that_is_no_number_of_seconds(length: str, tmp_path) -> None:
    words = ["generate", "Lift a box.", "--object", "box", "--out", str(tmp_path / "out"), f"--length={length}"]
    found = CliRunner().invoke(app, words)
    assert isinstance(found.exception, BadInput)
    assert "--length: expected seconds" in str(found.exception)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["--seed=100000000000000000000", "--seed=-1", "--out={file}"])
def test_a_seed_no_array_holds_and_a_file_in_the_place_of_the_folder(option: str, tmp_path) -> None:
    file = tmp_path / "out"
    file.write_text("mine")
    words = ["generate", "Lift a box.", "--object", "box", "--out", str(tmp_path / "new"), option.format(file=file)]
    found = CliRunner().invoke(app, words)
    assert found.exit_code == 2
    assert file.read_text() == "mine"
    assert not (tmp_path / "new").exists()
