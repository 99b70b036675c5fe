"""Do the fingers of ManipNet's rollouts stay on course, and how well do they fill gaps?

``python -m bench manipnet-course`` with HOIDATA_MANIPNET, after ``python -m bench manipnet``, whose networks it takes
(or trains, where there is none). Rollouts of half a minute from three starts: by the network that saw all objects,
three tenths in five of each recording (whether a rollout strays, whatever it has learnt), and each of a recording that
its network never saw, with their way to each other as a picture in .hoidata/manipnet. Gaps of 0.5 to 4 s in what did
not train, beside ways that need no network: the first held-out round of each recording (two tenths, one after the
other) chooses a way for each length, the second is reported (HOIDATA_BENCH_GAPS: how many of each length). The
release's trajectories, which have no fingers, with six objects.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.harness import show
from bench.manipnet import (
    KEPT,
    RATE_HZ,
    SETTINGS,
    Job,
    Trial,
    mean_training_pose,
    prepare_recordings,
    seen_trial,
    trained_network,
    unseen_trials,
)
from bench.manipnet_recordings import ROUND, TENTHS, TEST, VALIDATION, HandRecording
from hoidata.clips.clip import SIDES, Side
from hoidata.datasets.manipnet.adapter import METRES_PER_UNIT
from hoidata.datasets.manipnet.bvh import unpack_text
from hoidata.files import write_whole
from hoidata.geometry.intervals import runs
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.mesh import parse_obj
from hoidata.objects.model import ObjectModel
from hoidata.physics.capsules import Capsules, ObjectPoses, joined
from hoidata.physics.realism import contacts_in
from hoidata.physics.scene import Scene
from models.manipnet.animate import given_control, interpolated, led
from models.manipnet.control import Control
from models.manipnet.lookups import as_right, joint_errors_m
from models.manipnet.rollout import Predictor, Task, roll_out
from models.manipnet.trajectory_files import parse_manipnet

COURSE_S = 30
GAPS_S = (0.5, 1.0, 2.0, 4.0)
MOST_GAPS = int(os.environ.get("HOIDATA_BENCH_GAPS", "40"))
SEAMS_S = (0.25, 0.5, 1.0)
STARTS = ("neutral pose", "true pose", "fist")
AGAIN = "true pose of the last quarter"
FIST_RAD = 1.2
DEMOS = ("demo1", "demo2")
DEMO_OBJECTS = (
    "Primitive/cyl_med",
    "Primitive/cube_med",
    "Primitive/sphere",
    "Dining/cup1",
    "Dining/mug1",
    "Dining/teapot2",
)


def main() -> None:
    recordings = prepare_recordings()
    if not recordings:
        return
    size = os.environ.get("HOIDATA_BENCH_SIZE", "small")
    seen = seen_trial(recordings)
    predictor = Predictor(trained_network(Job(seen, "ours", 0), size))
    show_demos(recordings, predictor)
    show_gaps(recordings, predictor)
    show_courses("seen", [seen] * len(recordings), recordings, size)
    found = show_courses("unseen", unseen_trials(recordings), recordings, size)
    show_picture(found)


def fist(hand: TrackedHand) -> np.ndarray:
    """(joint - 1, 3, 3) the neutral pose with every hinge bent."""
    bend = np.minimum(FIST_RAD, hand.limit_rad[1:, 1])
    return hand.rest_rotmats @ rotvec_to_rotmat(hand.hinge_axis[1:] * bend[:, None])


class Course(NamedTuple):
    """errors_mm: (start, frame) of both hands, from the recorded ones; apart_mm: (frame,) the starts from each other.

    again_mm: (frame of the last quarter,) of a rollout that begins there, from the recorded pose. mean_mm: (frame,) of
    the mean training pose: how hard these frames are. broken: frames in which a number is none, a bone longer, or a
    joint beyond its limits.
    """

    errors_mm: np.ndarray
    apart_mm: np.ndarray
    again_mm: np.ndarray
    mean_mm: np.ndarray
    broken: int


def course(trial: Trial, recording: HandRecording, size: str) -> Course:
    """Half a minute of a recording (or its longest usable interval), from each start."""
    predictor = Predictor(trained_network(Job(trial, "ours", 0), size))
    first, stop = max(runs(recording.usable), key=lambda run: run[1] - run[0])
    frames = slice(first, min(stop, first + COURSE_S * RATE_HZ))
    last = slice(frames.stop - (frames.stop - first) // 4, frames.stop)
    tasks = {}
    for side in SIDES:
        hand, fingers = recording.hands[side], recording.fingers[side]
        poses = (hand.rest_rotmats, fingers[first], fist(hand), fingers[last.start])
        for name, pose in zip((*STARTS, AGAIN), poses, strict=True):
            time_s = recording.time_s[last if name == AGAIN else frames]
            tasks[side, name] = Task(hand, side, recording.control, time_s, pose)
    made = dict(zip(tasks, roll_out(predictor, list(tasks.values())), strict=True))

    def error_mm(name: str, frames: slice) -> np.ndarray:
        return _apart_mm(recording, {side: (made[side, name], recording.fingers[side][frames]) for side in SIDES})

    starts: list[dict[Side, tuple[np.ndarray, np.ndarray]]] = [
        {side: (made[side, one], made[side, other]) for side in SIDES} for one, other in combinations(STARTS, 2)
    ]
    mean = mean_training_pose(trial)
    held: dict[Side, tuple[np.ndarray, np.ndarray]] = {
        side: (as_right(recording.hands[side], mean)[None], recording.fingers[side][frames]) for side in SIDES
    }
    return Course(
        np.stack([error_mm(name, frames) for name in STARTS]),
        np.mean([_apart_mm(recording, pair) for pair in starts], axis=0),
        error_mm(AGAIN, last),
        _apart_mm(recording, held),
        sum(_broken(predictor, recording.hands[side], own[1:]) for (side, _), own in made.items()),
    )


def _apart_mm(recording: HandRecording, poses: Mapping[Side, tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """(frame,) mean distance of joints of two motions, over both hands."""
    apart = [joint_errors_m(recording.hands[side], *pair).mean(axis=1) for side, pair in poses.items()]
    return 1000 * np.mean(apart, axis=0)


def _broken(predictor: Predictor, hand: TrackedHand, fingers: np.ndarray) -> int:
    """Frames (frame, joint - 1, 3, 3) that no hand can have."""
    joints = hand.state(fingers).joint_m
    bones = np.linalg.norm(joints[:, 1:] - joints[:, hand.parents[1:]], axis=-1)
    stretched = np.abs(bones - np.linalg.norm(hand.offset_m[1:], axis=-1)).max(axis=1) > 1e-6
    beyond = np.abs(predictor.limits(hand).within(fingers) - fingers).max(axis=(1, 2, 3)) > 1e-6
    return int((stretched | beyond | ~np.isfinite(fingers).all(axis=(1, 2, 3))).sum())


def show_courses(kind: str, trials: Sequence[Trial], recordings: Sequence[HandRecording], size: str) -> list[Course]:
    """A row per recording, and one of all their frames; kind: whether the networks saw the objects."""
    found = [course(trial, one, size) for trial, one in zip(trials, recordings, strict=True)]
    rows = [[recording.name, *_cells(one)] for recording, one in zip(recordings, found, strict=True)]
    quarters = [np.concatenate([_quarters(one.errors_mm[0])[end] for one in found]) for end in (0, 1)]
    first, last = (float(quarter.mean()) for quarter in quarters)
    rows.append(["all frames", "", f"{first:.2f}", f"{last:.2f}", f"{last / first:.2f}", *[""] * 9])
    columns = [
        f"objects {kind}",
        "s",
        "first quarter mm",
        "last quarter mm",
        "ratio",
        "last quarter, begun there from the truth",
    ]
    columns += ["mean pose first quarter", "last quarter", "ratio", "apart at 0 s mm", ".25 s", "1 s", "2 s"]
    title = f"Rollouts from neutral pose, true pose and fist, objects {kind}"
    show(title, [*columns, "broken frames"], rows)
    return found


def _quarters(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first and the last quarter of the frames."""
    quarter = len(values) // 4
    return values[:quarter], values[-quarter:]


def _cells(one: Course) -> list[str]:
    first, last = (quarter.mean() for quarter in _quarters(one.errors_mm[0]))
    means = [quarter.mean() for quarter in _quarters(one.mean_mm)]
    figures = [first, last, last / first, one.again_mm.mean(), *means, means[1] / means[0]]
    shares = [one.apart_mm[round(s * RATE_HZ)] for s in (0, 0.25, 1, 2)]
    length = f"{one.errors_mm.shape[1] / RATE_HZ:.1f}"
    return [length, *(f"{value:.2f}" for value in (*figures, *shares)), str(one.broken)]


def show_picture(found: Sequence[Course]) -> None:
    """How starts come to each other, and to the recorded hand, in the mean over recordings."""
    shortest = min(len(one.apart_mm) for one in found)
    curves = {"from each other": np.mean([one.apart_mm[:shortest] for one in found], axis=0)}
    errors = np.mean([one.errors_mm[:, :shortest] for one in found], axis=0)
    curves |= {f"from the recorded hand, {start}": own for start, own in zip(STARTS, errors, strict=True)}
    write_whole(KEPT / "course.svg", picture(curves))
    print(f"picture: {KEPT / 'course.svg'}")


def picture(curves: Mapping[str, np.ndarray], width: int = 720, height: int = 300) -> str:
    """SVG of curves (frame,) in mm over the first four seconds and after it, a tenth as wide."""
    top, colours = max(float(one.max()) for one in curves.values()), ("#000", "#2a6fb0", "#2f8f4e", "#c2562d")
    shown = 4 * RATE_HZ
    lines = []
    for (name, one), colour, row in zip(curves.items(), colours, range(len(curves)), strict=True):
        points = " ".join(
            f"{40 + (width - 60) * frame / shown:.1f},{height - 30 - (height - 50) * value / top:.1f}"
            for frame, value in enumerate(one[: shown + 1])
        )
        lines.append(f'<polyline fill="none" stroke="{colour}" stroke-width="1.5" points="{points}"/>')
        lines.append(f'<text x="{width - 330}" y="{20 + 16 * row}" fill="{colour}">{name}</text>')
    marks = "".join(
        f'<text x="{40 + (width - 60) * s / 4:.0f}" y="{height - 10}">{s} s</text>' for s in range(5)
    ) + "".join(
        f'<text x="4" y="{height - 26 - (height - 50) * mm / top:.0f}">{mm}</text>' for mm in range(0, int(top) + 1, 10)
    )
    size = f'width="{width}" height="{height}" font-family="sans-serif" font-size="12"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>\n{marks}\n' + "\n".join(lines) + "\n</svg>\n"


def show_demos(recordings: Sequence[HandRecording], predictor: Predictor) -> None:
    """Both released trajectories with six objects: in how many lifted frames two or more capsules touch."""
    root, hands = Path(os.environ["HOIDATA_MANIPNET"]), recordings[0].hands
    rows = [_recorded_row(recordings)]
    for demo in DEMOS:
        path = f"trajectories/{demo}.txt.gz"
        found = parse_manipnet(unpack_text((root / path).read_bytes(), path).encode(), path)
        for place in DEMO_OBJECTS:
            given = given_control(found, _mesh(root, place), hands)
            time_s = np.arange(0.0, found.time_s[-1], 1 / RATE_HZ)
            tasks = [Task(hands[side], side, given.control, time_s, hands[side].rest_rotmats) for side in given.active]
            made = dict(zip(given.active, roll_out(predictor, tasks), strict=True))
            scene = _scene(given.control, hands, made, time_s)
            rows.append([demo, place.split("/")[1], *_touched(scene, scene.lifted)])
    columns = ["trajectories", "object", "lifted frames", "two or more capsules touch, %", "none, %", "deepest mm"]
    show("The release's trajectories", columns, rows)


def _mesh(root: Path, place: str) -> ObjectModel:
    path = f"objects/{place}.obj.gz"
    mesh = parse_obj(unpack_text((root / path).read_bytes(), path), path)
    return ObjectModel(place, mesh.vertices * METRES_PER_UNIT, mesh.faces, np.zeros(len(mesh.vertices), np.uint8))


def _scene(
    control: Control, hands: Mapping[Side, TrackedHand], fingers: Mapping[Side, np.ndarray], time_s: np.ndarray
) -> Scene:
    """The object and the capsules of these hands; the table is where the object stands lowest."""
    capsules = []
    for side, own in fingers.items():
        state = hands[side].state(own).placed(control.wrists[side].at(time_s))
        capsules.append(Capsules(state.capsule_start_m, state.capsule_end_m, hands[side].capsules.radius_m))
    placed = control.thing.at(time_s)
    poses = ObjectPoses(placed.rotation, placed.translation)
    return Scene(control.model, poses, joined(capsules), RATE_HZ, np.array([0.0, -1.0, 0.0]))


def _recorded_row(recordings: Sequence[HandRecording]) -> list[str]:
    """The same of the five recordings with their own hands."""
    found = []
    for one in recordings:
        whole = slice(0, one.n_frames)
        found.append(_touching_counts(one.scene(one.states(one.fingers, whole), whole), one.lifted & one.usable))
    counts = np.concatenate([count for count, _ in found])
    return ["recorded", "its own", *_told(counts, max(deepest for _, deepest in found))]


def _touched(scene: Scene, frames: np.ndarray) -> list[str]:
    return _told(*_touching_counts(scene, frames))


def _touching_counts(scene: Scene, frames: np.ndarray) -> tuple[np.ndarray, float]:
    """(frame of these,) how many capsules overlap the object, and how deep the deepest is."""
    contacts = contacts_in(scene, frames)
    counts = np.bincount(contacts.frame, minlength=scene.n_frames)[frames]
    return counts, float(contacts.depth_m.max(initial=0))


def _told(counts: np.ndarray, deepest_m: float) -> list[str]:
    shares = (100 * (counts >= 2).mean(), 100 * (counts == 0).mean())
    return [f"{len(counts):,}", *(f"{share:.1f}" for share in shares), f"{1000 * deepest_m:.0f}"]


class Gap(NamedTuple):
    """Frames of a hand that are taken away."""

    recording: HandRecording
    side: Side
    frames: slice


Filling = Callable[[Gap], np.ndarray]


def gaps(recording: HandRecording, seconds: float, turn: int) -> list[Gap]:
    """Gaps of a length in one held-out round (validation and test tenths), object lifted in most of it."""
    tenth = np.arange(recording.n_frames) * TENTHS // recording.n_frames
    held = np.isin(tenth % ROUND, (*VALIDATION, *TEST)) & (tenth // ROUND == turn)
    length, found = round(seconds * RATE_HZ), []
    for first, stop in runs(held & recording.usable):
        for start in range(first + 1, stop - length, max(length // 2, RATE_HZ // 2)):
            frames = slice(start, start + length)
            if recording.lifted[frames].mean() > 0.5:
                found += [Gap(recording, side, frames) for side in SIDES]
    return found


def ways(predictor: Predictor) -> dict[str, Filling]:
    """What may stand in a gap, by name."""

    def ends(gap: Gap) -> tuple[np.ndarray, np.ndarray, int]:
        fingers, frames = gap.recording.fingers[gap.side], gap.frames
        return fingers[frames.start - 1], fingers[frames.stop], frames.stop - frames.start

    made: dict[tuple[str, Side, int, int], np.ndarray] = {}

    def network(gap: Gap) -> np.ndarray:
        key = (gap.recording.name, gap.side, gap.frames.start, gap.frames.stop)
        if key not in made:
            own, time_s = gap.recording, gap.recording.time_s[gap.frames.start - 1 : gap.frames.stop]
            made[key] = roll_out(predictor, [Task(own.hands[gap.side], gap.side, own.control, time_s, ends(gap)[0])])[
                0
            ][1:]
        return made[key]

    def led_over(seam_s: float) -> Filling:
        return lambda gap: led(network(gap), *ends(gap)[:2], round(seam_s / SETTINGS.step_s))

    return {
        "frozen fingers": lambda gap: np.tile(ends(gap)[0], (ends(gap)[2], 1, 1, 1)),
        "interpolated": lambda gap: interpolated(*ends(gap)),
        "network": network,
    } | {f"network, led over {seam:g} s": led_over(seam) for seam in SEAMS_S}


def show_gaps(recordings: Sequence[HandRecording], predictor: Predictor) -> None:
    rows, filling = [], ways(predictor)
    for seconds in GAPS_S:
        chosen = {name: _filled(gaps_of(recordings, seconds, 0), way) for name, way in filling.items()}
        told = {name: _filled(gaps_of(recordings, seconds, 1), way) for name, way in filling.items()}
        best = min(chosen, key=lambda name: chosen[name][0])
        count = len(gaps_of(recordings, seconds, 1))
        for name in told:
            words = [f"{value:.2f}" for value in (chosen[name][0], *told[name])]
            rows.append([f"{seconds:g} s, {count} gaps", name + " (chosen)" * (name == best), *words])
    columns = ["gap", "way", "joints mm, choosing round", "joints mm", "seam steps mm, 95 %", "own 99 % step mm"]
    show("Gaps in held-out intervals of the real recordings", columns, rows)


def gaps_of(recordings: Sequence[HandRecording], seconds: float, turn: int) -> list[Gap]:
    """At most ``MOST_GAPS`` of all recordings, evenly chosen."""
    found = [gap for one in recordings for gap in gaps(one, seconds, turn)]
    return [found[number] for number in np.linspace(0, len(found) - 1, min(MOST_GAPS, len(found))).astype(int)]


def _filled(found: Sequence[Gap], way: Filling) -> tuple[float, float, float]:
    """Mean joint error, the step at seams that 95 % stay below, and the 99th percentile of recorded steps, mm."""
    errors, seams, own = [], [], []
    for recording, side, frames in found:
        hand, true = recording.hands[side], recording.fingers[side]
        made = way(Gap(recording, side, frames))
        errors.append(joint_errors_m(hand, made, true[frames]).mean(axis=1))
        edges = np.stack([true[frames.start - 1], made[-1]]), np.stack([made[0], true[frames.stop]])
        seams.append(joint_errors_m(hand, *edges).mean(axis=1))
        around = true[max(frames.start - 4 * RATE_HZ, 0) : frames.stop + 4 * RATE_HZ]
        own.append(np.percentile(joint_errors_m(hand, around[1:], around[:-1]).mean(axis=1), 99))
    if not found:
        return np.nan, np.nan, np.nan
    seam_m = np.percentile(np.concatenate(seams), 95)
    return 1000 * float(np.concatenate(errors).mean()), 1000 * float(seam_m), 1000 * float(np.mean(own))
