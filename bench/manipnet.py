"""Fingers for the wrists and objects of the real ManipNet recordings: the paper's table, with the controls it lacks.

``python -m bench manipnet`` with HOIDATA_MANIPNET: the data folder. HOIDATA_BENCH_SEEDS: how many trainings of each
row of objects seen (3 if not given); HOIDATA_BENCH_MINUTES: no row is begun that would end later (120);
HOIDATA_BENCH_ROWS: some rows alone, by name with commas; HOIDATA_BENCH_SIZE: small or full. What was computed is kept
in .hoidata/manipnet (never committed: the data is CC BY-NC) and taken up again while the code it came from is the same,
so a run may be stopped at any time and two may share the rows.

Objects seen: of five successive tenths of a recording three train, the last tests, 0.5 s around what is not trained on
left out. Objects unseen: every recording left out in turn; of five successive tenths the first and the last are rolled
out.
"""

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from bench.harness import show
from bench.manipnet_recordings import NAMES, RATE_HZ, TEST, TRAIN, HandRecording, read_hands
from hoidata.clips.clip import SIDES, Side
from hoidata.files import write_whole
from hoidata.hands.tracked_hand import HandState
from hoidata.physics.capsules import CapsuleContacts
from hoidata.physics.realism import LARGEST_PENETRATION_M, VARIANTS, contacts_in, score, smoothness_m_s2
from models.common.training import TrainingConfig
from models.manipnet.examples import Examples, fit_examples, hand_examples, other_poses, prepared, sized
from models.manipnet.features import FeatureSettings, output_distances, pose_features
from models.manipnet.lookups import Lookup, as_right, control_inputs, joint_errors_m, mean_rotmats
from models.manipnet.network import ManipNet, NetworkConfig
from models.manipnet.rollout import Follower, Predictor, Rule, Task, roll_out, situation

KEPT = Path(".hoidata/manipnet")
ROOT = Path(__file__).parents[1]
# What training examples and networks come from, and what else figures come from.
LEARNT_FROM = ("models/manipnet/control.py", "models/manipnet/examples.py", "models/manipnet/features.py",
               "models/manipnet/features.py", "models/manipnet/network.py", "models/common/training.py",
               "hoidata/hands/tracked_hand.py", "hoidata/sensors", "bench/manipnet_recordings.py")  # fmt: skip
MEASURED_BY = (*LEARNT_FROM, "models/manipnet/rollout.py", "models/manipnet/rollout.py", "models/manipnet/lookups.py",
               "models/manipnet/inverse_kinematics.py", "hoidata/physics", "bench/manipnet.py")  # fmt: skip
SETTINGS = FeatureSettings(step_s=1 / RATE_HZ)
SIZES = {
    "small": (NetworkConfig(encoder=128), TrainingConfig(3500, 128, 1e-3, 0.0, "cosine", 50)),
    "full": (NetworkConfig(), TrainingConfig(20000, 32, 1e-4, 0.0)),
}
VARIANTS_OF_OURS: dict[str, dict[str, Any]] = {
    "ours": {},
    "from recorded poses alone": {"astray": False},
    "no sensors": {"without": ("sensors",)},
    "no ambient": {"without": ("ambient",)},
    "no distance": {"without": ("distance",)},
    "no proximity": {"without": ("proximity",)},
    "no signed distance": {"without": ("signed-distance",)},
    "no future sensing": {"without": ("future",)},
    "short trajectory": {"without": ("long-future",)},
    "ResNet": {"kind": "resnet"},
    "MLP": {"kind": "mlp"},
}
UNSEEN = ("ours", "no sensors", "no ambient", "no distance")
NEAREST = 10
AWAY_M, OUT_OF_REACH_M = 0.02, 10.0
LEAD_FRAMES = RATE_HZ // 2  # a rollout begins so long before the first frame that counts
Fingers = dict[Side, np.ndarray]


class Piece(NamedTuple):
    """An interval that is tested, usable throughout. frames: what is rolled out; scored: (frame,) bool of those."""

    recording: HandRecording
    frames: slice
    scored: np.ndarray


@dataclass(frozen=True)
class Trial:
    """What trains and what tests: (recording, (frame,) bool) each. name: for what is kept. rows: to be trained."""

    name: str
    train: tuple[tuple[HandRecording, np.ndarray], ...]
    pieces: tuple[Piece, ...]
    rows: tuple[str, ...] = ()


def prepare_recordings() -> list[HandRecording]:
    """The real recordings, and torch made repeatable; none, and a line that says why, where they are not here."""
    root = os.environ.get("HOIDATA_MANIPNET")
    if not root:
        print("HOIDATA_MANIPNET is not set: this needs the real recordings")
        return []
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    torch.use_deterministic_algorithms(True)
    return [read_hands(Path(root), name) for name in NAMES]


def main() -> None:
    recordings = prepare_recordings()
    if not recordings:
        return
    size, seeds = os.environ.get("HOIDATA_BENCH_SIZE", "small"), int(os.environ.get("HOIDATA_BENCH_SEEDS", "3"))
    wanted = os.environ.get("HOIDATA_BENCH_ROWS", ",".join(VARIANTS_OF_OURS)).split(",")
    trials = [seen_trial(recordings), *unseen_trials(recordings)]
    tables: dict[str, Rows] = {}
    jobs = [Job(trial, name, 0) for trial in trials for name in trial.rows if name in wanted]
    jobs += [Job(trials[0], name, seed) for seed in range(1, seeds) for name in trials[0].rows if name in wanted]
    left_out = fill(tables, jobs, size, 60 * float(os.environ.get("HOIDATA_BENCH_MINUTES", "120")))
    for name, rows in tables.items():
        show_sums(f"Objects {name}, {size} network", rows)
    if all(trial.name in tables for trial in trials):
        show_sums(f"Objects unseen, all, {size} network", pooled([tables[trial.name] for trial in trials[1:]]))
    if left_out:
        print(f"no time was left for {len(left_out)} trainings: " + ", ".join(job.key(size) for job in left_out))


class Job(NamedTuple):
    """A row to train."""

    trial: "Trial"
    name: str
    seed: int

    def key(self, size: str) -> str:
        return f"{self.trial.name} {self.name} {size} {self.seed}"


Rows = dict[str, list[dict[str, float]]]


def fill(tables: dict[str, Rows], jobs: Sequence[Job], size: str, budget_s: float) -> list[Job]:
    """Train row after row into the tables, one dictionary of sums per seed; those that there was no time for."""
    began, longest, left_out = time.monotonic(), 0.0, []
    for job in jobs:
        start = time.monotonic()
        if start - began + longest > budget_s:
            left_out.append(job)
            continue
        if job.trial.name not in tables:
            tables[job.trial.name] = control_rows(job.trial)
        for rule, sums in kept(job.key(size), lambda job=job: trained_row(job, size)).items():
            words = {"off": "", "ours": ", post-processed", "paper": ", the paper's post-processing"}[rule]
            tables[job.trial.name].setdefault(job.name + words, []).append(sums)
        longest = max(longest, time.monotonic() - start)
    return left_out


def pooled(tables: Sequence[Rows]) -> Rows:
    """Sums over trials of the rows that all of them have; shares and means are made of the sums."""
    names = [name for name in tables[0] if all(name in rows for rows in tables)]
    return {name: [added([rows[name][0] for rows in tables])] for name in names}


def added(sums: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The sums by name."""
    return {name: sum(one[name] for one in sums) for name in sums[0]}


def seen_trial(recordings: Sequence[HandRecording], kinds: tuple[int, ...] = TEST) -> Trial:
    """Training tenths train; the test tenths, or others, are rolled out."""
    train = tuple((one, one.trains & one.usable) for one in recordings)
    return Trial(
        "seen", train, tuple(piece for one in recordings for piece in pieces(one, kinds)), tuple(VARIANTS_OF_OURS)
    )


def unseen_trials(recordings: Sequence[HandRecording]) -> list[Trial]:
    """Each recording left out in turn; of five successive tenths of it the first and the last are rolled out."""
    trials = []
    for out in recordings:
        train = tuple((one, one.usable) for one in recordings if one is not out)
        trials.append(Trial(f"unseen {out.name}", train, tuple(pieces(out, (*TRAIN[:1], *TEST))), UNSEEN))
    return trials


def pieces(recording: HandRecording, kinds: tuple[int, ...]) -> list[Piece]:
    """The intervals of these tenths in which the object is lifted, with a lead that is not scored."""
    tenths, found = recording.tenths(kinds), []
    for start, stop in recording.intervals(tenths):
        first = start
        while first > 0 and first > start - LEAD_FRAMES and recording.usable[first - 1]:
            first -= 1
        scored = (recording.lifted & tenths)[first:stop]
        scored[:LEAD_FRAMES] = False
        if scored.sum() >= 3:
            found.append(Piece(recording, slice(first, stop), scored))
    return found


def control_rows(trial: Trial) -> Rows:
    return {name: [sums] for name, sums in kept(f"{trial.name} controls", lambda: controls(trial)).items()}


def trained_row(job: Job, size: str) -> dict[str, dict[str, float]]:
    """Train one network and roll it out, without and with post-processing; of ours also with the paper's."""
    model = trained_network(job, size)
    rules: tuple[Rule, ...] = ("off", "ours", "paper")[: 3 if job.name == "ours" else 2]
    return {rule: measured(job.trial, rolled(job.trial, model, rule)) for rule in rules}


def trained_network(job: Job, size: str) -> ManipNet:
    """The network of a row, kept with the figures."""
    changes = dict(VARIANTS_OF_OURS[job.name])
    network, training = SIZES[size]
    astray = changes.pop("astray", True)
    config = replace(network, features=SETTINGS, **changes)
    path = kept_path(f"{job.key(size)} network", ".pt", LEARNT_FROM)
    hand = job.trial.train[0][0].hands["right"]
    if path.is_file():
        model = ManipNet(sized(config, hand))
        model.load_state_dict(torch.load(path, weights_only=True))
        return model.eval()
    examples = examples_of(job.trial, astray)
    torch.manual_seed(job.seed)
    model = prepared(config, hand, examples)
    fit_examples(model, examples, training, job.seed)
    whole = path.with_name(f"{path.name}.{os.getpid()}")
    torch.save(model.state_dict(), whole)
    whole.replace(path)
    return model


_EXAMPLES: dict[tuple[str, Side, bool], Examples] = {}


def examples_of(trial: Trial, astray: bool) -> list[Examples]:
    """Training steps of both hands; those of a recording are computed once and cut. astray: also from other poses."""
    found = []
    for recording, frames in trial.train:
        for side in SIDES:
            for kind in (False, True)[: 1 + astray]:
                every = _recorded_examples(recording, side, kind)
                chosen = frames[every.frame] & frames[every.frame + 1]
                found.append(Examples(*(array[chosen] for array in every)))
    return found


def _recorded_examples(recording: HandRecording, side: Side, astray: bool) -> Examples:
    key = (recording.name, side, astray)
    if key not in _EXAMPLES:
        path = kept_path(f"examples {recording.name} {side}{' astray' * astray}", ".npz", LEARNT_FROM)
        if not path.is_file():
            fingers, hand = recording.fingers[side], recording.hands[side]
            # Of frames that may train alone: no test pose is met, not even as a way to go wrong.
            pool = np.concatenate([fingers[recording.trains & recording.usable], hand.rest_rotmats[None]])
            made = hand_examples(
                recording.control,
                side,
                recording.hands[side],
                recording.fingers[side],
                recording.time_s,
                recording.usable,
                recording.surface,
                SETTINGS,
                other_poses(fingers, pool, NAMES.index(recording.name)) if astray else None,
            )
            whole = path.with_name(f"{os.getpid()}-{path.name}")
            np.savez(whole, **made._asdict())
            whole.replace(path)
        with np.load(path) as stored:
            _EXAMPLES[key] = Examples(**stored)
    return _EXAMPLES[key]


def rolled(trial: Trial, model: ManipNet, rule: Rule) -> list[Fingers]:
    """Both hands of every piece from the neutral pose on."""
    tasks = [
        Task(one.hands[side], side, one.control, one.time_s[frames], one.hands[side].rest_rotmats)
        for one, frames, _ in trial.pieces
        for side in SIDES
    ]
    made = roll_out(Predictor(model, rule), tasks)
    return [dict(zip(SIDES, made[2 * number : 2 * number + 2], strict=True)) for number in range(len(trial.pieces))]


def mean_training_pose(trial: Trial) -> np.ndarray:
    """(joint - 1, 3, 3) finger rotations of a right hand, the mean of both hands' training frames."""
    return mean_rotmats(np.concatenate(_training_fingers(trial)))


def _training_fingers(trial: Trial) -> list[np.ndarray]:
    """By recording and hand (frame, joint - 1, 3, 3), as a right hand's."""
    return [as_right(one.hands[side], one.fingers[side][frames]) for one, frames in trial.train for side in SIDES]


def controls(trial: Trial) -> dict[str, dict[str, float]]:
    """Rows without a network."""
    fingers = _training_fingers(trial)
    hand = trial.train[0][0].hands["right"]
    inputs = [_control_inputs(one, side, frames) for one, frames in trial.train for side in SIDES]
    lookup, mean = Lookup.of(hand, SETTINGS, inputs, fingers), mean_training_pose(trial)
    shares = np.concatenate([_shares(one, side, frames) for one, frames in trial.train for side in SIDES])
    predictor = Predictor(prepared(NetworkConfig(encoder=8, features=SETTINGS), hand, examples_of(trial, False)))

    def both(pose: Callable[[Piece, Side], np.ndarray]) -> dict[str, float]:
        return measured(trial, [{side: pose(piece, side) for side in SIDES} for piece in trial.pieces])

    def held(pose: np.ndarray) -> Callable[[Piece, Side], np.ndarray]:
        return lambda piece, side: np.tile(as_right(piece.recording.hands[side], pose), (len(piece.scored), 1, 1, 1))

    def looked_up(count: int) -> Callable[[Piece, Side], np.ndarray]:
        def pose(piece: Piece, side: Side) -> np.ndarray:
            found = lookup.poses(_control_inputs(piece.recording, side, piece.frames), count)
            return as_right(piece.recording.hands[side], found)

        return pose

    def post_processed(count: int) -> Callable[[Piece, Side], np.ndarray]:
        """A lookup has distances to foretell as well: those of its frames."""

        def pose(piece: Piece, side: Side) -> np.ndarray:
            one, own = piece.recording, piece.recording.hands[side]
            found = lookup.nearest(_control_inputs(one, side, piece.frames), count)
            features = pose_features(own, own.state(looked_up(count)(piece, side)))
            return _followed(predictor, piece, side, np.concatenate([features, shares[found].mean(axis=1)], axis=1))

        return pose

    raw = [{side: piece.recording.fingers[side][piece.frames] for side in SIDES} for piece in trial.pieces]
    return {
        "raw data": measured(trial, raw),
        "raw hands 2 cm away": measured(trial, raw, AWAY_M),
        "no hands: the floor": measured(trial, raw, OUT_OF_REACH_M),
        "neutral pose": both(held(hand.rest_rotmats)),
        "mean training pose": both(held(mean)),
        "frozen at the first scored frame": both(_frozen),
        "nearest training frame": both(looked_up(1)),
        f"mean of {NEAREST} nearest": both(looked_up(NEAREST)),
        "nearest training frame, post-processed": both(post_processed(1)),
        f"mean of {NEAREST} nearest, post-processed": both(post_processed(NEAREST)),
    }


def _shares(recording: HandRecording, side: Side, frames: np.ndarray) -> np.ndarray:
    """(frame, 22) recorded distances in the form of the network's output."""
    hand, time_s = recording.hands[side], recording.time_s[frames]
    placed = recording.control.thing.at(time_s).inverse() @ recording.control.wrists[side].at(time_s)
    points = hand.state(recording.fingers[side][frames]).point_m
    return output_distances(hand, recording.surface.nearest(placed @ points, None).distance_m, SETTINGS)


def _followed(predictor: Predictor, piece: Piece, side: Side, outputs: np.ndarray) -> np.ndarray:
    """(frame, joint - 1, 3, 3) what post-processing makes of outputs (frame, 214) that no network said."""
    recording, frames, _ = piece
    hand = recording.hands[side]
    follower, made = Follower(predictor, hand, recording.surface, hand.rest_rotmats), [hand.rest_rotmats]
    for time_s, output in zip(recording.time_s[frames][1:], outputs[1:], strict=True):
        follower.advance(output, situation(recording.control, side, hand, time_s, SETTINGS))
        made.append(follower.answer[0])
    return np.stack(made)


def _frozen(piece: Piece, side: Side) -> np.ndarray:
    own = piece.recording.fingers[side][piece.frames]
    return np.repeat(own[np.flatnonzero(piece.scored)[:1]], len(own), axis=0)


def _control_inputs(recording: HandRecording, side: Side, frames: np.ndarray | slice) -> np.ndarray:
    hand = recording.hands[side]
    return control_inputs(recording.control, side, hand, recording.time_s[frames], recording.surface, SETTINGS)


def measured(trial: Trial, fingers: Sequence[Fingers], away_m: float = 0.0) -> dict[str, float]:
    """Sums and counts of scored frames over all pieces."""
    return added([_piece_sums(piece, made, away_m) for piece, made in zip(trial.pieces, fingers, strict=True)])


def figures_of(sums: Mapping[str, float]) -> dict[str, float]:
    """Shares and means of sums."""
    pairs = 2 * max(sums["touching"] + sums["touching_raw"], 1)
    return {
        "joint_mm": 1000 * sums["joint"] / sums["hand_frames"],
        "tip_mm": 1000 * sums["tip"] / sums["hand_frames"],
        "si": 100 * sums["SI"] / max(sums["sound"], 1),
        "si_of_all": 100 * sums["SI"] / sums["frames"],
        "released": 100 * sums["as released"] / max(sums["sound"], 1),
        "deep": 100 * (1 - sums["sound"] / sums["frames"]),
        "penetration_cm": 100 * sums["depth"] / max(sums["overlaps"], 1),
        "smooth_cm_s2": 100 * sums["acceleration"] / max(sums["accelerations"], 1),
        "capsule_f1": 200 * 2 * sums["touching_both"] / pairs,
        "frames": sums["frames"],
    }


def _piece_sums(piece: Piece, made: Fingers, away_m: float) -> dict[str, float]:
    recording, frames, scored = piece
    raw_fingers = {side: recording.fingers[side][frames] for side in SIDES}
    states = recording.states(made, frames)
    if away_m:
        states = {side: _moved_away(recording, frames, state, away_m) for side, state in states.items()}
    scene = recording.scene(states, frames)
    errors = [joint_errors_m(recording.hands[side], made[side][scored], raw_fingers[side][scored]) for side in SIDES]
    results = {name: score(scene, variant, scored) for name, variant in VARIANTS.items()}
    depth = results["SI"].penetration_m[scored]
    contacts = contacts_in(scene, scored)
    touching, touching_raw = _touching(contacts), _touching_raw(piece)
    accelerations = np.array([_acceleration(recording, state, scored) for state in states.values()])
    inside = contacts.depth_m[contacts.depth_m > 0]
    return {
        "joint": float(sum(error.mean(axis=1).sum() for error in errors)),
        "tip": float(sum(error[:, -5:].mean(axis=1).sum() for error in errors)),
        "hand_frames": float(sum(len(error) for error in errors)),
        "frames": float(scored.sum()),
        "sound": float((depth < LARGEST_PENETRATION_M).sum()),
        "depth": float(inside.sum()),
        "overlaps": float(len(inside)),
        "touching": float(len(touching)),
        "touching_raw": float(len(touching_raw)),
        "touching_both": float(len(touching & touching_raw)),
        "acceleration": float(np.prod(accelerations, axis=1).sum()),
        "accelerations": float(accelerations[:, 1].sum()),
    } | {name: float(result.passed.sum()) for name, result in results.items()}


def _acceleration(recording: HandRecording, state: HandState, scored: np.ndarray) -> tuple[float, int]:
    """Mean acceleration where three frames in a row are scored, and in how many places."""
    joints_m, wrist_rotmats = recording.motion(state)
    joints_m = np.where(scored[:, None, None], joints_m, np.nan)
    places = int((scored[2:] & scored[1:-1] & scored[:-2]).sum())
    return (smoothness_m_s2(joints_m, wrist_rotmats, RATE_HZ), places) if places else (0.0, 0)


_RAW_TOUCHING: dict[tuple[str, int, int], set[tuple[int, int]]] = {}


def _touching_raw(piece: Piece) -> set[tuple[int, int]]:
    """What touches in the recording; every row is held against it."""
    recording, frames, scored = piece
    key = (recording.name, frames.start, frames.stop)
    if key not in _RAW_TOUCHING:
        raw = {side: recording.fingers[side][frames] for side in SIDES}
        _RAW_TOUCHING[key] = _touching(contacts_in(recording.scene(recording.states(raw, frames), frames), scored))
    return _RAW_TOUCHING[key]


def _touching(contacts: CapsuleContacts) -> set[tuple[int, int]]:
    """Frame and capsule of all overlaps."""
    return set(zip(contacts.frame.tolist(), contacts.capsule.tolist(), strict=True))


def _moved_away(recording: HandRecording, frames: slice, state: HandState, way_m: float) -> HandState:
    """The hand moved straight away from the middle of the object."""
    thing = recording.control.thing
    centre = thing.rotmats[frames] @ recording.control.model.vertices_m.mean(axis=0) + thing.position_m[frames]
    away = state.joint_m.mean(axis=1) - centre
    shift = way_m * (away / np.linalg.norm(away, axis=1, keepdims=True))[:, None]
    moved = {name: getattr(state, name) + shift for name in state._fields if name.endswith("_m")}
    return state._replace(**moved)


def kept(key: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What was computed under a key before with the same settings and code, else what is computed now."""
    path = kept_path(key, ".json")
    if not path.is_file():
        began, processor = time.perf_counter(), time.process_time()
        write_whole(path, json.dumps(make(), indent=1))
        took = f"{time.perf_counter() - began:.0f} s, {time.process_time() - processor:.0f} s of one core"
        print(f"{key}: {took}", flush=True)
    return json.loads(path.read_text())


def kept_path(key: str, ending: str, code: tuple[str, ...] = MEASURED_BY) -> Path:
    """code: files and folders below the project's that what is kept depends on."""
    digest = sha256(f"{key} {SIZES} {SETTINGS} {_code_digest(code)}".encode()).hexdigest()[:12]
    KEPT.mkdir(parents=True, exist_ok=True)
    return KEPT / f"{key.replace(' ', '-').replace(',', '')}-{digest}{ending}"


@cache
def _code_digest(places: tuple[str, ...]) -> str:
    paths = [path for place in places for path in (sorted((ROOT / place).rglob("*.py")) or [ROOT / place])]
    return sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


COLUMNS = {
    "joint_mm": "joints mm",
    "tip_mm": "tips mm",
    "si": "SI %",
    "si_of_all": "deep = failed",
    "released": "released %",
    "deep": "deep %",
    "penetration_cm": "depth cm",
    "smooth_cm_s2": "cm/s2",
    "capsule_f1": "capsule F1",
}


def show_sums(title: str, sums: Rows) -> None:
    rows = {name: [figures_of(one) for one in seeds] for name, seeds in sums.items()}
    frames = int(next(iter(rows.values()))[0]["frames"])
    lines = [[name, *(_cell([one[key] for one in figures]) for key in COLUMNS)] for name, figures in rows.items()]
    show(f"{title}, {frames} scored frames", ["row", *COLUMNS.values()], lines)


def _cell(values: Sequence[float]) -> str:
    spread = f" ±{np.std(values):.2f}" if len(values) > 1 else ""
    return f"{np.mean(values):.2f}{spread}"
