"""Tests of ``AdapterContract``, one for each row and setting of a subclass."""

import pytest


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Every row and setting of a subclass of ``AdapterContract`` is a test of its own."""
    kind = metafunc.cls
    if "row" in metafunc.fixturenames and hasattr(kind, "rows"):
        rows = [(row, kind.slow or row.problem == "zip bomb") for row in kind.rows()]
        marks = {True: pytest.mark.slow, False: ()}
        metafunc.parametrize("row", [pytest.param(row, id=row.problem, marks=marks[slow]) for row, slow in rows])
    if "further_row" in metafunc.fixturenames:
        metafunc.parametrize("further_row", [pytest.param(row, id=row.problem) for row in kind.further_rows()])
    if "setting" in metafunc.fixturenames and hasattr(kind, "bad_settings"):
        metafunc.parametrize("setting", list(kind.bad_settings))
