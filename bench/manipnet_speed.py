"""How fast fingers are made: both hands, sensors, network, post-processing, frame by frame on one core.

``python -m bench fingers``. Untrained networks at the paper's size and the small one (what they say makes no difference
to the time), the embedded hand, a box of 12 and a sphere of 20,480 triangles, every joint to be moved: the worst there
is. With HOIDATA_MANIPNET the real recordings, lifted frames, as well: there the recorded pose and distances stand for
what the network says. Where the time goes stands beside it, and as a picture in .hoidata/manipnet.
"""

import os
import time
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
import trimesh

from bench.harness import show
from bench.manipnet import KEPT, SETTINGS
from bench.manipnet_recordings import NAMES, HandRecording, read_hands
from hoidata.clips.clip import SIDES, Side
from hoidata.files import write_whole
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.sensors.mano_hand import mano_hand
from models.manipnet.control import Control, Motion
from models.manipnet.examples import sized
from models.manipnet.features import outputs
from models.manipnet.network import ManipNet, NetworkConfig
from models.manipnet.rollout import Follower, Predictor, situation

FRAMES, WARM_UP = 240, 30
SIZES = {"full": 512, "small": 128}
PARTS = ("trajectories", "sensors", "network", "post-processing")
HANDS: dict[Side, TrackedHand] = {side: mano_hand(load_embedded_hands(), side) for side in SIDES}


def main() -> None:
    torch.set_num_threads(1)
    found = {}
    for size, width in SIZES.items():
        for thing, mesh in (
            ("box", trimesh.creation.box((0.06, 0.06, 0.1))),
            ("sphere", trimesh.creation.icosphere(5)),
        ):
            vertices = np.asarray(mesh.vertices) * (0.04 if thing == "sphere" else 1.0)
            model = ObjectModel(thing, vertices, np.asarray(mesh.faces), np.zeros(len(vertices), np.uint8))
            found[f"{size}, {thing} of {len(mesh.faces):,}, every joint moved"] = worst_ms(model, width)
    if root := os.environ.get("HOIDATA_MANIPNET"):
        for recording in (read_hands(Path(root), name) for name in NAMES):
            for size, width in SIZES.items():
                label = f"{size}, {recording.name} of {len(recording.control.model.faces):,}"
                found[label] = recorded_ms(recording, width)
    rows = []
    for label, spent in found.items():
        whole = spent.sum(axis=1)
        figures = [f"{1000 / whole.mean():.0f}", f"{np.median(whole):.1f}", f"{np.percentile(whole, 99):.1f}"]
        rows.append([label, *figures, *(f"{part:.2f}" for part in np.median(spent, axis=0))])
    columns = ["network, object", "frames/s", "median ms", "p99 ms", *(f"{name} ms" for name in PARTS)]
    show("Both hands, one core, processor time", columns, rows)
    write_whole(KEPT / "time.svg", picture({label: np.median(spent, axis=0) for label, spent in found.items()}))
    print(f"picture: {KEPT / 'time.svg'}")


def recorded_ms(recording: HandRecording, width: int) -> np.ndarray:
    """(frame, part) of a recording's frames from a lifted one on; what it shows stands for what a network says."""
    lifted = np.flatnonzero(recording.lifted & recording.usable)
    frames = slice(lifted[len(lifted) // 3], lifted[len(lifted) // 3] + FRAMES)
    hands, control, time_s = recording.hands, recording.control, recording.time_s[frames]
    said = {}
    for side in SIDES:
        state = hands[side].state(recording.fingers[side][frames])
        placed = control.thing.at(time_s).inverse() @ control.wrists[side].at(time_s)
        distance_m = recording.surface.nearest(placed @ state.point_m, None).distance_m
        said[side] = outputs(hands[side], state, distance_m, SETTINGS)
    start: dict[Side, np.ndarray] = {side: recording.fingers[side][frames.start] for side in SIDES}
    answers: list[dict[Side, np.ndarray]] = [
        {side: said[side][frame] for side in SIDES} for frame in range(1, len(time_s))
    ]
    return _spent_ms(control, hands, width, start, time_s, lambda frame, made: answers[frame])


def worst_ms(model: ObjectModel, width: int) -> np.ndarray:
    """(frame, part) of hands whose every joint is said to be on the surface."""

    def answers(frame: int, made: np.ndarray) -> dict[Side, np.ndarray]:
        for side, output in zip(SIDES, made, strict=True):
            output[-HANDS[side].n_points :] = 0.2
        return dict(zip(SIDES, made, strict=True))

    start: dict[Side, np.ndarray] = {side: hand.rest_rotmats for side, hand in HANDS.items()}
    return _spent_ms(_control(model), HANDS, width, start, np.arange(FRAMES) / 60, answers)


def _spent_ms(
    control: Control,
    hands: Mapping[Side, TrackedHand],
    width: int,
    start: Mapping[Side, np.ndarray],
    time_s: np.ndarray,
    answers: Callable[[int, np.ndarray], Mapping[Side, np.ndarray]],
) -> np.ndarray:
    """(frame, part) processor time, less the frames to warm up. answers: by frame what counts as said."""
    config = sized(NetworkConfig(encoder=width, features=SETTINGS), hands["right"])
    predictor = Predictor(ManipNet(config).eval())
    surface = surface_index(control.model)
    followers = {side: Follower(predictor, hands[side], surface, start[side]) for side in SIDES}
    spent = []
    for frame, times in enumerate(pairwise(time_s)):
        marks = [time.process_time()]
        now, then = ({side: situation(control, side, hands[side], t, SETTINGS) for side in SIDES} for t in times)
        marks.append(time.process_time())
        inputs = np.stack([followers[side].inputs(now[side]) for side in SIDES])
        marks.append(time.process_time())
        made = predictor(inputs)
        marks.append(time.process_time())
        for side, output in answers(frame, made).items():
            followers[side].advance(output, then[side])
        marks.append(time.process_time())
        spent.append(np.diff(marks))
    return 1000 * np.array(spent[WARM_UP:])


def picture(spent_ms: Mapping[str, np.ndarray], width: int = 820) -> str:
    """SVG of a bar per row, as long as its frame takes, in the colours of its parts."""
    colours, left, high = ("#9aa3ad", "#2a6fb0", "#2f8f4e", "#c2562d"), 330, 22
    scale = (width - left - 120) / max(float(parts.sum()) for parts in spent_ms.values())
    marks = [
        f'<rect x="{left + 110 * number}" y="6" width="12" height="12" fill="{colour}"/>'
        f'<text x="{left + 16 + 110 * number}" y="16">{name}</text>'
        for number, (name, colour) in enumerate(zip(PARTS, colours, strict=True))
    ]
    for row, (label, parts) in enumerate(spent_ms.items()):
        top, ends = 30 + high * row, left + scale * np.concatenate([[0.0], np.cumsum(parts)])
        marks.append(f'<text x="{left - 8}" y="{top + 13}" text-anchor="end">{label}</text>')
        marks += [
            f'<rect x="{start:.1f}" y="{top}" width="{stop - start:.1f}" height="{high - 6}" fill="{colour}"/>'
            for (start, stop), colour in zip(pairwise(ends), colours, strict=True)
        ]
        marks.append(f'<text x="{ends[-1] + 5:.1f}" y="{top + 13}">{parts.sum():.1f} ms</text>')
    size = f'width="{width}" height="{40 + high * len(spent_ms)}" font-family="sans-serif" font-size="12"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>\n' + "\n".join(marks) + "\n</svg>\n"


def _control(model: ObjectModel) -> Control:
    """Two hands with their palms at an object that turns."""
    time_s = np.arange(FRAMES + 60) / 60
    turn = rotvec_to_rotmat(np.stack([0.4 * np.sin(time_s), 0.5 * time_s, 0 * time_s], axis=1))
    wrists = {}
    for side, hand in HANDS.items():
        away = 0.06 if side == "right" else -0.06
        palm = hand.wrist_from_canonical @ [0.08, 0.0, -0.05]
        wrists[side] = Motion(
            time_s, np.tile(np.eye(3), (len(time_s), 1, 1)), np.tile([away, 0, 0] - palm, (len(time_s), 1))
        )
    return Control(wrists, Motion(time_s, turn, np.zeros((len(time_s), 3))), model)
