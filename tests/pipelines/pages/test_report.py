import json
import re
from dataclasses import replace

import numpy as np
import pytest

from hoidata.annotation.stage import annotate_store
from hoidata.contact.stage import contact_store
from hoidata.objects.sampling import sample_points
from hoidata.schema.quarantine import Quarantined
from hoidata.schema.splits import SplitRule
from hoidata.schema.store import write_store
from pipelines.pages.curves import Curve, curves_svg, log_curves, read_log
from pipelines.pages.examples import shown_ids
from pipelines.pages.generation_page import GeneratedMotion
from pipelines.pages.metrics_table import metrics_tables, number
from pipelines.pages.player import three_javascript
from pipelines.pages.report import ReportFolders, write_report

DIFFUSION = {"joint_error_mm": 50, "joint_error_mean_pose_mm": 90}


@pytest.fixture
def folders(hands, page_clip, tmp_path):
    """Two datasets: one of three clips (one subject held out) and a sequence left out, one empty."""
    folders = ReportFolders.of("embedded", tmp_path)
    names = ("s1", "s2", "s3")
    clips = [replace(page_clip(hinged=name == "s2"), clip_id=f"test/{name}/box", subject=name) for name in names]
    left_out = Quarantined("test/s1/mug", "s1/mug.npz", "finite numbers", "NaN in <frame 3>", "download it again")
    root = folders.data / "grab"
    info = {"dataset": "grab", "synthetic": True, "hand_model": {"name": hands.name, "digest": hands.digest}}
    write_store(root / "clips", [*clips, left_out], info)
    annotate_store(root / "clips", root / "annotation", encoder="hash", split=SplitRule(test=("s2",)), threshold_m=0.2)
    contact_store(root / "clips", root / "contact", threshold_m=0.2)
    (folders.data / "arctic" / "clips").mkdir(parents=True)
    (folders.data / "arctic" / "clips" / "empty.json").write_text('{"reason": "arctic is not present"}')
    log = folders.checkpoints / "grab" / "contact" / "log.csv"
    log.parent.mkdir(parents=True)
    log.write_text("step,train_loss,validation_loss,note\n0,4.0,4.2,\n10,1.0,,\n20,0.1,0.3,last\n")
    folders.metrics.mkdir(parents=True)
    figures = {"contact": {"f1": 0.61, "f1_mean_map": 0.4, "clips": 12}, "held_out_clips": 12}
    (folders.metrics / "grab.json").write_text(json.dumps(figures))
    return folders


@pytest.fixture
def motion(hands, page_clip):
    clip = page_clip()
    points = sample_points(clip.object.model)
    text, contact = "Lift a box with the right hand.", np.ones((2, 1024))
    return GeneratedMotion(
        clip, hands, text, "right", "named in the sentence", 5, points, contact, True, answers_to="test/s2/box"
    )


def test_report_tells_what_is_in_each_dataset_and_what_was_left_out(folders, hands, tmp_path):
    text = write_report(tmp_path / "report", "embedded", ["grab", "arctic"], hands, folders=folders).read_text()
    assert "<td>arctic is not present</td>" in text
    assert "NaN in &lt;frame 3&gt;" in text
    assert "<b>3</b><span>clips</span>" in text
    assert "SYNTHETIC" in text
    assert re.search(
        r'F1 of the contact map</td><td class="number good">0.61</td>\s*<td><b class="plain">0.4</b>', text
    )
    assert text.count("<svg") == 1


def test_recorded_and_generated_motion_stand_side_by_side(folders, hands, motion, tmp_path):
    page = write_report(tmp_path / "report", "embedded", ["grab"], hands, {"grab": motion}, folders)
    text = page.read_text()
    assert text.count('<script type="application/octet-stream" class="glb">') == 2
    assert "Synthetic ground truth: Lift a box" in text
    assert "test/s2/box (held out)" in text


def test_report_repeats_byte_for_byte_and_fetches_nothing(folders, hands, motion, tmp_path):
    pages = [
        write_report(tmp_path / name, "embedded", ["grab", "arctic"], hands, {"grab": motion}, folders) for name in "ab"
    ]
    first, second = (page.read_bytes() for page in pages)
    assert first == second
    assert not re.search(r"https?://", first.decode().replace(three_javascript(), ""))


def test_shown_clips_are_held_out_ones(folders, hands):
    from hoidata.schema.annotated import load_annotated

    assert shown_ids(load_annotated(folders.data / "grab", hands), 3) == ["test/s2/box"]


def test_log_columns_become_curves_without_their_gaps(folders):
    curves = log_curves(read_log(folders.checkpoints / "grab" / "contact" / "log.csv"))
    assert [curve.name for curve in curves] == ["train loss", "validation loss"]
    assert curves[1].x.tolist() == [0, 20]
    assert curves[1].y.tolist() == [4.2, 0.3]


def test_charts_repeat_and_keep_their_ids_apart():
    curve = Curve("train loss", np.arange(5.0), np.arange(5.0) ** 2)
    assert curves_svg([curve], "step", "loss", "a") == curves_svg([curve], "step", "loss", "a")
    ids = [set(re.findall(r'id="([mp][0-9a-f]{10})"', curves_svg([curve], "step", "loss", salt))) for salt in "ab"]
    assert ids[0]
    assert not ids[0] & ids[1]


def test_every_figure_of_a_metrics_file_reaches_the_table_beside_its_baseline():
    figures = {"mae_frames": 10.25, "mae_mean_length_frames": 14, "clips": 40}
    (table,) = metrics_tables({"length": figures, "synthetic": True})
    (row,) = table.rows
    assert (row.value, row.baselines, row.verdict) == ("10.2", [("mean length", "14")], "good")
    assert table.notes == ["clips 40"]
    assert metrics_tables({"other": {"deep": {"figure": 0.5}}})[0].notes == ["deep figure 0.5"]
    assert metrics_tables({"contact": {"empty": "no clips"}})[0].empty == "no clips"


@pytest.mark.parametrize(
    ("model", "figures", "verdict"),
    [
        ("contact", {"f1": 0.44, "f1_mean_map": 0.40}, "bad"),
        ("contact", {"f1": 0.46, "f1_mean_map": 0.40}, "good"),
        ("length", {"mae_frames": 9.0, "mae_mean_length_frames": 10.0}, "bad"),
        (
            "diffusion",
            {"joint_error_mm": 50, "joint_error_mean_pose_mm": 90, "joint_error_shuffled_prompt_mm": 40},
            "bad",
        ),
        ("diffusion", DIFFUSION | {"joint_error_shuffled_prompt_mm": 40}, "bad"),
        ("diffusion", DIFFUSION | {"joint_error_shuffled_prompt_mm": 60}, "good"),
        ("diffusion", DIFFUSION, ""),
    ],
)
def test_verdict_asks_for_the_margin_of_the_project(model, figures, verdict):
    assert metrics_tables({model: figures})[0].rows[0].verdict == verdict


def test_numbers_keep_three_digits():
    assert [number(value) for value in (1234567, 0.01234, 2.0, None, "x")] == ["1,234,567", "0.0123", "2", "", "x"]
