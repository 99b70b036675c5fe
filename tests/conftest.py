"""Fixtures shared by all tests; the builders behind them are in tests/builders."""

from collections.abc import Callable

import pytest

from hoidata.clips import Clip
from tests.builders.clips import build_clip


@pytest.fixture
def make_clip() -> Callable[..., Clip]:
    """See ``build_clip``."""
    return build_clip
