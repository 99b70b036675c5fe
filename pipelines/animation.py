"""Trajectories, or frames of a stored clip, to fingers as files: what ``hoidata animate`` does."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from hoidata.clips.clip import SIDES, Clip, HandTrack, Side
from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel
from hoidata.objects.user_mesh import read_user_object
from hoidata.store.annotated import load_annotated
from models.common.checkpoints import FILE_NAME, load_checkpoint
from models.common.repeatable import make_repeatable
from models.manipnet.animate import (
    at_30_fps,
    clip_control,
    clip_of,
    given_control,
    new_fingers,
    recorded_fingers,
    with_fingers,
)
from models.manipnet.network import ManipNet
from models.manipnet.rollout import Predictor, Rule
from models.manipnet.tracks import hands_of
from models.manipnet.training import MANIPNET
from models.manipnet.trajectory_files import Axes, read_trajectories
from pipelines.objects import MeshWish, stored_object
from pipelines.pages.animation_page import write_animation
from pipelines.showing import find_clip
from pipelines.stages.base import StagePaths, load_hands

UPS = {"": None, "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class AnimateWish:
    """What a person asks for. sides: the hands to animate; both where the recording has them. frames: "30:90" or "".

    model: the dataset whose network to use, "" for the clip's own or the first there is. object, unit, axes, up: of a
    file of trajectories.
    """

    sides: tuple[Side, ...] = SIDES
    frames: str = ""
    model: str = ""
    rule: Rule = "ours"
    object: str = ""
    unit: str = "m"
    axes: Axes = "model"
    up: str = ""
    mesh: MeshWish = field(default_factory=MeshWish)


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
    made = animate(what, wish, profile, datasets)
    return write_animation(out, made.clip, made.made, made.ghosts, made.hands, made.facts, made.notes)


def animate(what: str, wish: AnimateWish, profile: str, datasets: tuple[str, ...]) -> Animated:
    """The same without files. Raises BadInput or MissingResource that says what cannot be, and what to do."""
    make_repeatable(threads=1)  # one hand is too small for two threads to agree on
    hands = load_hands(profile)
    if Path(what).suffix.lower() in (".csv", ".npz", ".txt") or Path(what).is_file():
        return _from_file(Path(what), wish, profile, datasets, hands)
    return _from_clip(what, wish, profile, datasets, hands)


def _from_clip(clip_id: str, wish: AnimateWish, profile: str, datasets: tuple[str, ...], hands: HandPair) -> Animated:
    paths = find_clip(clip_id, profile, list(datasets))
    clip = load_annotated(paths.data, hands).clip(clip_id)
    predictor, facts = chosen_network(wish, profile, (paths.dataset, *datasets), hands)
    frames = _frames(wish.frames, clip.n_frames)
    control, tracks = clip_control(clip), dict(clip.hands)
    own = hands_of(hands, *_shape(clip))
    made, ghosts = np.zeros((2, clip.n_frames), bool), dict[Side, HandTrack]()
    for row, side in enumerate(SIDES):
        if side in wish.sides and clip.hands[side].valid.any():
            recorded = recorded_fingers(clip.hands[side]) if wish.frames else None
            fingers = new_fingers(predictor, own[side], side, control, frames, recorded)
            tracks[side] = with_fingers(clip.hands[side], frames, fingers)
            made[row, frames], ghosts[side] = True, clip.hands[side]
    if not ghosts:
        raise BadInput("--fingers", "a hand that was tracked in the clip", ", ".join(wish.sides), "name the other one")
    facts.append(("made", f"{', '.join(ghosts)}, frames {frames.start} to {frames.stop - 1} of {clip.n_frames}"))
    return Animated(replace(clip, hands=tracks), made, ghosts, hands, facts, [])


def _from_file(path: Path, wish: AnimateWish, profile: str, datasets: tuple[str, ...], hands: HandPair) -> Animated:
    if wish.frames:
        raise BadInput("--frames", "nothing beside a file of trajectories", wish.frames, "cut the file")
    if wish.up not in UPS:
        raise BadInput("--world-up", "x, y or z", wish.up, "name the axis of the file's world that points up")
    predictor, facts = chosen_network(wish, profile, datasets, hands)
    found = read_trajectories(path, wish.unit, wish.axes)
    model, notes = _object(wish, wish.mesh.unit or found.mesh_unit, profile, datasets, hands)
    own = hands_of(hands, np.zeros((2, 10), np.float32), None)
    given = given_control(found, model, own)
    control = at_30_fps(given.control)
    made, fingers = np.zeros((2, len(control.thing.time_s)), bool), dict[Side, np.ndarray]()
    for side in found.wrists:
        fingers[side] = np.tile(own[side].rest_rotmats, (made.shape[1], 1, 1, 1))
        if side in given.active and side in wish.sides:
            fingers[side] = new_fingers(predictor, own[side], side, control, slice(None), None)
            made[SIDES.index(side)] = True
    clip = clip_of(control, fingers, found.up or UPS[wish.up], path.stem, False)
    return Animated(clip, made, {}, hands, [*facts, ("object", model.name)], [*notes, *given.notes])


def _object(
    wish: AnimateWish, unit: str, profile: str, datasets: tuple[str, ...], hands: HandPair
) -> tuple[ObjectModel, list[str]]:
    """A mesh file in its own axes, or an object of the dataset; and what is to be said of it."""
    if Path(wish.object).is_file():
        # Trajectories say how the mesh lies: it is not turned upright.
        user = read_user_object(Path(wish.object), unit, "z", wish.mesh.hinge)
        return user.model, list(user.notes)
    if not wish.object:
        raise BadInput("--object", "the mesh of the object (.obj, .ply, .stl, .glb)", "none", "name it")
    return stored_object(wish.object, StagePaths(profile, wish.model or datasets[0]).clips, hands), []


def chosen_network(
    wish: AnimateWish, profile: str, datasets: tuple[str, ...], hands: HandPair
) -> tuple[Predictor, list[tuple[str, str]]]:
    """The trained network of the dataset asked for, or of the first that has one, ready; and what is known of it."""
    names = (wish.model,) if wish.model else tuple(dict.fromkeys(datasets))
    found = [StagePaths(profile, name) for name in names]
    trained = [paths for paths in found if (paths.checkpoints / MANIPNET.name / FILE_NAME).is_file()]
    if not trained:
        where = ", ".join(str(paths) for paths in found)
        raise MissingResource(
            f"no network for fingers ({where}): list manipnet under families in params.yaml, then `dvc repro`"
        )
    checkpoint = load_checkpoint(trained[0].checkpoints / MANIPNET.name, MANIPNET, torch.device("cpu"))
    assert isinstance(checkpoint.network, ManipNet)
    facts = checkpoint.facts
    if facts["hand_digest"] != hands.digest:
        remedy = "train it with the hand of this profile"
        raise BadInput(trained[0].checkpoints, f"hand {facts['hand']}", hands.name, remedy)
    kind = "SYNTHETIC" if facts["synthetic"] else "recorded"
    known = ", ".join(f"{count} {kind} {name} clips" for name, count in facts["datasets"].items())
    rows = [("network", str(trained[0])), ("trained on", known), ("post-processing", wish.rule)]
    return Predictor(checkpoint.network, wish.rule), rows


def _shape(clip: Clip) -> tuple[np.ndarray, np.ndarray | None]:
    """(2, 10) shapes and (2, 778, 3) personal meshes, as samples have them."""
    tracks = [clip.hands[side] for side in SIDES]
    templates = [track.template_m for track in tracks if track.template_m is not None]
    betas = np.stack([track.betas.mean(axis=0) for track in tracks]).astype(np.float32)
    return betas, np.stack(templates).astype(np.float32) if len(templates) == 2 else None


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
