"""How near the fingers come to the recorded ones in the wrist's frame, beside poses that need no network."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.clips.clip import FPS, SIDES, Side
from hoidata.hands import HandPair
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.surface_index import surface_index
from models.common.family import Figures, Sources
from models.manipnet.control import Control
from models.manipnet.features import FeatureSettings
from models.manipnet.lookups import Lookup, as_right, control_inputs, joint_errors_m, mean_rotmats
from models.manipnet.tracks import control_of, finger_rotmats_of, hands_of, trajectories_of

NEAREST = 10


class RecordedHand(NamedTuple):
    """An active hand of a clip. fingers: (frame, 15, 3, 3) as recorded; used: numbers of the tracked frames."""

    side: Side
    hand: TrackedHand
    control: Control
    fingers: np.ndarray
    used: np.ndarray


def recorded_hands(sample: ClipSample, pair: HandPair) -> list[RecordedHand]:
    """Every active hand of a clip that is tracked in some frame."""
    hands = hands_of(pair, sample.betas, sample.template_m)
    control = control_of(trajectories_of(sample), sample.object_model)
    return [
        RecordedHand(
            side, hands[side], control, finger_rotmats_of(sample.hands[row]), np.flatnonzero(sample.valid[row])
        )
        for row, side in enumerate(SIDES)
        if sample.active_hands[row] and sample.valid[row].any()
    ]


def diagnose(
    sources: Sources,
    settings: FeatureSettings,
    follow: Callable[[ClipSample], Mapping[Side, np.ndarray]],
) -> Figures:
    """Joint errors on test clips: the rollout of ``follow`` (by side (frame, 15, 3, 3)), and what it has to beat."""
    train = [one for sample in _samples(sources, "train") for one in recorded_hands(sample, sources.hands)]
    test = [(sample, one) for sample in _samples(sources, "test") for one in recorded_hands(sample, sources.hands)]
    if not train or not test:
        return {}
    rivals = _rivals(train, settings)
    errors: dict[str, list[np.ndarray]] = {}
    made: dict[str, Mapping[Side, np.ndarray]] = {}
    for sample, one in test:
        if sample.clip_id not in made:
            made = {sample.clip_id: follow(sample)}
        answers = {"joint_error_mm": made[sample.clip_id][one.side]} | rivals(one)
        for name, fingers in answers.items():
            found = joint_errors_m(one.hand, fingers[one.used], one.fingers[one.used])
            errors.setdefault(name, []).append(found.mean(axis=1))
    means = {name: round(1000 * float(np.concatenate(found).mean()), 3) for name, found in errors.items()}
    return {"manipnet": means}


def _samples(sources: Sources, split: str) -> Sequence[ClipSample]:
    return list(HoiDataset(sources.annotated, split, crop="start"))


def _rivals(
    train: Sequence[RecordedHand], settings: FeatureSettings
) -> Callable[[RecordedHand], dict[str, np.ndarray]]:
    """What answers without a network: neutral pose, mean training pose, nearest training frame and mean of ten."""
    fingers = [as_right(one.hand, one.fingers[one.used]) for one in train]
    lookup = Lookup.of(train[0].hand, settings, [_inputs(one, settings) for one in train], fingers)
    mean = mean_rotmats(np.concatenate(fingers))

    def answer(one: RecordedHand) -> dict[str, np.ndarray]:
        n_frames = len(one.fingers)
        inputs = _inputs(one, settings)
        found = {}
        for name, count in (("nearest_frame", 1), ("mean_of_10", NEAREST)):
            poses = np.tile(one.hand.rest_rotmats, (n_frames, 1, 1, 1))
            poses[one.used] = as_right(one.hand, lookup.poses(inputs, count))
            found[f"joint_error_{name}_mm"] = poses
        still = {"neutral": one.hand.rest_rotmats, "mean_pose": as_right(one.hand, mean)}
        return found | {f"joint_error_{name}_mm": np.tile(pose, (n_frames, 1, 1, 1)) for name, pose in still.items()}

    return answer


def _inputs(one: RecordedHand, settings: FeatureSettings) -> np.ndarray:
    surface = surface_index(one.control.model)
    return control_inputs(one.control, one.side, one.hand, one.used / FPS, surface, settings)
