"""The table of metrics: all methods compared, the best one, and comparisons with retrieval baselines."""

import json
from pathlib import Path

import jinja2
import pytest

from hoidata.errors import BadInput
from hoidata.metrics.registry import metric
from models.registry import family_names
from pipelines.pages.metrics_table import (
    ALL_METRICS,
    METHODS,
    NOT_COMPUTED,
    OTHER_EVALUATOR,
    RETRIEVAL_BASELINES,
    best_families,
    is_worse_than,
    markdown_table,
    metrics_tables,
    number,
    printed_table,
    unmeasured_lines,
)
from pipelines.params import read_params
from pipelines.stages.families import families_of

ACCURACY = "accuracy_top1_corrected"
FIGURES = {
    "ours": {"joint_error_mm": 30.0, "contact_f1": 0.5, "jitter_m_s3": 9.0, "realism_si_floor": 0.1, ACCURACY: 0.4},
    "nearest-clip": {"joint_error_mm": 40.0, "contact_f1": 0.6, "jitter_m_s3": 12.0, "realism_si_floor": 0.0},
    "ground-truth": {"joint_error_mm": 0.0, "contact_f1": 1.0, "jitter_m_s3": 14.0, "realism_si_floor": 0.0},
}
FAMILIES = ["ours", "untrained", "absent", "nearest-clip", "ground-truth"]


def written(figures, **more):
    values = {"figures": figures, "motions": 16, "held_out_clips": 2, "left_out": [], "synthetic": True}
    return json.dumps(values | {"evaluators": {"corrected": {"digest": "aa"}}} | more)


@pytest.fixture
def folder(tmp_path):
    for family, figures in FIGURES.items():
        (tmp_path / f"{family}.json").write_text(written(figures))
    more = {"left_out": [{"clip_id": "a", "reason": "b"}], "diagnostics": {"length": {"mae_frames": 10.25}}}
    spread = {"contact_f1": {"clips": [0.4, 0.7], "repetitions": [0.45, 0.55]}}
    (tmp_path / "ours.json").write_text(written(FIGURES["ours"], intervals=spread, **more))
    (tmp_path / "untrained.json").write_text(json.dumps({"empty": "not trained: <length>", "held_out_clips": 0}))
    (tmp_path / "controls").mkdir()
    (tmp_path / "controls" / "static.json").write_text(written({"contact_f1": 0.2, ACCURACY: 0.1}))
    return tmp_path


def table_of(folder):
    return metrics_tables(folder, FAMILIES)


def page_of(folder):
    """The section of a page, as its template has it."""
    environment = jinja2.Environment(loader=jinja2.PackageLoader("pipelines.pages", ""), autoescape=True)
    section = environment.from_string('{% import "metrics.html" as m %}{{ m.section(table) }}')
    return section.render(table=table_of(folder))


def cells_of(table, family):
    """The cells of one method by the titles of their columns."""
    number = [method.family for method in table.methods].index(family)
    return {
        column[0]: cell
        for topic in table.topics
        for column, cell in zip(topic.columns, topic.cells[number], strict=True)
    }


def title(name):
    return metric(name).title


def test_lines_are_families_then_controls_and_columns_are_measured_metrics(folder):
    table = table_of(folder)
    assert [method.family for method in table.methods] == [*FAMILIES, "static"]
    assert [method.kind for method in table.methods] == [
        "family",
        "family",
        "family",
        "retrieval",
        "recorded",
        "control",
    ]
    columns = {column[0]: column[1:] for topic in table.topics for column in topic.columns}
    assert columns[title("joint_error_mm")] == ("mm", "lower is better")
    assert columns[title("realism_si_floor")] == ("", "lower bound")
    assert columns[title("jitter_m_s3")] == ("m/s3", "closer to recorded is better")
    assert len(columns) == 5
    methods = {method.family: method for method in table.methods}
    assert cells_of(table, "ours")[title("joint_error_mm")].text == "30.0"
    assert cells_of(table, "static")[title("joint_error_mm")].text == NOT_COMPUTED
    assert methods["untrained"].empty == "not trained: <length>"
    assert methods["absent"].empty == "not evaluated"
    assert methods["ours"].note == "16 motions of 2 clips, 1 skipped"
    assert methods["ours"].diagnostics == [("length mae frames", "10.2")]


def test_with_an_evaluator_the_five_columns_of_the_paper_come_first(folder):
    columns = ["accuracy_top3_paper", "fid_paired_paper", "diversity_released_paper", "multimodality_released_paper"]
    columns.append("realism_released")
    values = {name: 0.1 * number for number, name in enumerate(columns, 1)}
    (folder / "ours.json").write_text(written(FIGURES["ours"] | values))
    table, titles = table_of(folder), {metric.name: metric.title for metric in ALL_METRICS}
    assert "Table 1" in table.topics[0].title
    assert [column[0] for column in table.topics[0].columns] == [titles[name] for name in columns]
    number_of_ours = [method.family for method in table.methods].index("ours")
    assert [cell.text for cell in table.topics[0].cells[number_of_ours]] == [number(x) for x in values.values()]


def test_the_best_family_is_marked_and_one_worse_than_retrieval_is_named(folder):
    table = table_of(folder)
    marks = {name: {key: cell.mark for key, cell in cells_of(table, name).items()} for name in FIGURES}
    contact, jitter, joints = title("contact_f1"), title("jitter_m_s3"), title("joint_error_mm")
    assert (marks["ours"][joints], marks["ours"][contact], marks["ours"][jitter]) == ("good", "bad", "bad")
    assert (marks["nearest-clip"][joints], marks["nearest-clip"][contact]) == ("", "good")
    assert not any(marks["ground-truth"].values())
    summary = {method.family: method.summary for method in table.methods}
    assert summary["ours"] == "worse than nearest-clip in 2 of 4 metrics"
    assert next(method.worse_in for method in table.methods if method.family == "ours") == [
        f"worse than nearest-clip: {contact}, {jitter}"
    ]
    assert not summary["nearest-clip"]
    assert not summary["static"]  # a control is expected to be worse


def test_closer_to_recorded_needs_the_recorded_value():
    column = {"ours": 9.0, "nearest-clip": 12.0}
    assert best_families(metric("jitter_m_s3"), column) == []
    assert not is_worse_than("nearest-clip", metric("jitter_m_s3"), "ours", column)
    assert best_families(metric("jitter_m_s3"), column | {"ground-truth": 8.0}) == ["ours"]


def test_a_value_that_is_numerically_zero_is_not_the_best(folder):
    for zero in (6e-6, 0.0, -6e-6):
        assert best_families(metric("joint_error_mm"), {"mean-pose": zero, "ours": 0.3}) == []
        assert number(zero) == "0.00"
    assert best_families(metric("joint_error_mm"), {"mean-pose": 2e-4, "ours": 0.3}) == ["mean-pose"]
    (folder / "nearest-clip.json").write_text(written({"joint_error_mm": 6e-6}))
    cell = cells_of(table_of(folder), "nearest-clip")[title("joint_error_mm")]
    assert (cell.text, cell.mark) == ("0.00", "")


def test_the_rows_are_explained(folder):
    assert dict(table_of(folder).meanings)["ground-truth"] == "the recorded test clip itself"
    assert "the recorded test clip itself" in page_of(folder)
    assert set(METHODS) <= set(family_names())
    shown = {*families_of(read_params(Path(__file__).parents[3]), "grab"), *RETRIEVAL_BASELINES}
    assert shown <= set(METHODS)


def test_values_of_different_evaluators_are_not_compared(folder):
    other = {"evaluators": {"corrected": {"digest": "bb"}}}
    (folder / "controls" / "static.json").write_text(written({ACCURACY: 0.9}, **other))
    table = table_of(folder)
    cells = [cell for cell in cells_of(table, "static").values() if cell.text != NOT_COMPUTED]
    assert [cell.text for cell in cells] == [OTHER_EVALUATOR]
    assert not [chart for topic in table.topics for chart in topic.charts if "accuracy" in chart.title]


def test_a_missing_value_has_its_reason(folder):
    (folder / "controls" / "static.json").write_text(written({}, notes={ACCURACY: "N too small"}))
    assert "N too small" in {cell.text for cell in cells_of(table_of(folder), "static").values()}


def test_a_chart_has_a_bar_for_every_method_with_its_intervals_on_one_scale(folder):
    charts = {chart.title: chart for topic in table_of(folder).topics for chart in topic.charts}
    chart = charts[title("contact_f1")]
    bars = {bar.family: bar for bar in chart.bars}
    assert set(bars) == {"ours", "nearest-clip", "ground-truth", "static"}
    assert (bars["ground-truth"].at, bars["static"].at, bars["ours"].at) == (100, 20, 50)
    assert bars["ours"].clips == (40, 70)
    assert bars["ours"].repetitions == (45, 55)
    assert chart.ends == ("0.00", "1.00")


def test_the_page_shows_comparisons_and_escapes_text(folder):
    text = page_of(folder)
    assert "<b>ours</b>: worse than nearest-clip in 2 of 4 metrics." in text
    assert f"worse than nearest-clip: {title('contact_f1')}" in text
    assert '<td class="number good">30.0</td>' in text
    assert "untrained: not evaluated, not trained: &lt;length&gt;" in text
    assert "Diagnostics of the networks of ours" in text
    assert 'title="0.400 to 0.700"' in text
    assert text.count("<svg") == 5


def test_markdown_marks_values_worse_than_retrieval(folder):
    lines = markdown_table(folder, FAMILIES, ["joint_error_mm", "contact_f1"]).splitlines()
    assert lines[0].startswith("| method | joint error of the best sample, mm (lower is better) |")
    assert lines[2:] == [
        "| ours | 30.0 | 0.500 (0.400 to 0.700; worse than retrieval) |", "| nearest-clip | 40.0 | 0.600 |",
        "| ground-truth | 0.00 | 1.00 |", "| static | - | 0.200 |", "",
        "- untrained: not evaluated, not trained: <length>", "- absent: not evaluated, not evaluated",
    ]  # fmt: skip
    with pytest.raises(BadInput, match="contact_f1"):
        markdown_table(folder, FAMILIES, ["contact_f2"])


def test_the_terminal_shows_intervals_and_reasons():
    evaluation = json.loads(
        written({"contact_f1": 0.5}, counts={"contact_f1": {"clips": 2, "motions": 4, "values": 4}},
                intervals={"contact_f1": {"clips": [0.4, 0.7]}}, notes={ACCURACY: "N too small"})
    )  # fmt: skip
    cells = [list(column.cells) for column in printed_table(evaluation).columns]
    assert cells[1] == ["0.500", "N too small"]
    assert cells[2] == ["0.400 to 0.700", ""]


def test_numbers_keep_three_digits():
    assert [number(value) for value in (1234567, 0.01234, 11.0, None, "x")] == ["1,234,567", "0.0123", "11.0", "", "x"]


NO_INSIDE = "the object has no inside"
PENETRATION, LENGTH, LENGTH_SHARE = "penetration_mm", "length_error_frames", "length_error_share"


@pytest.fixture
def partly(folder):
    """``ours`` has a penetration in 3 of 10 clips, ``static`` in none; no method has a length error."""
    for path, figures, missing in (
        (folder / "ours.json", FIGURES["ours"] | {PENETRATION: 2.0}, 7),
        (folder / "controls" / "static.json", {"contact_f1": 0.2}, 10),
        (folder / "nearest-clip.json", FIGURES["nearest-clip"] | {PENETRATION: 3.0}, 0),
        (folder / "ground-truth.json", FIGURES["ground-truth"], 10),
    ):
        unmeasured = {PENETRATION: {NO_INSIDE: missing}} if missing else {}
        length_given = {"the length was given": 10}
        more = {"unmeasured": unmeasured | {LENGTH: length_given, LENGTH_SHARE: length_given}}
        path.write_text(written(figures, counts={PENETRATION: {"clips": 10 - missing}}, **more))
    return folder


def test_a_metric_measured_in_some_clips_reports_the_coverage_and_the_reason(partly):
    cells = {name: cells_of(table_of(partly), name)[title(PENETRATION)] for name in ("ours", "nearest-clip", "static")}
    assert (cells["ours"].coverage, cells["ours"].note) == ("3 of 10", f"not measured: {NO_INSIDE}: 7 clips")
    assert (cells["nearest-clip"].coverage, cells["nearest-clip"].note) == ("", "")
    assert (cells["static"].text, cells["static"].note) == ("not measured", f"{NO_INSIDE}: 10 clips")


def test_an_unmeasured_metric_is_listed_below_its_topic_with_the_reason(partly):
    topic = next(topic for topic in table_of(partly).topics if topic.unmeasured)
    titles = f"{title(LENGTH)}; {title(LENGTH_SHARE)}"
    assert topic.unmeasured == [(titles, "the length was given: 10 clips")]
    text = page_of(partly)
    assert f"Not measured: {titles} (the length was given: 10 clips)." in text
    assert f'title="{NO_INSIDE}: 10 clips">not measured</td>' in text
    assert "3 of 10 clips</span>" in text


def test_a_chart_names_the_methods_without_a_bar(partly):
    charts = {chart.title: chart for topic in table_of(partly).topics for chart in topic.charts}
    assert charts[f"{title(PENETRATION)}, mm"].missing == "not measured: ground-truth, static"


def test_markdown_lists_unmeasured_metrics_below_the_table(partly):
    lines = markdown_table(partly, FAMILIES, [PENETRATION, LENGTH]).splitlines()
    assert "| ours | 2.00 (3 of 10 clips) | not measured |" in lines
    assert "| static | not measured | not measured |" in lines
    below = (
        f"- {title(PENETRATION)}: not measured, ours: {NO_INSIDE}: 7 clips; ground-truth, static: {NO_INSIDE}: 10 clips"
    )
    assert lines[-2:] == [below, f"- {title(LENGTH)}: not measured, the length was given: 10 clips"]


def test_the_terminal_lists_metrics_that_were_not_measured(partly):
    evaluation = json.loads((partly / "controls" / "static.json").read_text())
    evaluation["counts"] = {"contact_f1": {"clips": 10}}
    columns = [list(column.cells) for column in printed_table(evaluation).columns]
    methods = {name: (figure, clips) for name, figure, clips in zip(columns[0], columns[1], columns[-1], strict=True)}
    assert methods[title(PENETRATION)] == ("not measured", "0 of 10")
    assert methods[title("contact_f1")] == ("0.200", "10")
    assert f"not measured: {title(PENETRATION)}: {NO_INSIDE}: 10 clips" in unmeasured_lines(evaluation)
