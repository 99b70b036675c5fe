"""ManipNet's live stream with random faults of a tracker, compared with the stream of the same motion without faults.

``python -m bench soak``. HOIDATA_BENCH_PROJECT: a project with a ManipNet network of the embedded profile and the clips
of its dataset (.); HOIDATA_BENCH_DATASET: its name (grab); HOIDATA_BENCH_MINUTES: duration of the motion (30). Clips in
which the right hand acts are played forward and back at 60 Hz, each for 20 s and without waiting; then the object is
exchanged and the wrists jump. Fingers are those of the right hand; both wrists are tracked. Latency is that of a
tracker at 60 Hz with one free core, computed from processor time: a push begins when its frame has arrived and the push
before has ended. Fails if a pose is missing or not finite, if a joint moves further in one step than without faults, or
if a fault changes poses for longer than 0.5 s after its end.
"""

import os
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import trimesh

from bench.harness import show
from hoidata.clips.clip import SIDES, Side
from hoidata.geometry.motion import Motion
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.model import ObjectModel
from hoidata.sensors.mano_hand import mano_hands
from hoidata.store.annotated import load_annotated
from models.common.checkpoints import load_checkpoint
from models.manipnet.control import Control, control_from_clip
from models.manipnet.network import ManipNet
from models.manipnet.rollout import Predictor
from models.manipnet.stream import Stream, TrackedFrame, tracked_frames
from models.manipnet.training import MANIPNET

TRACKER_HZ, CLIP_S = 60, 20.0
LOOK_AHEAD_S, LIMIT_S = 0.55, 0.5  # a pose reads a fault this long before it; a fault may be felt this long after it
TOLERANCE = 1.1  # of the largest step: one step of a blend may add to it
SAME_M = 0.008  # poses with a smaller mean joint distance count as equal
NAN = RigidTransform(np.full((3, 3), np.nan), np.full(3, np.nan))
SHEARED = RigidTransform(np.diag([1.0, 1, 3]), np.zeros(3))
AWAY_M = np.array([0.3, 0.0, 0.0])  # more than a body moves in a frame
# Of a wrist or the object of one hand, of whole frames, and of their times.
KINDS = ("one hand", "jump", "returns elsewhere", "NaN pose", "sheared pose", "no object", "other object",
         "no frames", "NaN time", "repeated", "late")  # fmt: skip


def box(size_m: tuple[float, float, float]) -> ObjectModel:
    mesh = trimesh.creation.box(size_m)
    return ObjectModel("box", np.asarray(mesh.vertices), np.asarray(mesh.faces), np.zeros(8, np.uint8))


def forward_and_back(control: Control, length_s: float) -> Control:
    """Play a motion forward and back, from time 0, at the tracker's rate."""
    recorded_s = control.object_motion.time_s
    time_s, end_s = np.arange(round(length_s * TRACKER_HZ)) / TRACKER_HZ, recorded_s[-1] - recorded_s[0]
    played = control.at(recorded_s[0] + end_s - np.abs(time_s % (2 * end_s) - end_s))

    def at(motion: Motion) -> Motion:
        return replace(motion, time_s=time_s)

    wrists: dict[Side, Motion] = {side: at(motion) for side, motion in played.wrists.items()}
    return replace(played, wrists=wrists, object_motion=at(played.object_motion))


def moved(pose: RigidTransform | None, away_m: np.ndarray) -> RigidTransform | None:
    return pose and RigidTransform(pose.rotation, pose.translation + away_m)


def in_sequence(controls: Sequence[Control]) -> tuple[list[TrackedFrame], dict[int, list[tuple[Side, ObjectModel]]]]:
    """The frames of motions one after the other, and the objects to exchange before a frame."""
    frames, objects = [], {}
    for control in controls:
        objects[len(frames)] = [(side, control.model) for side in SIDES]
        first_s, away_m = len(frames) / TRACKER_HZ, len(objects) % 2 * AWAY_M
        for frame in tracked_frames(control):
            wrists = {side: moved(pose, away_m) for side, pose in frame.wrists.items()}
            bodies = {side: moved(pose, away_m) for side, pose in frame.objects.items()}
            frames.append(replace(frame, time_s=first_s + frame.time_s, wrists=wrists, objects=bodies))
    return frames, objects


class Fault(NamedTuple):
    """A fault in some frames of a tracker."""

    kind: str  # of KINDS
    side: Side  # the hand, if the kind concerns one
    start: int  # first frame
    stop: int  # first frame without the fault


def random_faults(seed: int, length_s: float) -> list[Fault]:
    """Faults of 1 frame to 4 s, at least 1.5 s apart."""
    rng, faults, now_s = np.random.default_rng(seed), [], 1.0
    while now_s < length_s - 6.0:
        start, kind = round(now_s * TRACKER_HZ), str(rng.choice(KINDS))
        n_frames = 4 if kind == "late" else round(TRACKER_HZ * rng.choice([1 / TRACKER_HZ, 0.1, 0.4, 0.7, 1.5, 4.0]))
        faults.append(Fault(kind, SIDES[rng.integers(2)], start, start + n_frames))
        now_s += n_frames / TRACKER_HZ + float(rng.uniform(1.5, 2.5))
    return faults


def with_fault(frames: list[TrackedFrame | None], fault: Fault) -> None:
    """Put a fault into its frames, in place; None: no frame arrives."""
    first, stop, side = fault.start, fault.stop, fault.side
    if fault.kind == "late":
        frames[first], frames[stop - 1] = frames[stop - 1], frames[first]
    for number in range(first, stop):
        if (one := frames[number]) is None or not (wrist := one.wrists[side]):
            continue
        wrists = {
            "one hand": None,
            "jump": moved(wrist, AWAY_M),
            "returns elsewhere": moved(wrist, AWAY_M) if number >= (first + stop) // 2 else None,
            "NaN pose": NAN,
            "sheared pose": SHEARED,
        }
        if fault.kind in wrists:
            frames[number] = replace(one, wrists={**one.wrists, side: wrists[fault.kind]})
        elif fault.kind == "no object":
            frames[number] = replace(one, objects={})
        elif fault.kind == "no frames":
            frames[number] = None
        elif fault.kind == "NaN time":
            frames[number] = replace(one, time_s=float("nan"))
        elif fault.kind == "repeated":
            frames[number] = replace(one, time_s=(first - 1) / TRACKER_HZ)


class Played(NamedTuple):
    """The poses of a stream."""

    points_m: dict[Side, np.ndarray]  # (pose, point, 3) joints and tips, wrist frame
    seconds: np.ndarray  # (frame,) processor time of each push


Objects = Mapping[int, list[tuple[Side, ObjectModel]]]  # to exchange before a frame


def play(
    predictor: Predictor, hands: Mapping[Side, TrackedHand], frames: Iterable[TrackedFrame | None], objects: Objects
) -> Played:
    """Push frames through a stream; ``objects[0]``: those of the first frame."""
    start: dict[Side, np.ndarray] = {side: hand.rest_rotmats for side, hand in hands.items()}
    stream, points, seconds = Stream(predictor, hands, dict(objects[0]), start), [], []

    def add(poses: list[dict[Side, np.ndarray]]) -> None:
        for pose in poses:
            states = [hand.state(pose[side][None]).point_m[0] for side, hand in hands.items()]
            points.append(np.stack(states).astype(np.float32))

    for number, frame in enumerate(frames):
        start_s = time.process_time()
        for side, model in objects.get(number, []) if number else []:
            if side in hands:
                stream.exchange(side, model)
        poses = stream.push(frame) if frame else []
        seconds.append(time.process_time() - start_s)
        add(poses)
    add(stream.finish())
    by_side: dict[Side, np.ndarray] = dict(zip(hands, np.swapaxes(points, 0, 1), strict=True))
    return Played(by_side, np.array(seconds))


@dataclass(frozen=True, eq=False)
class Soak:
    """What a stream with faults did, compared with one without."""

    faults: list[Fault]
    recovery_s: np.ndarray  # (fault,) from its end until the poses are those without faults
    step_m: np.ndarray  # (fault,) largest movement of a joint between two poses, around the fault
    clean_step_m: float  # likewise without faults, in the whole motion after the first second
    missing: int  # poses that are not there or not finite
    latency_s: np.ndarray  # (frame,) from a frame's arrival to its poses
    jitter_s: np.ndarray  # (frame - 1,) change of the latency

    def failures(self) -> list[str]:
        """What a stream must not do."""
        return [
            message
            for message, failed in (
                (f"{self.missing} poses are missing or not finite", self.missing > 0),
                (
                    f"a joint moves {1e3 * self.step_m.max():.1f} mm in a step",
                    self.step_m.max() > TOLERANCE * self.clean_step_m,
                ),
                (f"a fault is felt {self.recovery_s.max():.2f} s after its end", self.recovery_s.max() > LIMIT_S),
            )
            if failed
        ]


def soak(predictor: Predictor, hands: Mapping[Side, TrackedHand], controls: Sequence[Control], seed: int = 0) -> Soak:
    """Stream motions at 60 Hz, with and without faults."""
    frames, objects = in_sequence(controls)
    faults, firsts = random_faults(seed, len(frames) / TRACKER_HZ), sorted(objects)
    clean = play(predictor, hands, frames, objects)
    faulty_frames: list[TrackedFrame | None] = [*frames]
    faulty_objects = {number: [*exchanged] for number, exchanged in objects.items()}
    for fault in faults:
        with_fault(faulty_frames, fault)
        if fault.kind == "other object":
            model = controls[int(np.searchsorted(firsts, fault.stop, side="right")) - 1].model
            for number, exchanged in ((fault.start, box((0.02, 0.02, 0.3))), (fault.stop, model)):
                faulty_objects.setdefault(number, []).append((fault.side, exchanged))
    return compare(clean, play(predictor, hands, faulty_frames, faulty_objects), faults, 1 / predictor.settings.step_s)


def compare(clean: Played, faulty: Played, faults: list[Fault], step_hz: float) -> Soak:
    """Recovery, movement and latency of a stream with faults."""
    lengths = [len(points) for played in (clean, faulty) for points in played.points_m.values()]
    error_m, step_m, clean_step_m = np.zeros(min(lengths)), np.zeros(min(lengths)), 0.0
    missing = max(lengths) - min(lengths)
    for side in clean.points_m:
        expected, got = (played.points_m[side][: min(lengths)] for played in (clean, faulty))
        missing += int((~np.isfinite(got)).any(axis=(1, 2)).sum())
        error_m = np.fmax(error_m, np.linalg.norm(got - expected, axis=-1).mean(axis=1))
        step_m[1:] = np.fmax(step_m[1:], np.linalg.norm(np.diff(got, axis=0), axis=-1).max(axis=1))
        clean_step_m = max(
            clean_step_m, float(np.linalg.norm(np.diff(expected[round(step_hz) :], axis=0), axis=-1).max())
        )
    recovery_s, steps_m = [], []
    starts = [round((fault.start / TRACKER_HZ - LOOK_AHEAD_S) * step_hz) for fault in faults] + [min(lengths)]
    for fault, first, stop in zip(faults, starts, starts[1:], strict=False):
        end_s, felt = fault.stop / TRACKER_HZ, first + np.flatnonzero(error_m[first:stop] > SAME_M)
        recovery_s.append(max((felt[-1] + 1) / step_hz - end_s, 0.0) if len(felt) else 0.0)
        steps_m.append(step_m[first:stop].max())
    latency_s = _latency_s(faulty.seconds)
    return Soak(
        faults, np.array(recovery_s), np.array(steps_m), clean_step_m, missing, latency_s, np.abs(np.diff(latency_s))
    )


def _latency_s(seconds: np.ndarray) -> np.ndarray:
    """(frame,) from the arrival of a frame at the tracker's rate to the end of its push."""
    arrival_s, end_s, latency_s = np.arange(len(seconds)) / TRACKER_HZ, 0.0, []
    for arrived_s, duration_s in zip(arrival_s, seconds, strict=True):
        end_s = max(arrived_s, end_s) + duration_s
        latency_s.append(end_s - arrived_s)
    return np.array(latency_s)


def main() -> None:
    project, dataset = (
        Path(os.environ.get("HOIDATA_BENCH_PROJECT", ".")),
        os.environ.get("HOIDATA_BENCH_DATASET", "grab"),
    )
    minutes, pair = float(os.environ.get("HOIDATA_BENCH_MINUTES", "30")), load_embedded_hands()
    torch.set_num_threads(1)
    checkpoint = load_checkpoint(project / "checkpoints/embedded" / dataset / "manipnet", MANIPNET, torch.device("cpu"))
    assert isinstance(checkpoint.network, ManipNet)
    clips = load_annotated(project / "data/embedded" / dataset, pair)
    count = max(round(60 * minutes / CLIP_S), 1)
    acting = [clip_id for clip_id in clips.store.ids if clips.hand_types.at[clip_id, "hand_type"] in ("right", "both")]
    ids = np.resize(np.random.default_rng(0).permutation(acting), count)
    controls = [forward_and_back(control_from_clip(clips.clip(clip_id)), CLIP_S) for clip_id in ids]
    result = soak(Predictor(checkpoint.network), mano_hands(pair, np.zeros((2, 10), np.float32), None), controls)
    rows = []
    for kind in KINDS:
        chosen = np.array([fault.kind == kind for fault in result.faults])
        if chosen.any():
            recovery_s, step_m = result.recovery_s[chosen], result.step_m[chosen]
            worst = np.median(recovery_s), recovery_s.max(), 1e3 * step_m.max()
            rows.append([kind, f"{chosen.sum()}", *(f"{value:.2f}" for value in worst)])
    title = f"{minutes:g} minutes, {len(result.latency_s):,} frames, {len(result.faults)} faults"
    columns = ["fault", "count", "median recovery, s", "worst recovery, s", "largest step of a joint, mm"]
    show(f"{title}; largest step without faults {1e3 * result.clean_step_m:.2f} mm", columns, rows)
    percentiles = (50, 95, 99, 99.9, 100)
    rows = [
        [name, *(f"{1e3 * value:.1f}" for value in np.percentile(values, percentiles))]
        for name, values in (("latency", result.latency_s), ("jitter", result.jitter_s))
    ]
    show("From a frame's arrival to its poses, ms", ["", *(f"{value:g} %" for value in percentiles)], rows)
    if failures := result.failures():
        sys.exit("; ".join(failures))
