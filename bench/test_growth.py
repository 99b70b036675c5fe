"""The benches' word on growth: a fixed part is told from one per clip, and a bend is called one."""

import pytest

from bench.growth import growth

CLIPS = [66, 660, 6592]


@pytest.mark.parametrize(
    ("cost", "verdict"),
    [
        (lambda n: 9 + 0.5 * n, "linear within 20% (1.00)"),
        (lambda n: 0.5 * n + 1e-4 * n * n, "MORE THAN LINEAR"),
        (lambda n: 100 * n**0.5, "less than linear"),
        (lambda n: 7.0, "does not grow"),
    ],
    ids=["line", "square", "root", "fixed"],
)
def test_growth_is_named_for_what_it_is(cost, verdict: str) -> None:
    assert growth(CLIPS, [cost(n) for n in CLIPS]).verdict.startswith(verdict)


def test_what_a_run_costs_however_small_is_told_apart() -> None:
    found = growth([1, *CLIPS], [0.0, *(9 + 0.5 * n for n in CLIPS)])
    assert found.fixed == pytest.approx(9)
    assert found.earlier == found.later == pytest.approx(0.5)
