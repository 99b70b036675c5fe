"""The report's section on quality control: measures, limits, and excluded clips with reasons."""

from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import pytest

from hoidata.quality.stage import quality_store
from hoidata.quality.thresholds import CLIP_MEASURES, DEFAULT_LIMITS, MESH_MEASURES
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from pipelines.pages.quality import measures_svg, read_quality
from pipelines.pages.report import ReportFolders, write_report
from tests.builders.clips import jumping, with_object

LIMITS = {name: asdict(limit) for name, limit in DEFAULT_LIMITS.items()}

JUMP = "largest sudden step of a corner of the object: 1.74 m at frame 19, above 0.2 m"


@pytest.fixture(scope="module")
def folders(hands, page_clip, tmp_path_factory):
    """A dataset of three clips: the second jumps, the third has an open mesh."""
    clips = [replace(page_clip(frames=40), clip_id=f"test/s1/{number}") for number in range(3)]
    clips[1] = jumping(clips[1], 20, 1.0)
    model = clips[2].object.model
    clips[2] = with_object(clips[2], model=replace(model, name="open box", faces=model.faces[1:]))
    folders = ReportFolders.of("embedded", tmp_path_factory.mktemp("quality"))
    write_store(folders.data / "grab" / "clips", clips, generated_info("grab", hands))
    quality_store(folders.data / "grab" / "clips", folders.data / "grab" / "quality", progress=False)
    return folders


def test_page_lists_excluded_clips_with_reasons(folders, hands, tmp_path):
    text = write_report(tmp_path / "report", "embedded", {"grab": ["ground-truth"]}, hands, folders).read_text()
    assert "Of 3 clips 2 pass, 0 have warnings and 1 are excluded from annotation" in text
    assert f"<td>test/s1/1</td><td>{JUMP}</td>" in text
    assert "<td>open box</td><td>warned</td><td>share of edges at a hole" in text
    assert "penetration not measured: the mesh of open box is not solid (1 clip)." in text
    assert "Not measured: deepest hand vertex inside the object (the mesh of the object is not solid: 1 clip)." in text
    assert text.count("<svg") == 1


def test_every_measure_is_listed_with_median_worst_and_counts(folders):
    facts = read_quality(folders.data / "grab" / "quality", "grab")
    assert facts is not None
    assert [measure_row.words for measure_row in facts.clips] == [measure.words for measure in CLIP_MEASURES]
    assert [measure_row.words for measure_row in facts.meshes] == [measure.words for measure in MESH_MEASURES]
    jump = facts.clips[5]
    assert (jump.median, jump.worst, jump.worst_id) == ("0", "1.74", "test/s1/1")
    assert (jump.warn, jump.leave_out, jump.warned, jump.left_out) == ("0.05", "0.2", 0, 1)
    hole = facts.meshes[0]
    assert (hole.worst_id, hole.leave_out, hole.warned, hole.left_out) == ("open box", "", 1, 0)
    assert facts.failed == [("test/s1/1", JUMP)]
    missing = {words: (why, count) for words, why, count in facts.unmeasured}
    assert missing["deepest hand vertex inside the object"] == ("the mesh of the object is not solid", 1)


def test_dataset_without_quality_control_has_no_section(folders, hands, tmp_path):
    assert read_quality(tmp_path / "nowhere", "grab") is None
    write_store(folders.data / "h2o" / "clips", [], generated_info("h2o", hands))
    quality_store(folders.data / "h2o" / "clips", folders.data / "h2o" / "quality", progress=False)
    assert read_quality(folders.data / "h2o" / "quality", "h2o") is None


def table(**columns: list[float]) -> pd.DataFrame:
    return pd.DataFrame({measure.name: [np.nan, np.nan] for measure in CLIP_MEASURES} | columns)


def test_chart_shows_limits_within_reach_as_lines_and_names_those_beyond():
    wrist = [measure for measure in CLIP_MEASURES if measure.name == "wrist_acceleration_m_s2"]
    near = measures_svg(table(wrist_acceleration_m_s2=[10.0, 40.0]), wrist, LIMITS, "a")
    far = measures_svg(table(wrist_acceleration_m_s2=[1.0, 2.0]), wrist, LIMITS, "a")
    assert "60 →" not in near
    assert "#b5371f" in near
    assert "60 →" in far
    assert all("#c98a00" in chart for chart in (near, far))


def test_unmeasured_measures_have_no_chart():
    two = [measure for measure in CLIP_MEASURES if measure.name in ("penetration_m", "gap_share")]
    chart = measures_svg(table(gap_share=[0.0, 0.1]), two, LIMITS, "a")
    assert "gap share" in chart
    assert "penetration" not in chart
