"""`hoidata animate` and `stream`: finger motion for trajectories, or for frames of a stored clip (ManipNet)."""

import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import astuple, dataclass, field, replace
from functools import partial
from os.path import isfile  # returns False for a name that is too long, where Path.is_file raises
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from hoidata.clips.clip import FPS, SIDES, Clip, HandTrack, Side
from hoidata.errors import BadInput, MissingResource
from hoidata.hands import HandPair
from hoidata.hands.tracked_hand import TrackedHand
from hoidata.metrics.verdict import summary, verdict, verdict_lines
from hoidata.object_paths.trajectory_files import (
    ENDINGS,
    MAX_FRAMES,
    MIN_FRAMES,
    Axes,
    TrajectoryFile,
    read_trajectories,
)
from hoidata.objects.model import ObjectModel
from hoidata.objects.user_mesh import is_object_path, read_user_object
from hoidata.sensors.mano_hand import mano_hands
from hoidata.store.annotated import load_annotated
from models.common.checkpoints import load_checkpoint
from models.common.repeatable import make_repeatable
from models.manipnet.animate import (
    AnimationInput,
    Gap,
    at_rate,
    clip_of,
    control_from_file,
    control_of_two_objects,
    gap_of,
    interpolate_fingers,
    predict_fingers,
    with_fingers,
)
from models.manipnet.calibration import calibrated_file, calibrated_frame, offsets_of
from models.manipnet.control import Control, control_from_clip
from models.manipnet.datagrams import Tracker, parse_address, pose_line
from models.manipnet.network import ManipNet
from models.manipnet.rollout import Predictor, Rule
from models.manipnet.stream import Stream, TrackedFrame, control_of_frames, tracked_frames
from models.manipnet.training import MANIPNET
from pipelines.command_inputs import (
    MeshOptions,
    ProjectData,
    WrittenFiles,
    check_new_store,
    stored_object,
    trained_on,
    trained_run,
    write_motion_store,
)
from pipelines.pages.motion_files import ARRAYS as SHARED
from pipelines.pages.motion_files import MotionFiles, hand_shapes, motion_arrays, simplified_for_page, write_motions
from pipelines.pages.player import motion_player
from pipelines.show_pages import dataset_of_clip
from pipelines.stages.base import StagePaths, load_hands

Method = Literal["auto", "network", "interpolate"]
ARRAYS = SHARED | {
    "made": "(S, F) whether the fingers were generated",
    "time_s": "(F,) of the file or tracker; of a clip, since its first frame",
    "left_object_rotvec": "(F, 3) as object_rotvec, of another object in the left hand",
    "left_object_translation_m": "(F, 3) as object_translation_m",
}
UPS = {"": None, "x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class AnimationOptions:
    """The options of ``hoidata animate``."""

    sides: tuple[Side, ...] = SIDES  # hands to animate, if the recording has them
    frames: str = ""  # of a clip: "30:90", or "" for all
    model: str = ""  # the dataset whose network to use; "" for the clip's dataset, else the first that has one
    rule: Rule = "preset"
    object: str = ""  # of a file of trajectories: a mesh file, or the name of an object of the dataset
    left_object: str = ""  # the same, if the left hand has another object
    unit: str = ""  # of positions in a file of trajectories
    axes: Axes = "model"  # of the wrists in a file of trajectories
    up: str = ""  # of a file of trajectories: the world axis that points up
    hand_length_cm: float | None = None  # from the wrist joint to the tip of the middle finger; None: mean hand
    fps: int = FPS  # of motion.npz
    calibration: str = ""  # a recording of flat hands that gives the offsets of trackers from the wrists
    mesh: MeshOptions = field(default_factory=MeshOptions)
    method: Method = "auto"  # of filling frames of a clip; "auto" chooses by their number

    def check_for_clip(self) -> None:
        """Raise BadInput for an option that applies only to a file of trajectories."""
        file_options = {
            "--object": self.object,
            "--left-object": self.left_object,
            "--trajectory-unit": self.unit,
            "--wrist-axes": "" if self.axes == "model" else self.axes,
            "--world-up": self.up,
            "--hand-length": self.hand_length_cm,
            "--fps": "" if self.fps == FPS else self.fps,
            "--calibration": self.calibration,
            "--unit": self.mesh.unit,
            "--hinge": self.mesh.hinge,
            "--moving": self.mesh.moving,
            "--scale": "" if self.mesh.scale == 1 else self.mesh.scale,
        }
        for option, value in file_options.items():
            if value:
                raise BadInput(option, "no such option with a clip, which has this information", value, "omit it")

    def check_for_file(self) -> None:
        """Raise BadInput for an option that applies only to a clip."""
        if self.frames:
            raise BadInput("--frames", "no such option with a file of trajectories", self.frames, "cut the file")
        if self.method == "interpolate":
            remedy = "omit it: a file of trajectories has no poses to interpolate between"
            raise BadInput("--way", "network or auto with a file of trajectories", self.method, remedy)
        if self.calibration and self.axes != "model":
            raise BadInput("--wrist-axes", "none with --calibration, which measures them", self.axes, "omit it")
        if self.up not in UPS:
            raise BadInput("--world-up", "x, y or z", self.up, "name the axis of the file's world that points up")

    def check_for_tracker(self) -> None:
        """Raise BadInput for an option that applies only to a file of trajectories."""
        for option, value in {"--trajectory-unit": self.unit, "--wrist-axes": self.axes}.items():
            if value not in ("", "model"):
                raise BadInput(option, "no such option with a tracker, which sends metres", value, "convert its poses")


ShowPoses = Callable[[float, Mapping[Side, np.ndarray]], None]  # seconds, (15, 3, 3) rotations by side
# Predictor, hands to animate, trajectories of the file and at 30 fps; gives (frame, 15, 3, 3) by side at 30 fps.
PredictFingers = Callable[[Predictor, Mapping[Side, TrackedHand], Control, Control], dict[Side, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Network:
    """A trained network that predicts finger poses."""

    predictor: Predictor
    rows: list[tuple[str, str]]  # (label, value) for the page
    facts: Mapping[str, Any]  # in the header of its checkpoint

    @property
    def is_synthetic(self) -> bool:
        """Whether the training clips were generated; its motions then count as synthetic too."""
        return bool(self.facts["synthetic"])

    def notes_on(self, clip_id: str) -> list[str]:
        """A note if the clip is one of the network's training or validation clips."""
        uses = {"train": "trained on this clip", "validation": "was selected on this clip among others (validation)"}
        return [f"the network {use}" for subset, use in uses.items() if clip_id in self.facts["clips"][subset]]


@dataclass(frozen=True, eq=False)
class Animation:
    """An animated clip."""

    clip: Clip  # ``fps`` frames per second
    generated: np.ndarray  # (2, frame) bool, whether the fingers of the left and right hand were generated
    ghosts: Mapping[Side, HandTrack]  # the recorded hands, shown transparent for comparison
    hands: HandPair
    facts: list[tuple[str, str]]
    notes: list[str]
    network_facts: Mapping[str, Any] = field(default_factory=dict)  # empty if the fingers are interpolated
    source_info: Mapping[str, Any] = field(default_factory=dict)  # of the store of an animated clip
    fps: int = FPS
    first_s: float = 0.0  # time of the first frame


def animate_files(
    source: str,
    options: AnimationOptions,
    profile: str,
    datasets: tuple[str, ...],
    out: Path,
    store: Path | None = None,
) -> WrittenFiles:
    """Animate a stored clip (its id) or a file of trajectories (its path); write ``out``, and the clip to ``store``."""
    check_new_store(store)
    return _written(animate(source, options, profile, datasets), out, store)


def stream_files(
    source: str,
    options: AnimationOptions,
    profile: str,
    datasets: tuple[str, ...],
    out: Path,
    store: Path | None,
    show: Callable[[str], None],
    report: Callable[[str], None],
    to: str = "",
    in_real_time: bool = True,
) -> WrittenFiles:
    """Run a live ``Stream`` for a file of trajectories or a tracker, and write its poses as ``animate_files`` does.

    Args:
        source: the file, or the address at which a tracker's frames arrive (``models.manipnet.datagrams``).
        show: called with each predicted pose as a line of JSON, which is also sent to the address ``to``, if any.
        report: called with the reason why a datagram was refused.
        in_real_time: push each frame of a file at its recorded time; else without waiting.
    """
    check_new_store(store)
    make_repeatable(threads=1)
    project = ProjectData(profile, datasets, load_hands(profile))
    address = parse_address(to) if to else None
    with socket.socket(type=socket.SOCK_DGRAM) as sender:

        def show_pose(time_s: float, poses: Mapping[Side, np.ndarray]) -> None:
            line = pose_line(time_s, poses)
            show(line)
            if address:
                with suppress(OSError):  # a datagram may be lost
                    sender.sendto(line.encode(), address)

        if "://" in source:
            animation = _from_tracker(source, options, project, show_pose, report)
        else:
            predict = partial(_stream_fingers, show=show_pose, in_real_time=in_real_time)
            animation = _from_file(Path(source), options, project, predict)
    return _written(animation, out, store)


def _written(animation: Animation, out: Path, store: Path | None) -> WrittenFiles:
    hands, ghosts, generated, info = animation.hands, animation.ghosts, animation.generated, animation.source_info
    arrays = motion_arrays(animation.clip, hands) | {"made": generated, "fps": np.array(animation.fps)}
    arrays["time_s"] = animation.first_s + np.arange(animation.clip.n_frames) / animation.fps
    clip = animation.clip.take(slice(None, None, animation.fps // FPS))  # of the other files
    left_objects = () if info else clip.other_objects  # those of a recorded clip are others
    sides: list[Side] = [side for side, frames in zip(SIDES, generated, strict=True) if frames.any()]
    checks = verdict(clip, hands, sides=[side for side in sides if side == "right" or not left_objects])
    for left in animation.clip.other_objects if left_objects else ():
        arrays |= {"left_object_rotvec": left.rotvec, "left_object_translation_m": left.translation_m}
    length = ("length", f"{clip.n_frames} frames, {clip.n_frames / FPS:.2f} s")
    paths = write_motions(
        out,
        "animation.html",
        [MotionFiles(clip, arrays, ghosts=ghosts)],
        hands,
        ARRAYS,
        title=clip.clip_id,
        ghost=bool(ghosts),
        notes=animation.notes,
        player=motion_player(simplified_for_page(clip), hands, clip.clip_id, ghosts=ghosts),
        facts=[*animation.facts, length, ("hand model", hands.name)],
        verdicts=[("", summary(checks), checks)],
    )
    stored = replace(clip, clip_id=f"{clip.clip_id}~0") if info else clip
    paths += write_motion_store(store, [stored], hands, animation.network_facts, **info)
    return WrittenFiles(paths, animation.notes, verdict_lines(0, checks))


def animate(source: str, options: AnimationOptions, profile: str, datasets: tuple[str, ...]) -> Animation:
    """Animate a stored clip or a file of trajectories. Raises BadInput or MissingResource with a remedy."""
    make_repeatable(threads=1)  # one hand is too small to gain from two threads
    project = ProjectData(profile, datasets, load_hands(profile))
    if Path(source).suffix.lower() in (*ENDINGS, ".gz") or isfile(source):
        return _from_file(Path(source), options, project)
    return _from_clip(source, options, project)


def _from_clip(clip_id: str, options: AnimationOptions, project: ProjectData) -> Animation:
    options.check_for_clip()
    hands, paths = project.hands, _clip_paths(clip_id, project)
    annotated = load_annotated(paths.data, hands)
    clip = annotated.clip(clip_id)
    frames = _frames(options.frames, clip.n_frames)
    sides: list[Side] = [side for side in SIDES if side in options.sides and clip.hands[side].valid.any()]
    if not sides:
        got = ", ".join(options.sides)
        raise BadInput("--fingers", "a hand that was tracked in the clip", got, "name the other one")
    gaps: dict[Side, Gap] = {side: gap_of(clip.hands[side], frames) for side in sides}
    interpolated = [side for side in sides if _is_interpolated(gaps[side], options.method)]
    network = None
    if interpolated != sides:
        datasets = (paths.dataset, *project.datasets)  # the networks of the clip's dataset come first
        network = chosen_network(options, project._replace(datasets=datasets))
    control, person_hands, tracks = control_from_clip(clip), mano_hands(hands, *hand_shapes(clip)), dict(clip.hands)
    generated = np.zeros((2, clip.n_frames), bool)
    for side, gap in gaps.items():
        if network is None or side in interpolated:
            fingers = interpolate_fingers(gap)
        else:
            fingers = predict_fingers(network.predictor, person_hands[side], side, control, gap)
        # A gap includes the untracked frames around the requested ones.
        requested = fingers[frames.start - gap.first : frames.stop - gap.first]
        tracks[side] = with_fingers(clip.hands[side], frames, requested, control.wrists[side])
        generated[SIDES.index(side), frames] = True
    generated_words = f"{', '.join(sides)}, frames {frames.start} to {frames.stop - 1} of {clip.n_frames}"
    rows = [*(network.rows if network else []), ("generated", generated_words)]
    rows += [("method", f"{side}: {_method_words(gaps[side], side in interpolated)}") for side in sides]
    notes = [note for side in sides for note in _lost_notes(side, clip.hands[side], frames)]
    notes += network.notes_on(clip_id) if network else []
    is_synthetic = clip.synthetic or (network is not None and network.is_synthetic)
    ghosts: dict[Side, HandTrack] = {side: clip.hands[side] for side in sides}
    animated = replace(clip, hands=tracks, synthetic=is_synthetic)
    return Animation(animated, generated, ghosts, hands, rows, notes, network.facts if network else {}, annotated.info)


def _clip_paths(clip_id: str, project: ProjectData) -> StagePaths:
    """The paths of the clip's dataset. Raises BadInput for an unknown id; a name with a suffix counts as a file."""
    try:
        return dataset_of_clip(clip_id, project.profile, list(project.datasets))
    except (BadInput, MissingResource) as error:
        if not Path(clip_id).suffix:
            raise
        expected = f"a file of trajectories ({', '.join(ENDINGS)}) or a clip's id"
        raise BadInput(clip_id, expected, "no such file, and no such clip", "correct the path or its ending") from error


def _is_interpolated(gap: Gap, method: Method) -> bool:
    """Whether to fill a gap by interpolation. Raises BadInput if that is requested and impossible."""
    if method == "interpolate" and (gap.before is None or gap.after is None):
        got = "frames that begin or end where the hand is not tracked"
        raise BadInput("--way interpolate", "known poses on both sides of --frames", got, "--way network")
    return method == "interpolate" or (method == "auto" and gap.is_short)


def _method_words(gap: Gap, is_interpolated: bool) -> str:
    if is_interpolated:
        return "interpolated between the known poses on both sides (docs/fingers.md: best up to 2 s)"
    blended = [words for words, pose in (("before", gap.before), ("after", gap.after)) if pose is not None]
    if not blended:
        return "the network"
    return f"the network, blended over 1 s with the known pose {' and '.join(blended)}"


def _lost_notes(side: Side, track: HandTrack, frames: slice) -> list[str]:
    n_lost = int((~track.valid[frames]).sum())
    note = f"the {side} hand is not tracked in {n_lost} of the {frames.stop - frames.start} frames; "
    return [note + "there its wrist has the pose of the nearest tracked frame"] if n_lost else []


def _predict_all(
    predictor: Predictor, hands: Mapping[Side, TrackedHand], tracked: Control, control: Control
) -> dict[Side, np.ndarray]:
    gap = Gap(0, len(control.object_motion.time_s), None, None)
    return {side: predict_fingers(predictor, hand, side, control, gap) for side, hand in hands.items()}


def _stream_fingers(
    predictor: Predictor,
    hands: Mapping[Side, TrackedHand],
    tracked: Control,
    control: Control,
    show: ShowPoses,
    in_real_time: bool,
) -> dict[Side, np.ndarray]:
    frames = tracked_frames(tracked)
    models: dict[Side, ObjectModel] = {side: control.of(side).model for side in SIDES}
    _, poses, _ = _played(predictor, hands, models, _at_recorded_speed(frames) if in_real_time else frames, show)
    return _poses_of_frames(poses, predictor, hands, len(control.object_motion.time_s))


def _played(
    predictor: Predictor,
    hands: Mapping[Side, TrackedHand],
    models: dict[Side, ObjectModel],
    frames: Iterable[TrackedFrame],
    show: ShowPoses,
) -> tuple[list[TrackedFrame], list[dict[Side, np.ndarray]], int]:
    """Push frames through a stream; return those used, with times of its clock, all poses, and the number dropped."""
    start: dict[Side, np.ndarray] = {side: hand.rest_rotmats for side, hand in hands.items()}
    stream = Stream(predictor, hands, models, start)
    accepted, shown = list[TrackedFrame](), list[dict[Side, np.ndarray]]()

    def show_all(poses: list[dict[Side, np.ndarray]]) -> None:
        for pose in poses:
            show(stream.first_s + len(shown) * predictor.settings.step_s, pose)
            shown.append(pose)

    for frame in frames:
        before_s = stream.last_s
        show_all(stream.push(frame))
        if stream.last_s > before_s:
            accepted.append(replace(frame, time_s=stream.last_s))
        if len(accepted) == MAX_FRAMES:
            break
    show_all(stream.finish())
    return accepted, shown, stream.dropped


def _at_recorded_speed(frames: Iterable[TrackedFrame]) -> Iterator[TrackedFrame]:
    """Yield each frame at its time after the first."""
    offset_s = None
    for frame in frames:
        offset_s = time.monotonic() - frame.time_s if offset_s is None else offset_s
        time.sleep(max(frame.time_s + offset_s - time.monotonic(), 0))
        yield frame


def _poses_of_frames(
    poses: list[dict[Side, np.ndarray]], predictor: Predictor, hands: Mapping[Side, TrackedHand], n_frames: int
) -> dict[Side, np.ndarray]:
    """The poses (frame, 15, 3, 3) of each hand at 30 fps."""
    numbers = np.round(np.arange(n_frames) / FPS / predictor.settings.step_s).astype(int).clip(0, len(poses) - 1)
    return {side: np.stack([poses[number][side] for number in numbers]) for side in hands}


def _from_tracker(
    source: str, options: AnimationOptions, project: ProjectData, show: ShowPoses, report: Callable[[str], None]
) -> Animation:
    """Animate a tracker's frames until they end; a hand is invalid while its wrist is lost."""
    options.check_for_tracker()
    address = parse_address(source)
    network = chosen_network(options, project)
    models, notes = _objects(options, options.mesh.unit, project)
    (templates_m, user_hands), predictor = _user_hands(options, project), network.predictor
    hands: dict[Side, TrackedHand] = {side: user_hands[side] for side in options.sides}
    tracker = Tracker(address, models["right"].is_articulated, report, bool(options.left_object))
    received = tracker.frames()
    if options.calibration:
        recording = read_trajectories(Path(options.calibration))
        offsets, offset_notes = offsets_of(recording, user_hands, options.sides)
        notes += offset_notes
        received = (calibrated_frame(frame, offsets) for frame in received)
    frames, poses, dropped = _played(predictor, hands, models, received, show)
    notes.append(
        f"{tracker.refused} of {tracker.received} datagrams were refused; {dropped} frames were skipped, whose time in "
        "seconds was repeated, late, or not followed by another one within half a second"
    )
    control, valid = control_of_frames(frames, models["right"])
    if control and options.left_object:
        left, _ = control_of_frames(frames, models["left"], "left")
        control = left and replace(control, left=left)
    if control is None or len(frames) < MIN_FRAMES or not valid[[side in hands for side in SIDES]].any():
        expected, got = f"poses of object and wrist in {MIN_FRAMES} frames", f"{len(frames)} frames; {notes[-1]}"
        raise BadInput(source, expected, got, "send them (docs/fingers.md)")
    fingers = _poses_of_frames(poses, predictor, hands, valid.shape[1])
    clip = clip_of(control, fingers, templates_m, UPS[options.up], "live", network.is_synthetic)
    generated = valid & np.array([[side in hands] for side in SIDES])
    rows = [*network.rows, _objects_row(models), ("source", source)]
    clip, first_s = _valid_where(clip, generated), frames[0].time_s
    return Animation(clip, generated, {}, project.hands, rows, notes, network.facts, first_s=first_s)


def _from_file(
    path: Path, options: AnimationOptions, project: ProjectData, predict: PredictFingers = _predict_all
) -> Animation:
    options.check_for_file()
    trajectories = read_trajectories(path, options.unit, options.axes)
    network = chosen_network(options, project)
    models, notes = _objects(options, options.mesh.unit or trajectories.mesh_unit, project)
    if bool(options.left_object) != (trajectories.left_object is not None):
        got = "only one of them"
        raise BadInput("--left-object", "a mesh and left_object columns, or neither", got, "add the other, or omit it")
    templates_m, user_hands = _user_hands(options, project)
    if options.calibration:
        recording = read_trajectories(Path(options.calibration), options.unit)
        offsets, offset_notes = offsets_of(recording, user_hands, set(options.sides) & set(trajectories.wrists))
        notes += offset_notes
        trajectories = calibrated_file(trajectories, offsets)
    if options.left_object:
        checked = control_of_two_objects(trajectories, models, user_hands)
    else:
        checked = control_from_file(trajectories, models["right"], user_hands)
    notes += [*checked.notes, *_skipped_hand_notes(trajectories, checked, options.sides)]
    control = at_rate(checked.control, options.fps)
    n_frames = len(control.object_motion.time_s)
    generated = np.zeros((2, n_frames), bool)
    animated: dict[Side, TrackedHand] = {side: user_hands[side] for side in checked.active if side in options.sides}
    fingers: dict[Side, np.ndarray] = {
        side: np.tile(user_hands[side].rest_rotmats, (n_frames, 1, 1, 1)) for side in trajectories.wrists
    }
    fingers |= predict(network.predictor, animated, checked.control, control)
    generated[[SIDES.index(side) for side in animated]] = True
    up = trajectories.up or UPS[options.up]
    clip = clip_of(control, fingers, templates_m, up, path.stem, network.is_synthetic)
    time_s = control.object_motion.time_s
    tracked = np.stack([checked.control.wrists[side].covers(time_s) for side in SIDES])
    clip, generated = _valid_where(clip, tracked), generated & tracked
    rows, first_s = [*network.rows, _objects_row(models)], float(time_s[0])
    return Animation(clip, generated, {}, project.hands, rows, notes, network.facts, fps=options.fps, first_s=first_s)


def _valid_where(clip: Clip, tracked: np.ndarray) -> Clip:
    """The clip whose hands are invalid in frames in which they are not tracked; tracked: (2, frame) bool."""
    hands = {
        side: replace(clip.hands[side], valid=clip.hands[side].valid & frames)
        for side, frames in zip(SIDES, tracked, strict=True)
    }
    return replace(clip, hands=hands)


def _user_hands(
    options: AnimationOptions, project: ProjectData
) -> tuple[np.ndarray | None, Mapping[Side, TrackedHand]]:
    """Rest meshes (2, 778, 3) of hands of the user's length, None for the mean length; and both hands."""
    length_cm = options.hand_length_cm
    templates_m = None if length_cm is None else project.hands.templates_of_length(length_cm / 100)
    return templates_m, mano_hands(project.hands, templates_m=templates_m)


def _skipped_hand_notes(trajectories: TrajectoryFile, given: AnimationInput, sides: tuple[Side, ...]) -> list[str]:
    """A note per hand near the object that was not requested. Raises BadInput if no requested hand is near it."""
    if not set(given.active) & set(sides):
        present = f"{trajectories.source} has {' and '.join(trajectories.wrists)}"
        remedy = f"name another: {present}, near the object {' and '.join(given.active)}"
        raise BadInput("--fingers", "a hand that is in the file and near the object", sides[0], remedy)
    skipped = [side for side in given.active if side not in sides]
    return [f"the {side} hand was not requested (--fingers) and keeps its neutral pose" for side in skipped]


def _objects(options: AnimationOptions, unit: str, project: ProjectData) -> tuple[dict[Side, ObjectModel], list[str]]:
    """The object of each hand, by default one for both; and notes for the user."""
    of_object = replace(options.mesh, unit="") if is_object_path(options.left_object) else options.mesh
    if not is_object_path(options.object):  # a dataset's object has a scale, but no other of these options
        replace(of_object, scale=1.0).check_for(options.object)
    model, notes = _object(options, unit, project)
    if not options.left_object:
        return dict.fromkeys(SIDES, model), notes
    mesh = replace(options.mesh, hinge="", moving="")
    left, left_notes = _object(replace(options, object=options.left_object, mesh=mesh), unit, project)
    if left.is_articulated:
        raise BadInput("--left-object", "a rigid object", "one with a joint", "swap the hands, or join its parts")
    return {"left": left, "right": model}, notes + left_notes


def _objects_row(models: Mapping[Side, ObjectModel]) -> tuple[str, str]:
    return "object", ", ".join(dict.fromkeys(models[side].name for side in ("right", "left")))


def _object(options: AnimationOptions, unit: str, project: ProjectData) -> tuple[ObjectModel, list[str]]:
    """A mesh file in its stored axes, or an object of the dataset; and notes for the user."""
    if is_object_path(options.object):
        # The trajectories give the mesh's orientation, so the mesh is not rotated upright.
        user = read_user_object(Path(options.object), *astuple(replace(options.mesh, unit=unit, up="z")))
        return user.model, list(user.notes)
    if not options.object:
        raise BadInput("--object", "the mesh of the object (.obj, .ply, .stl, .glb)", "none", "name it")
    paths = StagePaths(project.profile, options.model or project.datasets[0])
    return stored_object(options.object, paths.clips, project.hands).scaled(options.mesh.scale), []


def chosen_network(options: AnimationOptions, project: ProjectData) -> Network:
    """The trained network of the requested dataset, or of the first dataset that has one."""
    paths, facts = trained_run("manipnet", [MANIPNET.name], options.model, project)
    checkpoint = load_checkpoint(paths.checkpoints / MANIPNET.name, MANIPNET, torch.device("cpu"))
    assert isinstance(checkpoint.network, ManipNet)
    predictor = Predictor(checkpoint.network, options.rule)
    rows = [("network", str(paths)), ("trained on", trained_on(facts)), ("post-processing", predictor.chosen_rule)]
    return Network(predictor, rows, facts)


def _frames(text: str, n_frames: int) -> slice:
    """Frames 30 to 89 for "30:90"; all frames for ""."""
    first, colon, last = text.partition(":")
    try:
        start, stop = int(first or 0), int(last or n_frames)
        if (text and not colon) or not 0 <= start < stop <= n_frames:
            raise ValueError
    except ValueError as error:
        raise BadInput("--frames", f"FIRST:STOP within 0:{n_frames}", text, "like 30:90") from error
    return slice(start, stop)
