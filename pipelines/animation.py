"""Trajectories, or frames of a stored clip, to fingers as files: what ``hoidata animate`` does."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from os.path import isfile  # of a name that is too long it says no, where a Path raises
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, Side
from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel
from hoidata.objects.user_mesh import read_user_object
from hoidata.store.annotated import load_annotated
from models.common.checkpoints import load_checkpoint
from models.common.repeatable import make_repeatable
from models.manipnet.animate import (
    Gap,
    Given,
    at_30_fps,
    clip_control,
    clip_of,
    gap_of,
    given_control,
    new_fingers,
    straight_fingers,
    with_fingers,
)
from models.manipnet.control import hands_of
from models.manipnet.network import ManipNet
from models.manipnet.rollout import Predictor, Rule
from models.manipnet.training import MANIPNET
from models.manipnet.trajectory_files import ENDINGS, Axes, TrajectoryFile, read_trajectories
from pipelines.command_inputs import MeshWish, stored_object, trained_on, trained_run
from pipelines.pages.motion_files import ARRAYS as SHARED
from pipelines.pages.motion_files import MotionFiles, drawn, hand_shapes, motion_arrays, write_motions
from pipelines.pages.player import motion_player
from pipelines.showing import find_clip
from pipelines.stages.base import StagePaths, load_hands

Way = Literal["auto", "network", "interpolate"]
ARRAYS = SHARED | {"made": "(S, F) whether the fingers were made here"}
UPS = {"": None, "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class AnimateWish:
    """What a person asks for. sides: the hands to animate; both where the recording has them. frames: "30:90" or "".

    model: the dataset whose network to use, "" for the clip's own or the first there is. object, unit, axes, up, mesh:
    of a file of trajectories. way: how frames of a clip are filled; "auto" for what was measured best for their length.
    """

    sides: tuple[Side, ...] = SIDES
    frames: str = ""
    model: str = ""
    rule: Rule = "ours"
    object: str = ""
    unit: str = ""
    axes: Axes = "model"
    up: str = ""
    mesh: MeshWish = field(default_factory=MeshWish)
    way: Way = "auto"

    def refuse_beside_clip(self) -> None:
        """Raise BadInput where something is told that only a file of trajectories has."""
        told = {
            "--object": self.object,
            "--trajectory-unit": self.unit,
            "--wrist-axes": "" if self.axes == "model" else self.axes,
            "--world-up": self.up,
            "--unit": self.mesh.unit,
            "--hinge": self.mesh.hinge,
        }
        for option, value in told.items():
            if value:
                raise BadInput(option, "nothing beside a clip, which says it itself", value, "leave it out")

    def refuse_beside_file(self) -> None:
        """Raise BadInput where something is told that only a clip has."""
        if self.frames:
            raise BadInput("--frames", "nothing beside a file of trajectories", self.frames, "cut the file")
        if self.way == "interpolate":
            remedy = "leave it out: a file of trajectories has no poses to go between"
            raise BadInput("--way", "network or auto beside a file of trajectories", self.way, remedy)
        if self.up not in UPS:
            raise BadInput("--world-up", "x, y or z", self.up, "name the axis of the file's world that points up")


@dataclass(frozen=True, eq=False)
class Network:
    """A trained network, ready; rows of the page that say which; and what its checkpoint knows."""

    predictor: Predictor
    rows: list[tuple[str, str]]
    known: Mapping[str, Any]

    @property
    def is_synthetic(self) -> bool:
        """Whether it learnt from generated clips: its motion is synthetic then."""
        return bool(self.known["synthetic"])

    def notes_on(self, clip_id: str) -> list[str]:
        """Says where the clip is one that the network has seen."""
        uses = {"train": "trained on this clip", "validation": "was chosen by this clip among others (validation)"}
        return [f"the network {words}" for part, words in uses.items() if clip_id in self.known["clips"][part]]


@dataclass(frozen=True, eq=False)
class Animated:
    """clip: the motion. made: (2, frame) bool, where fingers were made. ghosts: the recorded hands behind them."""

    clip: Clip
    made: np.ndarray
    ghosts: Mapping[Side, HandTrack]
    hands: HandPair
    facts: list[tuple[str, str]]
    notes: list[str]


def animate_files(what: str, wish: AnimateWish, profile: str, datasets: tuple[str, ...], out: Path) -> list[Path]:
    """Animate a stored clip (its id) or a file of trajectories (its path) into ``out``."""
    animated = animate(what, wish, profile, datasets)
    clip, hands, ghosts = animated.clip, animated.hands, animated.ghosts
    length = ("length", f"{clip.n_frames} frames, {clip.n_frames / FPS:.2f} s")
    return write_motions(
        out,
        "animation.html",
        [MotionFiles(clip, motion_arrays(clip, hands) | {"made": animated.made}, ghosts=ghosts)],
        hands,
        ARRAYS,
        title=clip.clip_id,
        ghost=bool(ghosts),
        notes=animated.notes,
        player=motion_player(drawn(clip), hands, clip.clip_id, ghosts=ghosts),
        facts=[*animated.facts, length, ("hand model", hands.name)],
    )


def animate(what: str, wish: AnimateWish, profile: str, datasets: tuple[str, ...]) -> Animated:
    """The same without files. Raises BadInput or MissingResource that says what cannot be, and what to do."""
    make_repeatable(threads=1)  # one hand is too small for two threads to agree on
    hands = load_hands(profile)
    if Path(what).suffix.lower() in (*ENDINGS, ".gz") or isfile(what):
        return _from_file(Path(what), wish, profile, datasets, hands)
    return _from_clip(what, wish, profile, datasets, hands)


def _from_clip(clip_id: str, wish: AnimateWish, profile: str, datasets: tuple[str, ...], hands: HandPair) -> Animated:
    wish.refuse_beside_clip()
    paths = _clip_paths(clip_id, profile, datasets)
    clip = load_annotated(paths.data, hands).clip(clip_id)
    frames = _frames(wish.frames, clip.n_frames)
    sides: list[Side] = [side for side in SIDES if side in wish.sides and clip.hands[side].valid.any()]
    if not sides:
        raise BadInput("--fingers", "a hand that was tracked in the clip", ", ".join(wish.sides), "name the other one")
    gaps: dict[Side, Gap] = {side: gap_of(clip.hands[side], frames) for side in sides}
    straight = [side for side in sides if _is_straight(gaps[side], wish.way)]
    network = None if straight == sides else chosen_network(wish, profile, (paths.dataset, *datasets), hands)
    control, own, tracks = clip_control(clip), hands_of(hands, *hand_shapes(clip)), dict(clip.hands)
    made = np.zeros((2, clip.n_frames), bool)
    for side, gap in gaps.items():
        if network is None or side in straight:
            fingers = straight_fingers(gap)
        else:
            fingers = new_fingers(network.predictor, own[side], side, control, gap)
        wanted = fingers[frames.start - gap.first : frames.stop - gap.first]
        tracks[side] = with_fingers(clip.hands[side], frames, wanted, control.wrists[side])
        made[SIDES.index(side), frames] = True
    rows = network.rows if network else []
    rows = [*rows, ("made", f"{', '.join(sides)}, frames {frames.start} to {frames.stop - 1} of {clip.n_frames}")]
    rows += [("way", f"{side}: {_way_words(gaps[side], side in straight)}") for side in sides]
    notes = [note for side in sides for note in _lost_notes(side, clip.hands[side], frames)]
    notes += network.notes_on(clip_id) if network else []
    shown = replace(clip, hands=tracks, synthetic=clip.synthetic or (network is not None and network.is_synthetic))
    return Animated(shown, made, {side: clip.hands[side] for side in sides}, hands, rows, notes)


def _clip_paths(clip_id: str, profile: str, datasets: tuple[str, ...]) -> StagePaths:
    """Where the clip's dataset lies. Raises BadInput for an unknown id; one with an ending was meant as a file."""
    try:
        return find_clip(clip_id, profile, list(datasets))
    except (BadInput, MissingResource) as error:
        if not Path(clip_id).suffix:
            raise
        expected = f"a file of trajectories ({', '.join(ENDINGS)}) or a clip's id"
        raise BadInput(clip_id, expected, "no such file, and no such clip", "correct the path or its ending") from error


def _is_straight(gap: Gap, way: Way) -> bool:
    """Whether a gap is to be filled by interpolation. Raises BadInput where that is told and cannot be."""
    if way == "interpolate" and (gap.before is None or gap.after is None):
        got = "frames that begin or end where the hand is not known"
        raise BadInput("--way interpolate", "known poses on both sides of --frames", got, "--way network")
    return way == "interpolate" or (way == "auto" and gap.is_short)


def _way_words(gap: Gap, is_straight: bool) -> str:
    if is_straight:
        return "interpolated between the known poses on both sides (docs/fingers.md: best up to 2 s)"
    led = [words for words, pose in (("before", gap.before), ("after", gap.after)) if pose is not None]
    return f"the network, led over 1 s to the known pose {' and '.join(led)}" if led else "the network"


def _lost_notes(side: Side, track: HandTrack, frames: slice) -> list[str]:
    lost = int((~track.valid[frames]).sum())
    total = frames.stop - frames.start
    words = (
        f"the {side} hand had been lost in {lost} of the {total} frames; there its wrist is where it was seen nearest"
    )
    return [words] if lost else []


def _from_file(path: Path, wish: AnimateWish, profile: str, datasets: tuple[str, ...], hands: HandPair) -> Animated:
    wish.refuse_beside_file()
    found = read_trajectories(path, wish.unit, wish.axes)
    network = chosen_network(wish, profile, datasets, hands)
    model, notes = _object(wish, wish.mesh.unit or found.mesh_unit, profile, datasets, hands)
    own = hands_of(hands, np.zeros((2, 10), np.float32), None)
    given = given_control(found, model, own)
    notes += [*given.notes, *_left_notes(found, given, wish.sides)]
    control = at_30_fps(given.control)
    made, fingers = np.zeros((2, len(control.object_motion.time_s)), bool), dict[Side, np.ndarray]()
    for side in found.wrists:
        fingers[side] = np.tile(own[side].rest_rotmats, (made.shape[1], 1, 1, 1))
        if side in given.active and side in wish.sides:
            gap = Gap(0, made.shape[1], None, None)
            fingers[side] = new_fingers(network.predictor, own[side], side, control, gap)
            made[SIDES.index(side)] = True
    clip = clip_of(control, fingers, found.up or UPS[wish.up], path.stem, network.is_synthetic)
    return Animated(clip, made, {}, hands, [*network.rows, ("object", model.name)], notes)


def _left_notes(found: TrajectoryFile, given: Given, sides: tuple[Side, ...]) -> list[str]:
    """Says which hands at the object were not asked for. Raises BadInput where none of those asked for is there."""
    if not set(given.active) & set(sides):
        there = f"{found.source} has {' and '.join(found.wrists)}, near the object {' and '.join(given.active)}"
        raise BadInput(
            "--fingers", "a hand that is in the file and near the object", sides[0], f"name another: {there}"
        )
    left = [side for side in given.active if side not in sides]
    return [f"the {side} hand was not asked for (--fingers) and keeps its neutral pose" for side in left]


def _object(
    wish: AnimateWish, unit: str, profile: str, datasets: tuple[str, ...], hands: HandPair
) -> tuple[ObjectModel, list[str]]:
    """A mesh file in its own axes, or an object of the dataset; and what is to be said of it."""
    if isfile(wish.object):
        # Trajectories say how the mesh lies: it is not turned upright.
        user = read_user_object(Path(wish.object), unit, "z", wish.mesh.hinge)
        return user.model, list(user.notes)
    if not wish.object:
        raise BadInput("--object", "the mesh of the object (.obj, .ply, .stl, .glb)", "none", "name it")
    return stored_object(wish.object, StagePaths(profile, wish.model or datasets[0]).clips, hands), []


def chosen_network(wish: AnimateWish, profile: str, datasets: tuple[str, ...], hands: HandPair) -> Network:
    """The trained network of the dataset asked for, or of the first that has one."""
    paths, facts = trained_run("manipnet", [MANIPNET.name], wish.model, profile, datasets, hands)
    checkpoint = load_checkpoint(paths.checkpoints / MANIPNET.name, MANIPNET, torch.device("cpu"))
    assert isinstance(checkpoint.network, ManipNet)
    rows = [("network", str(paths)), ("trained on", trained_on(facts)), ("post-processing", wish.rule)]
    return Network(Predictor(checkpoint.network, wish.rule), rows, facts)


def _frames(text: str, n_frames: int) -> slice:
    """ "30:90" as frames 30 to 89; "" for all."""
    first, colon, last = text.partition(":")
    try:
        start, stop = int(first or 0), int(last or n_frames)
        if (text and not colon) or not 0 <= start < stop <= n_frames:
            raise ValueError
    except ValueError as error:
        raise BadInput("--frames", f"FIRST:STOP within 0:{n_frames}", text, "like 30:90") from error
    return slice(start, stop)
