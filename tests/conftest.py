"""Fixtures shared by all tests, whose builders are in tests/builders; and the order in which modules begin."""

from collections.abc import Callable

import pytest

from hoidata.clips import Clip
from tests.builders.clips import build_clip


def pytest_configure(config: pytest.Config) -> None:
    """xdist would begin with the modules of many tests, and end with the few that take minutes."""
    config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.get_closest_marker("first") is None)


@pytest.fixture
def make_clip() -> Callable[..., Clip]:
    """See ``build_clip``."""
    return build_clip
