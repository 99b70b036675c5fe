"""Which number of the network's input is what: names of column groups, to switch sensors off and to scale by unit."""

from collections.abc import Iterable

import numpy as np

from hoidata.errors import BadInput
from hoidata.hands.tracked_hand import N_TIPS, TrackedHand
from hoidata.sensors.settings import CELLS
from models.manipnet.features import SAMPLE_NUMBERS, FeatureSettings

SHORT_FUTURE_S = 0.1
METRES, AXES, CELL, RAD_S, SHARE = 0.001, 0.01, 0.05, 0.05, 0.02  # the least spread a number is scaled by


def sizes(hand: TrackedHand, settings: FeatureSettings) -> dict[str, int]:
    """Numbers of each group in their order: pose, trajectory, ambient, proximity, distance, normal."""
    times = len(settings.sensors.times_s)
    return {
        "pose": 3 * _positions(hand) + 6 * hand.n_joints,
        "trajectory": SAMPLE_NUMBERS * len(settings.samples_s),
        "ambient": CELLS**3,
        "proximity": times * hand.n_sensors,
        "distance": times * hand.n_points,
        "normal": 3 * hand.n_points,
    }


def kept_columns(hand: TrackedHand, settings: FeatureSettings, without: Iterable[str]) -> np.ndarray:
    """(input,) float32: 0 for the numbers that are switched off, else 1.

    without: of ambient, proximity, signed-distance; distance for the last two together (the paper's "no distance"),
    sensors for all; future for what sensors say of later times; long-future for all that is later than 0.1 s.
    """
    kept = {name: np.ones(size, np.float32) for name, size in sizes(hand, settings).items()}
    switches = _switches(hand, settings, kept)
    for name in without:
        if name not in switches:
            raise BadInput("sensors to switch off", f"some of {', '.join(switches)}", name, "correct the name")
        for columns in switches[name]:
            columns[:] = 0
    return np.concatenate(list(kept.values()))


def _switches(hand: TrackedHand, settings: FeatureSettings, kept: dict[str, np.ndarray]) -> dict[str, list[np.ndarray]]:
    """By name the columns it switches off, as views of ``kept``."""
    later = np.array(settings.sensors.times_s) > 1e-9
    far = np.array(settings.sensors.times_s) > SHORT_FUTURE_S + 1e-9
    rows = {name: kept[name].reshape(len(later), -1) for name in ("proximity", "distance")}

    def at(times: np.ndarray) -> list[np.ndarray]:
        return [rows[name][number] for name in rows for number in np.flatnonzero(times)]

    samples = kept["trajectory"].reshape(-1, SAMPLE_NUMBERS)
    long = np.flatnonzero(settings.samples_s > SHORT_FUTURE_S + 1e-9)
    signed = [kept["distance"], kept["normal"]]
    return {
        "ambient": [kept["ambient"]],
        "proximity": [kept["proximity"]],
        "signed-distance": signed,
        "distance": [kept["proximity"], *signed],
        "sensors": [kept["ambient"], kept["proximity"], *signed],
        "future": at(later),
        "long-future": [*at(far), *(samples[number] for number in long)],
    }


def times_read_s(kept: np.ndarray, hand: TrackedHand, settings: FeatureSettings) -> tuple[float, float]:
    """The earliest and the latest time, seconds from now, of which a network with these kept columns reads anything.

    kept: (input,) as ``kept_columns`` gives. (A velocity also asks for one step before its sample.)
    """
    count = sizes(hand, settings)
    parts = dict(zip(count, np.split(kept, np.cumsum(list(count.values()))[:-1]), strict=True))
    samples = np.any(parts["trajectory"].reshape(-1, SAMPLE_NUMBERS), axis=1)
    times = np.array(settings.sensors.times_s)
    sensed = [np.any(parts[name].reshape(len(times), -1), axis=1) for name in ("proximity", "distance")]
    read = np.concatenate([[0.0], settings.samples_s[samples], *(times[seen] for seen in sensed)])
    return float(read.min()), float(read.max())


def floors(hand: TrackedHand, settings: FeatureSettings) -> tuple[np.ndarray, np.ndarray]:
    """(input,) and (output,): the least spread a number is scaled by, by what it is."""
    count = sizes(hand, settings)
    pose = np.repeat([METRES, AXES], [3 * _positions(hand), 6 * hand.n_joints])
    sample = np.repeat([METRES, AXES, METRES, RAD_S], [4, 6, 3, 3])
    inputs = [
        pose,
        np.tile(sample, count["trajectory"] // SAMPLE_NUMBERS),
        np.full(count["ambient"], CELL),
        np.full(count["proximity"] + count["distance"], METRES),
        np.full(count["normal"], CELL),
    ]
    return np.concatenate(inputs), np.concatenate([pose, np.full(hand.n_points, SHARE)])


def _positions(hand: TrackedHand) -> int:
    """How many positions a pose has: joints, tips, both ends of the palm's capsules."""
    return hand.n_joints + N_TIPS + 2 * len(hand.palm_capsules)
