import json
import re
from dataclasses import replace

import numpy as np
import pytest

from hoidata.clips.quarantine import Quarantined
from models.common.training import UPSTREAM, train_model
from pipelines.pages.curves import Curve, Panel, log_curves, panels_svg, read_log
from pipelines.pages.examples import shown_ids
from pipelines.pages.metrics_table import metrics_tables
from pipelines.pages.player import three_javascript
from pipelines.pages.report import ReportFolders, write_report
from tests.builders.stores import write_annotated, write_clips

HELD_OUT = {"by": "subject", "train": "rest", "test": ["s2"], "promises": ["subject"]}
DIFFUSION = {"joint_error_mm": 50, "joint_error_mean_pose_mm": 90}


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
    folders.metrics.mkdir(parents=True)
    figures = {"contact": {"f1": 0.61, "f1_mean_map": 0.4, "clips": 12}, "held_out_clips": 12}
    (folders.metrics / "grab.json").write_text(json.dumps(figures))
    return folders


TINY = {
    "contact": {"network": {"point_net": {"widths": [8, 8, 16], "heads": [8, 8], "align": False}, "latent": 4}},
    "length": {"network": {"width": 16}},
    "diffusion": {"network": {"transformer": {"width": 32, "heads": 2, "layers": 1, "feed_forward": 32}}},
    "refiner": {"network": {"transformer": {"width": 32, "heads": 2, "layers": 1, "feed_forward": 32}}},
}


@pytest.fixture
def trained(folders):
    """The same with four models that were trained for two steps."""
    checkpoints = folders.checkpoints / "grab"
    for model, upstream in UPSTREAM.items():
        above = {upstream: checkpoints / upstream} if upstream else None
        plan = TINY[model] | {"training": {"steps": 2, "batch": 2, "validate_every": 1}}
        train_model(model, folders.data / "grab", checkpoints / model, plan, upstream=above, threads=1)
    return folders


def test_report_tells_what_is_in_each_dataset_and_what_was_left_out(folders, hands, tmp_path):
    text = write_report(tmp_path / "report", "embedded", ["grab", "arctic"], hands, folders).read_text()
    assert "<td>arctic is not present</td>" in text
    assert "NaN in &lt;frame 3&gt;" in text
    assert "<b>3</b><span>clips</span>" in text
    assert "SYNTHETIC" in text
    assert re.search(r'F1 of the contact map</td><td class="number good">0.610</td>\s*<td><b class="plain">0.4', text)
    assert text.count("<svg") == 1


@pytest.mark.slow
def test_recorded_and_generated_motion_and_contact_maps_stand_side_by_side(trained, hands, tmp_path):
    first, second = (write_report(tmp_path / name, "embedded", ["grab"], hands, trained).read_bytes() for name in "ab")
    text = first.decode()
    assert first == second
    assert text.count('<script type="application/octet-stream" class="glb">') == 4
    assert "Synthetic ground truth: Lift a box" in text
    assert "Generated: Lift a box" in text
    assert "2 SYNTHETIC test clips" in text
    assert text.count("<svg") == 4


def test_dataset_of_which_nothing_could_be_used_still_lists_why(folders, hands, tmp_path):
    left_out = Quarantined("test/s1/mug", "s1/mug.npz", "finite numbers", "NaN", "download it again")
    write_clips(folders.data / "h2o" / "clips", [left_out], "h2o")
    text = write_report(tmp_path / "report", "embedded", ["h2o"], hands, folders).read_text()
    assert "Empty: no sequence gave a clip." in text
    assert "<td>finite numbers</td>" in text
    assert "Held-out figures" not in text


def test_report_repeats_byte_for_byte_and_fetches_nothing(folders, hands, tmp_path):
    first, second = (
        write_report(tmp_path / name, "embedded", ["grab", "arctic"], hands, folders).read_bytes() for name in "ab"
    )
    assert first == second
    assert not re.search(r"https?://", first.decode().replace(three_javascript(), ""))


def test_shown_clips_are_held_out_ones(folders, hands):
    from hoidata.store.annotated import load_annotated

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


def test_every_figure_of_a_metrics_file_reaches_the_table_beside_its_baseline():
    figures = {"mae_frames": 10.25, "mae_mean_length_frames": 14, "clips": 40}
    (table,) = metrics_tables({"length": figures, "synthetic": True})
    (row,) = table.rows
    assert (row.value, row.baselines, row.verdict) == ("10.2", [("mean length", "14")], "good")
    assert table.notes == ["clips 40"]
    assert metrics_tables({"other": {"deep": {"figure": 0.5}}})[0].notes == ["deep figure 0.500"]
    assert metrics_tables({"contact": {"empty": "no clips"}})[0].empty == "no clips"


@pytest.mark.parametrize(
    ("model", "figures", "verdict"),
    [
        ("contact", {"f1": 0.44, "f1_mean_map": 0.40}, "bad"),
        ("contact", {"f1": 0.46, "f1_mean_map": 0.40}, "good"),
        ("length", {"mae_frames": 9.0, "mae_mean_length_frames": 10.0}, "bad"),
        ("diffusion", DIFFUSION | {"joint_error_shuffled_prompt_mm": 40}, "bad"),
        ("diffusion", DIFFUSION | {"joint_error_shuffled_prompt_mm": 60}, "good"),
        ("diffusion", DIFFUSION, ""),
    ],
)
def test_verdict_asks_for_the_margin_of_the_project(model, figures, verdict):
    assert metrics_tables({model: figures})[0].rows[0].verdict == verdict
