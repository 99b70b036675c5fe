"""The field table is the truth: files hold it, README.md says it."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

import hoidata.store.fields as fields
from hoidata.store_check.describe import readme

README = Path(fields.__file__).with_name("README.md")


def test_the_readme_is_the_one_the_table_gives():
    assert README.read_text() == readme(), "run: python -m hoidata.store_check.describe > hoidata/store/README.md"


def test_places_and_angles_have_a_unit_and_a_frame():
    for file in (fields.FRAMES, fields.BODY, fields.OBJECT_ARRAYS, fields.TEMPLATES):
        for field in file.fields:
            coordinates = field.shape[-1] in (3, 9, 45, 63) and field.dtype.startswith("float")
            assert bool(field.frame and field.unit) == (coordinates or field.name.endswith("hinge_rad")), field.name
    for file in fields.STORE_FILES:
        for field in file.fields:
            if field.name.endswith("_m"):
                assert field.unit == "metre", field.name


def test_written_files_hold_what_the_table_says(folder):
    for file in (fields.FRAMES, fields.BODY, fields.SOURCE_CONTACT):
        with np.load(folder / file.path.replace("*", "00000")) as archive:
            assert archive.files == [field.name for field in file.fields]
            for field in file.fields:
                assert archive[field.name].dtype == field.dtype
                assert archive[field.name].shape[1:] == field.row_shape
    for file in fields.TABLES.values():
        assert pq.read_schema(folder / file.path).names == [field.name for field in file.fields]
    info = json.loads((folder / "meta" / "info.json").read_text())
    for field in fields.INFO.fields:
        fields.value_at(info, field.name)
    assert info["axes"]["<side>_hand_pose"] == ["frame", "joint x axis-angle"]
