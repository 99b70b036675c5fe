import json
import re
from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips.quarantine import Quarantined
from hoidata.store.annotated import load_annotated
from models.common.predicting import sample_family
from models.registry import load_family
from pipelines.pages.curves import Curve, Panel, log_curves, panels_svg, read_log
from pipelines.pages.examples import shown_ids
from pipelines.pages.player import three_javascript
from pipelines.pages.report import ReportFolders, write_report
from tests.builders.stores import write_annotated, write_clips

HELD_OUT = {"by": "subject", "train": "rest", "test": ["s2"], "promises": ["subject"]}
FAMILIES = ("ground-truth", "text2hoi")


@pytest.fixture
def folders(hands, page_clip, tmp_path):
    """Two datasets: one of three clips (one subject held out) and a sequence left out, one empty."""
    folders = ReportFolders.of("embedded", tmp_path)
    names = ("s1", "s2", "s3")
    clips = [replace(page_clip(hinged=name == "s2"), clip_id=f"test/{name}/box", subject=name) for name in names]
    left_out = Quarantined("test/s1/mug", "s1/mug.npz", "finite numbers", "NaN in <frame 3>", "download it again")
    root = folders.data / "grab"
    write_annotated(root, [*clips, left_out], "grab", HELD_OUT, 0.2)
    (folders.data / "arctic" / "clips").mkdir(parents=True)
    (folders.data / "arctic" / "clips" / "empty.json").write_text('{"reason": "arctic is not present"}')
    log = folders.checkpoints / "grab" / "contact" / "log.csv"
    log.parent.mkdir(parents=True)
    log.write_text("step,train_loss,validation_loss,note\n0,4.0,4.2,\n10,1.0,,\n20,0.1,0.3,last\n")
    figures = {"figures": {"contact_f1": 0.61}, "motions": 24, "held_out_clips": 12, "synthetic": True}
    (folders.metrics / "grab").mkdir(parents=True)
    (folders.metrics / "grab" / "ground-truth.json").write_text(json.dumps(figures))
    return folders


@pytest.fixture
def sampled(folders, hands):
    """The same with the motions of a family for the clip held out: the recorded one, twice."""
    out = folders.samples / "grab" / "ground-truth"
    family, params = load_family("ground-truth"), {"samples": 2}
    sample_family(family, folders.data / "grab", folders.checkpoints / "grab", out, params, hands)
    return folders


def write(folders, hands, out, *datasets):
    return write_report(out, "embedded", datasets, FAMILIES, hands, folders).read_text(encoding="utf-8")


def test_report_tells_what_is_in_each_dataset_and_what_was_left_out(folders, hands, tmp_path):
    text = write(folders, hands, tmp_path / "report", "grab", "arctic")
    assert "<td>arctic is not present</td>" in text
    assert "NaN in &lt;frame 3&gt;" in text
    assert "<b>3</b><span>clips</span>" in text
    assert "SYNTHETIC" in text
    assert '<td class="number ">0.610</td>' in text
    assert '<td colspan="1">not evaluated: not evaluated</td>' in text
    assert text.count("<svg") == 1


def test_recorded_and_generated_motion_and_contact_maps_stand_side_by_side(sampled, hands, tmp_path):
    first, second = (write(sampled, hands, tmp_path / name, "grab") for name in "ab")
    assert first == second
    assert first.count('<script type="application/octet-stream" class="glb">') == 4
    assert "Synthetic ground truth: Lift a box" in first
    assert "Generated: Lift a box" in first
    assert "24 motions of 12 clips" in first


def test_dataset_of_which_nothing_could_be_used_still_lists_why(folders, hands, tmp_path):
    left_out = Quarantined("test/s1/mug", "s1/mug.npz", "finite numbers", "NaN", "download it again")
    write_clips(folders.data / "h2o" / "clips", [left_out], "h2o")
    text = write(folders, hands, tmp_path / "report", "h2o")
    assert "Empty: no sequence gave a clip." in text
    assert "<td>finite numbers</td>" in text
    assert "Held-out figures" not in text


def test_report_repeats_byte_for_byte_and_fetches_nothing(folders, hands, tmp_path):
    first, second = (write(folders, hands, tmp_path / name, "grab", "arctic") for name in "ab")
    assert first == second
    assert not re.search(r"https?://", first.replace(three_javascript(), ""))


def test_shown_clips_are_held_out_ones(folders, hands):
    assert shown_ids(load_annotated(folders.data / "grab", hands), 3) == ["test/s2/box"]


def test_log_columns_become_curves_without_their_gaps(folders):
    curves = log_curves(read_log(folders.checkpoints / "grab" / "contact" / "log.csv"))
    assert [curve.name for curve in curves] == ["loss", "validation loss"]
    assert curves[1].x.tolist() == [0, 20]
    assert curves[1].y.tolist() == [4.2, 0.3]


def test_charts_repeat_and_keep_their_ids_apart():
    panels = [Panel("training", [Curve("loss", np.arange(5.0), np.arange(5.0) ** 2)])]
    assert panels_svg(panels, "step", "a") == panels_svg(panels, "step", "a")
    ids = [set(re.findall(r'id="([mp][0-9a-f]{10})"', panels_svg(panels, "step", salt))) for salt in "ab"]
    assert ids[0]
    assert not ids[0] & ids[1]


def test_wide_positive_ranges_are_drawn_logarithmically():
    x = np.arange(3.0)
    assert Panel("", [Curve("", x, np.array([1.0, 10, 30]))]).is_logarithmic
    assert not Panel("", [Curve("", x, np.array([-1.0, 10, 30]))]).is_logarithmic
    assert not Panel("", [Curve("", x, np.array([10.0, 20, 30]))]).is_logarithmic
