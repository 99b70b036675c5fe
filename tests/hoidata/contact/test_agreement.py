"""How far contact maps agree, and the settings an output of the stage was made with."""

import json

import numpy as np
import pytest

from hoidata.contact.agreement import f1_score
from hoidata.contact.settings import ContactSettings, read_contact_settings
from hoidata.errors import BadInput, MissingResource


@pytest.mark.parametrize(
    ("made", "true", "score"),
    [([1, 1, 0, 0], [1, 0, 1, 0], 0.5), ([0, 0], [0, 0], 1.0), ([1, 1], [0, 0], 0.0), ([1, 0, 1], [1, 1, 1], 0.8)],
)
def test_f1_is_the_harmonic_mean_of_precision_and_recall(made, true, score):
    assert f1_score(np.array(made, dtype=bool), np.array(true, dtype=bool)) == pytest.approx(score)


def test_the_settings_of_an_output_are_read_from_it(tmp_path):
    (tmp_path / "info.json").write_text(json.dumps({"points": 64, "threshold_m": 0.015, "other": 1}))
    assert read_contact_settings(tmp_path) == ContactSettings(64, 0.015)
    with pytest.raises(MissingResource, match="contact"):
        read_contact_settings(tmp_path / "absent")
    (tmp_path / "info.json").write_text(json.dumps({"points": 0, "threshold_m": 0.015}))
    with pytest.raises(BadInput, match="at least 1 point"):
        read_contact_settings(tmp_path)
