"""The table of metrics: every family beside the others, what is best, and who loses to a clip that was looked up."""

import json

import jinja2
import pytest

from hoidata.errors import BadInput
from hoidata.metrics.registry import metric
from pipelines.pages.metrics_table import NO_FIGURE, best_families, loses_to_lookup, metrics_tables, number

FIGURES = {
    "ours": {"joint_error_mm": 30.0, "contact_f1": 0.5, "jitter_m_s3": 9.0, "realism_si_floor": 0.1},
    "nearest-clip": {"joint_error_mm": 40.0, "contact_f1": 0.6, "jitter_m_s3": 12.0, "realism_si_floor": 0.0},
    "ground-truth": {"joint_error_mm": 0.0, "contact_f1": 1.0, "jitter_m_s3": 14.0, "realism_si_floor": 0.0},
}


@pytest.fixture
def folder(tmp_path):
    for family, figures in FIGURES.items():
        values = {"figures": figures, "motions": 16, "held_out_clips": 2, "left_out": [], "synthetic": True}
        if family == "ours":
            values |= {"left_out": [{"clip_id": "a", "reason": "b"}], "diagnostics": {"length": {"mae_frames": 10.25}}}
        (tmp_path / f"{family}.json").write_text(json.dumps(values))
    (tmp_path / "untrained.json").write_text(json.dumps({"empty": "not trained: <length>", "held_out_clips": 0}))
    return tmp_path


def table_of(folder):
    return metrics_tables(folder, ["ours", "untrained", "absent", "nearest-clip", "ground-truth"])


def test_rows_are_families_and_columns_metrics_that_one_of_them_has(folder):
    table = table_of(folder)
    assert [column[1:] for column in table.columns] == [
        ("mm", "lower is better"), ("", "higher is better"), ("", "a floor"), ("m/s3", "nearer the truth")
    ]  # fmt: skip
    rows = {row.family: row for row in table.rows}
    assert [cell.text for cell in rows["ours"].cells] == ["30.0", "0.500", "0.100", "9.00"]
    assert rows["untrained"].empty == "not trained: <length>"
    assert rows["absent"].empty == "not evaluated"
    assert rows["ours"].note == "16 motions of 2 clips, 1 left out"
    assert rows["ours"].diagnostics == [("length mae frames", "10.2")]


def test_the_best_family_is_marked_and_one_that_loses_to_the_lookup_said_in_words(folder):
    rows = {row.family: row for row in table_of(folder).rows}
    assert [cell.mark for cell in rows["ours"].cells] == ["good", "bad", "", "bad"]
    assert [cell.mark for cell in rows["nearest-clip"].cells] == ["", "good", "", "good"]
    assert [cell.mark for cell in rows["ground-truth"].cells] == [""] * 4
    contact, jitter = metric("contact_f1").title, metric("jitter_m_s3").title
    assert rows["ours"].words == f"loses to nearest-clip: {contact}, {jitter}"
    assert not rows["nearest-clip"].words


def test_nearer_the_truth_needs_the_truth():
    column = {"ours": 9.0, "nearest-clip": 12.0}
    assert best_families(metric("jitter_m_s3"), column) == []
    assert not loses_to_lookup(metric("jitter_m_s3"), "ours", column)
    assert best_families(metric("jitter_m_s3"), column | {"ground-truth": 8.0}) == ["ours"]


def test_a_metric_a_family_has_no_value_of_leaves_a_gap(folder):
    (folder / "ours.json").write_text(json.dumps({"figures": {}, "motions": 1, "held_out_clips": 1}))
    assert {cell.text for cell in table_of(folder).rows[0].cells} == {NO_FIGURE}


def test_the_page_says_it_and_escapes_what_it_is_given(folder):
    loader = jinja2.PackageLoader("pipelines.pages", "")
    environment = jinja2.Environment(loader=loader, autoescape=True)
    text = environment.from_string('{% import "metrics.html" as m %}{{ m.section(table) }}').render(
        table=table_of(folder)
    )
    assert "ours loses to nearest-clip: F1 of the contact map made" in text
    assert '<td class="number good">30.0</td>' in text
    assert "not evaluated: not trained: &lt;length&gt;" in text
    assert "What ours says of its own networks" in text
    assert text.count("<tr>") == 1 + 5


def test_numbers_keep_three_digits():
    assert [number(value) for value in (1234567, 0.01234, 11.0, None, "x")] == ["1,234,567", "0.0123", "11.0", "", "x"]


def with_evaluator(folder, family, digest, **notes):
    path = folder / f"{family}.json"
    values = json.loads(path.read_text()) | {"evaluators": {"corrected": {"digest": digest}}, "notes": notes}
    values["figures"] |= {} if notes else {"fid_frechet_corrected": 0.25}
    path.write_text(json.dumps(values))


def test_a_figure_that_must_not_be_given_says_why(folder):
    with_evaluator(folder, "ours", "aa", fid_frechet_corrected="N too small")
    with_evaluator(folder, "nearest-clip", "aa")
    table = table_of(folder)
    column = [title for title, *_ in table.columns].index("Frechet distance, corrected")
    assert [row.cells[column].text for row in table.rows if row.cells] == ["N too small", "0.250", NO_FIGURE]


def test_rows_of_evaluators_with_other_weights_are_not_compared(folder):
    with_evaluator(folder, "ours", "aaaaaaaaaa")
    with_evaluator(folder, "nearest-clip", "bbbbbbbbbb")
    with pytest.raises(BadInput, match=r"one corrected evaluator.*aaaaaaaa of ours; bbbbbbbb of nearest-clip"):
        table_of(folder)
