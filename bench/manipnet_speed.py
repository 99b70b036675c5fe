"""How fast fingers are made: both hands, sensors, network, post-processing, frame by frame on one core.

``python -m bench fingers``. Untrained networks at the paper's size and the small one (what they say makes no difference
to the time), the embedded hand, a box of 12 and a sphere of 20,480 triangles, every joint to be moved: the worst there
is. Shares of the processor time beside it. With HOIDATA_MANIPNET the real recordings, lifted frames, as well: there the
recorded pose and distances stand for what the network says.
"""

import os
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
import trimesh

from bench.harness import show
from bench.manipnet import SETTINGS
from bench.manipnet_recordings import NAMES, HandRecording, read_hands
from hoidata.clips.clip import SIDES
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import load_embedded_hands
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import surface_index
from hoidata.sensors.mano_hand import mano_hand
from models.manipnet.control import Control, Motion
from models.manipnet.examples import sized
from models.manipnet.features import outputs
from models.manipnet.network import ManipNet, NetworkConfig
from models.manipnet.rollout import Follower, Predictor, situation

FRAMES, WARM_UP = 240, 30
HANDS = {side: mano_hand(load_embedded_hands(), side) for side in SIDES}


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for size, width in (("full", 512), ("small", 128)):
        for thing, mesh in (
            ("box", trimesh.creation.box((0.06, 0.06, 0.1))),
            ("sphere", trimesh.creation.icosphere(5)),
        ):
            vertices = np.asarray(mesh.vertices) * (0.04 if thing == "sphere" else 1.0)
            model = ObjectModel(thing, vertices, np.asarray(mesh.faces), np.zeros(len(vertices), np.uint8))
            rows.append([f"{size}, {thing} of {len(mesh.faces)}", *_figures(model, width)])
    columns = ["network, object", "frames/s", "median ms", "p99 ms", *(f"{name} ms" for name in _PARTS)]
    show("Both hands, one core, processor time", columns, rows)
    if root := os.environ.get("HOIDATA_MANIPNET"):
        show_recordings(Path(root))


def show_recordings(root: Path) -> None:
    """Both hands of the real recordings, with their own objects."""
    rows = []
    for name in NAMES:
        recording = read_hands(root, name)
        for size, width in (("full", 512), ("small", 128)):
            spent = _seconds_of(recording, width)
            figures = [
                f"{1 / spent.mean():.0f}",
                f"{1000 * np.median(spent):.1f}",
                f"{1000 * np.percentile(spent, 99):.1f}",
            ]
            rows.append([f"{size}, {name} of {len(recording.control.model.faces)}", *figures])
    show(
        "The real recordings, both hands, one core, processor time",
        ["network, object", "frames/s", "median ms", "p99 ms"],
        rows,
    )


def _seconds_of(recording: HandRecording, width: int) -> np.ndarray:
    """(frame,) of frames from a lifted one on, less those to warm up."""
    lifted = np.flatnonzero(recording.lifted & recording.usable)
    frames = slice(lifted[len(lifted) // 3], lifted[len(lifted) // 3] + FRAMES)
    hands, control, time_s = recording.hands, recording.control, recording.time_s[frames]
    config = sized(NetworkConfig(encoder=width, features=SETTINGS), hands["right"])
    predictor = Predictor(ManipNet(config).eval())
    start = frames.start
    followers = {
        side: Follower(predictor, hands[side], recording.surface, recording.fingers[side][start]) for side in SIDES
    }
    said = {}
    for side in SIDES:
        state = hands[side].state(recording.fingers[side][frames])
        placed = control.thing.at(time_s).inverse() @ control.wrists[side].at(time_s)
        distance_m = recording.surface.nearest(placed @ state.point_m, None).distance_m
        said[side] = outputs(hands[side], state, distance_m, SETTINGS)
    spent = []
    for frame in range(1, len(time_s)):
        began = time.process_time()
        now, then = (
            {side: situation(control, side, hands[side], t, SETTINGS) for side in SIDES}
            for t in time_s[frame - 1 : frame + 1]
        )
        predictor(np.stack([followers[side].inputs(now[side]) for side in SIDES]))
        for side in SIDES:
            followers[side].advance(said[side][frame], then[side])
        spent.append(time.process_time() - began)
    return np.array(spent[WARM_UP:])


_PARTS = ("trajectories", "sensors", "network", "post-processing")


def _figures(model: ObjectModel, width: int) -> list[str]:
    control = _control(model)
    predictor = Predictor(ManipNet(sized(NetworkConfig(encoder=width), HANDS["right"])).eval())
    followers = {
        side: Follower(predictor, hand, surface_index(model), hand.rest_rotmats) for side, hand in HANDS.items()
    }
    parts, whole = defaultdict(list), []
    for number in range(FRAMES):
        marks = [time.process_time()]
        at = number / 60
        now, then = (
            {side: situation(control, side, hand, t, predictor.settings) for side, hand in HANDS.items()}
            for t in (at, at + 1 / 60)
        )
        marks.append(time.process_time())
        inputs = np.stack([followers[side].inputs(now[side]) for side in SIDES])
        marks.append(time.process_time())
        made = predictor(inputs)
        marks.append(time.process_time())
        for side, output in zip(SIDES, made, strict=True):
            output[-HANDS[side].n_points :] = 0.2  # every joint is to be moved
            followers[side].advance(output, then[side])
        marks.append(time.process_time())
        whole.append(marks[-1] - marks[0])
        for name, spent in zip(_PARTS, np.diff(marks), strict=True):
            parts[name].append(spent)
    kept = 1000 * np.array(whole[WARM_UP:])
    shares = [f"{1000 * np.median(parts[name][WARM_UP:]):.2f}" for name in _PARTS]
    return [f"{1000 / kept.mean():.0f}", f"{np.median(kept):.1f}", f"{np.percentile(kept, 99):.1f}", *shares]


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
