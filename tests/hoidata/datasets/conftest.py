"""Parametrizes the tests of ``AdapterContract`` with the file problems and settings of each subclass."""

import pytest

from tests.hoidata.datasets.contract import FileProblem


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """One test per file problem and setting of a subclass of ``AdapterContract``."""
    kind = metafunc.cls
    if "file_problem" in metafunc.fixturenames and hasattr(kind, "file_problems"):
        params = []
        for problem in (FileProblem(*row) for row in kind.file_problems()):
            is_slow = kind.slow or problem.name == "zip bomb"
            params.append(pytest.param(problem, id=problem.name, marks=pytest.mark.slow if is_slow else ()))
        metafunc.parametrize("file_problem", params)
    if "format_problem" in metafunc.fixturenames:
        problems = [pytest.param(FileProblem(*row), id=row[0]) for row in kind.format_problems()]
        metafunc.parametrize("format_problem", problems)
    if "setting" in metafunc.fixturenames and hasattr(kind, "bad_settings"):
        metafunc.parametrize("setting", list(kind.bad_settings))
