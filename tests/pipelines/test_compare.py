"""``hoidata compare`` prints statistics of two corpora and writes their values."""

import json

from typer.testing import CliRunner

from hoidata.metrics.corpus_statistics import STATISTICS, corpus_statistics
from hoidata.store.annotated import load_annotated
from pipelines.cli import app
from tests.builders.clips import build_clip
from tests.builders.stores import write_annotated


def test_the_command_prints_every_statistic_and_writes_the_values(tmp_path):
    folder = write_annotated(tmp_path / "a", [build_clip(n_frames=40)], "test")
    done = CliRunner().invoke(app, ["compare", str(folder), str(folder), "--out", str(tmp_path / "out.json")])
    assert done.exit_code == 0, done.output
    assert all(name in done.output for name in STATISTICS)
    assert "not measured" in done.output  # a rigid object has no hinge
    written = json.loads((tmp_path / "out.json").read_text())
    assert written["grasp duration"]["values"] == corpus_statistics(load_annotated(folder))["grasp duration"].tolist()
