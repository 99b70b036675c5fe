"""What ``bench gpu`` watches is a training that has met its clips; how it watches needs no GPU."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.gpu import WARM_UP, Watch, Watched, steps_until_seen, watched
from models.registry import load_network


def share_met(clips: int, copies: int, batch: int, steps: int) -> float:
    """Of clips and their copies, by drawing as a training does: every clip once an epoch, as itself or as one copy."""
    draws, epochs = np.random.default_rng(0), -(-steps * batch // clips)
    order = np.concatenate([draws.permutation(clips) for _ in range(epochs)])[: steps * batch]
    return len(set(zip(order, draws.integers(0, copies + 1, len(order)), strict=True))) / (clips * (1 + copies))


@pytest.mark.parametrize(("clips", "copies", "batch"), [(500, 8, 64), (573, 8, 16), (300, 3, 64)])
def test_a_training_is_watched_once_it_has_met_nearly_all_clips_and_copies(clips: int, copies: int, batch: int) -> None:
    steps = steps_until_seen(clips * (1 + copies), batch)
    assert share_met(clips, copies, batch, steps) > 0.985
    assert share_met(clips, copies, batch, steps // 3) < 0.985


def test_of_few_clips_the_first_steps_are_left_out_all_the_same() -> None:
    assert steps_until_seen(3, 64) == WARM_UP


def test_copies_of_clips_count_as_clips() -> None:
    network = replace(load_network("diffusion"), objective=lambda setup: (SimpleNamespace(), None))

    def begin(copies: int) -> Watch:
        def fit(observed: Any) -> None:
            observed.objective(SimpleNamespace(corpus=SimpleNamespace(train=range(500))))
            raise Watched

        return watched(network, fit, 1.0, copies, 64)

    assert begin(copies=0).warm_up == steps_until_seen(500, 64)
    assert begin(copies=8).warm_up == steps_until_seen(4_500, 64)
