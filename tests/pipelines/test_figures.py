"""The leading figures as DVC reads them."""

import json

from pipelines.figures import write_figures


def test_a_leading_metric_that_was_not_measured_is_named_with_its_reason_apart_from_the_numbers(tmp_path):
    metrics, out = tmp_path / "metrics" / "arctic", tmp_path / "out"
    metrics.mkdir(parents=True)
    out.mkdir()
    figures = {"contact_f1": 0.5}
    without = {"deep_share": {"the object has no inside": 257}, "slip_cm_s": {"no such frame": 3}}
    (metrics / "ours.json").write_text(json.dumps({"figures": figures, "unmeasured": without}))
    (metrics / "whole.json").write_text(json.dumps({"figures": figures}))
    write_figures(out, tmp_path / "metrics", tmp_path / "checkpoints", {"arctic": ["ours", "whole"]})
    assert json.loads((out / "figures.json").read_text()) == {
        "arctic": {"ours": figures, "whole": figures},
        "not measured": {"arctic": {"ours": {"deep_share": "the object has no inside: 257 clips"}}},
    }
