"""Settings dataclasses from mappings: defaults, nested settings, and errors with the full key."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest

from hoidata import settings
from hoidata.errors import BadInput
from hoidata.settings import build_config, plain_config, require_at_least


@dataclass(frozen=True)
class Bound:
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Inner:
    widths: tuple[int, ...] = (1, 2)


@dataclass(frozen=True)
class Example:
    count: int = 3
    size_m: float = 0.5
    deep: bool = False
    kind: Literal["round", "square"] = "round"
    inner: Inner = field(default_factory=Inner)
    bounds: Mapping[str, Bound] = field(default_factory=lambda: {"mass": Bound(0.0, 1.0), "age": Bound(None, 9.0)})
    free: Mapping[str, Any] = field(default_factory=dict)


def built(**values: Any) -> Example:
    return build_config(Example, values, "params.yaml: example")


def test_no_values_give_the_defaults():
    assert build_config(Example, None, "here") == Example() == built()


def test_values_replace_their_defaults_only():
    example = built(size_m=1, inner={"widths": [4]}, bounds={"mass": {"high": 2}}, free={"a": None})
    assert (example.size_m, type(example.size_m)) == (1.0, float)
    assert example.inner == Inner((4,))
    assert example.bounds == {"mass": Bound(0.0, 2.0), "age": Bound(None, 9.0)}
    assert (example.count, example.free) == (3, {"a": None})


def test_plain_config_round_trips():
    example = built(bounds={"age": {"low": 1}}, inner={"widths": [7, 8]})
    assert build_config(Example, plain_config(example), "here") == example


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"cuont": 1}, "example: expected keys among: count, size_m, deep, kind, inner, bounds, free, got cuont"),
        ({"inner": {"width": 1}}, "example.inner: expected keys among: widths, got width"),
        ({"bounds": {"weight": {}}}, "example.bounds: expected keys among: mass, age, got weight"),
        ({"bounds": {"mass": {"most": 1}}}, "example.bounds.mass: expected keys among: low, high, got most"),
        ({"bounds": {"mass": {"high": "x"}}}, "example.bounds.mass.high: expected float, got 'x'"),
        ({"bounds": {"mass": 3}}, "example.bounds.mass: expected keys with values, got 3"),
        ({"count": 1.5}, "example.count: expected int, got 1.5"),
        ({"count": True}, "example.count: expected int, got True"),
        ({"deep": 1}, "example.deep: expected bool, got 1"),
        ({"kind": "flat"}, "example.kind: expected one of round, square, got 'flat'"),
        ({"inner": 4}, "example.inner: expected keys with values, got 4"),
    ],
)
def test_an_error_has_the_key_and_what_was_expected(values: dict, message: str):
    with pytest.raises(BadInput) as raised:
        built(**values)
    assert message in str(raised.value)


def test_a_setting_without_default_is_required():
    with pytest.raises(BadInput, match="bound: expected a value for high"):
        build_config(Bound, {"low": 1}, "bound")


def test_a_number_instead_of_a_list_is_refused():
    with pytest.raises(BadInput, match=r"example.inner.widths: expected a list, got 0.003; write \[...\]"):
        built(inner={"widths": 0.003})


def test_a_value_below_the_minimum_is_refused():
    require_at_least("here", Example(), "count", 3)
    with pytest.raises(BadInput, match=r"here\.count: expected 4 or more, got 3"):
        require_at_least("here", Example(), "count", 4)


def test_a_renamed_key_is_refused_with_its_new_name(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(settings.RENAMED_KEYS, "cuont", "count")
    with pytest.raises(BadInput, match="got cuont; cuont is now count"):
        built(cuont=1)
    with pytest.raises(BadInput, match="got cuont; correct it"):
        build_config(Inner, {"cuont": 1}, "here")
