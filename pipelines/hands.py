"""`hoidata hands`: hand motions for an object motion from keyframes, a clip or a generated motion (BimArt)."""

from dataclasses import astuple, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from hoidata.clips.clip import FPS, HandType, ObjectTrack
from hoidata.clips.features import upright
from hoidata.errors import BadInput
from hoidata.files import sha256_file
from hoidata.files.numpy_files import load_npz_arrays
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.metrics.unmeasured import Unmeasured
from hoidata.metrics.verdict import UNKNOWN_UP, fewest_failed, verdict, verdict_lines
from hoidata.object_paths import keyframed_path, read_keyframes
from hoidata.object_paths.path import (
    MAX_S,
    PathStep,
    check_joint_kind,
    check_joint_range,
    check_pace,
    joint_range_words,
)
from hoidata.objects.model import ObjectModel
from hoidata.objects.user_mesh import is_object_path, read_user_object, unknown_object_words
from hoidata.store.annotated import load_annotated
from hoidata.store.store import Store, open_store, stored_hinge
from models.bimart.family import BIMART, BimArtSampler
from models.bimart.hands import HandSamplingOptions, SampledHands, hands_for
from models.common.checkpoints import FILE_NAME, read_info
from models.common.family import Sources
from models.common.repeatable import make_repeatable
from pipelines.command_inputs import (
    MeshOptions,
    ProjectData,
    WrittenFiles,
    check_dataset,
    check_new_store,
    mesh_notes,
    nearest_name,
    trained_on,
    trained_run,
    write_motion_store,
)
from pipelines.exports.motion import verbs_of
from pipelines.pages.hands_page import write_hands
from pipelines.pages.motion_files import hand_shapes, older_motion_notes
from pipelines.show_pages import dataset_of_clip
from pipelines.stages.base import StagePaths, empty_reason, load_hands

MIN_LENGTH_S = 0.3
NEAR_M, MOVING_RAD, MAX_UNTOUCHED = 0.02, 0.002, 0.5  # a joint that moves by itself is reported
MAX_FRAMES = round(MAX_S * FPS) + 1
MAX_CLIPS_FOR_RANGE = 60  # recorded clips of an object from which its range of hinge angles is read
GENERATED_ARRAYS = ("object_rotvec", "object_translation_m", "object_vertices_m", "object_faces", "object_part")


@dataclass(frozen=True)
class HandsOptions:
    """The options of ``hoidata hands``. Exactly one of ``keyframes``, ``clip`` and ``motion`` is set."""

    object: str = ""  # a mesh file, or the name of an object of a dataset
    keyframes: str = ""  # a CSV or JSON file
    clip: str = ""  # the id of a stored clip
    motion: str = ""  # a motion.npz of ``hoidata generate``
    mesh: MeshOptions = field(default_factory=MeshOptions)
    hinge_range: str = ""  # degrees, such as "0:110"
    hand: HandType = "both"
    samples: int = 1
    keep: int | None = None  # samples to keep, by the verdict; None: all
    seed: int = 0
    length_s: float | None = None  # None keeps the source's duration
    model: str = ""  # the dataset whose networks to use; "" for the first that has them


class ObjectMotion(NamedTuple):
    """An object motion for which to generate hands."""

    track: ObjectTrack
    wish: HandSamplingOptions
    source: str  # in words
    notes: list[str]
    steps: tuple[PathStep, ...] = ()  # of a path from keyframes
    up: np.ndarray | Unmeasured = UNKNOWN_UP  # (3,) direction of the object that is up when it stands, object frame
    verb: str | None = None  # of a stored clip


def hands_files(
    options: HandsOptions, profile: str, datasets: tuple[str, ...], out: Path, store: Path | None = None
) -> WrittenFiles:
    """Generate hands; write arrays, an animated GLB per sample and a page with a player into ``out``.

    With ``store``, the motions also become a store of clips; those for a stored clip are named <clip>~<sample>.
    Raises MissingResource for missing networks or files, BadInput for an unusable object, motion or option.
    """
    make_repeatable(threads=1)
    check_new_store(store)
    project = ProjectData(profile, datasets, load_hands(profile))
    motion = object_motion(options, project)
    paths, sampler = chosen_networks(options.model, project)
    samples = hands_for(sampler, motion.track, motion.wish)
    files = [paths.checkpoints / name / FILE_NAME for name in BIMART.uses]
    digests = {str(path): sha256_file(path) for path in files}
    networks = read_info(paths.checkpoints / BIMART.uses[-1] / FILE_NAME)["facts"]
    training_data = f"{paths.checkpoints} (trained on {trained_on(networks)})"
    facts = [("object's motion", motion.source), ("networks", training_data)]
    checks = [verdict(sample.clip, project.hands, motion.up) for sample in samples]
    chosen_samples = fewest_failed(checks, options.keep)
    samples, checks = [samples[number] for number in chosen_samples], [checks[number] for number in chosen_samples]
    notes = [*motion.notes, *_notes(samples)]
    written = write_hands(out, samples, project.hands, motion.steps, digests, facts, checks, notes)
    clips, info = [sample.clip for sample in samples], dict[str, Any]()
    if options.clip:
        info = open_store(dataset_of_clip(options.clip, profile, list(datasets)).clips, project.hands).info
        names = {"dataset": info["dataset"], "verb": motion.verb}
        clips = [replace(clip, clip_id=f"{options.clip}~{number}", **names) for number, clip in enumerate(clips)]
    written = [*written, *write_motion_store(store, clips, project.hands, networks, **info)]
    notes = [*notes, *older_motion_notes(out, written)]
    lines = [verdict_lines(sample.number, one) for sample, one in zip(samples, checks, strict=True)]
    return WrittenFiles(written, notes, list(chain.from_iterable(lines)))


def object_motion(options: HandsOptions, project: ProjectData) -> ObjectMotion:
    """The object motion that the options select. Raises BadInput if they select none, or one that is too long."""
    check_dataset(options.model, project)
    sources = [name for name in ("keyframes", "clip", "motion") if getattr(options, name)]
    options.mesh.check_for(options.object)
    if len(sources) != 1:
        got = " and ".join(f"--{name}" for name in sources) or "none"
        raise BadInput("object's motion", "one of --keyframes, --clip or --motion", got, "give one of them")
    if options.keep is not None and options.keep > options.samples:
        remedy = "raise --samples or lower --keep"
        raise BadInput("--keep", f"at most --samples {options.samples}", f"{options.keep}", remedy)
    select = {"keyframes": _keyframed_motion, "clip": _clip_motion, "motion": _generated_motion}[sources[0]]
    motion = select(options, project, HandSamplingOptions(options.seed, options.samples, options.hand))
    if options.length_s is not None:
        motion = _retimed(motion, options.length_s)
    if motion.track.n_frames > MAX_FRAMES:
        got = f"{(motion.track.n_frames - 1) / FPS:g} s"
        raise BadInput("object's motion", f"at most {MAX_S:g} s", got, "split it in two, or set a --length")
    if options.hinge_range and not motion.track.model.is_articulated:
        note = "the object is rigid, so --hinge-range has no effect; --hinge sets the axis of a hinge"
        motion = motion._replace(notes=[*motion.notes, note])
    return motion


def chosen_networks(model: str, project: ProjectData) -> tuple[StagePaths, BimArtSampler]:
    """The networks of the requested dataset, or of the first that has them. Raises MissingResource if none has."""
    paths, _ = trained_run("bimart", BIMART.uses, model, project)
    annotated = load_annotated(paths.data, project.hands)
    sources = Sources(annotated, paths.checkpoints, project.hands, torch.device("cpu"))
    return paths, BimArtSampler.load(sources)


def _notes(samples: list[SampledHands]) -> list[str]:
    """Notes on the mesh (open, repaired), and on a moving part that no hand is near."""
    notes = mesh_notes(samples[0].clip.object.model)
    for sample in samples:
        if (untouched := _untouched_fraction(sample)) > MAX_UNTOUCHED:
            percent = f"{untouched:.0%} of the frames in which its joint moves"
            notes.append(f"sample {sample.number + 1}: no hand is within 2 cm of the moving part in {percent}")
    return notes


def _untouched_fraction(sample: SampledHands) -> float:
    """Of the frames with a moving joint, the fraction in which no hand is near the moving part; 0 if it rests."""
    angle_rad = sample.clip.object.joint_angle_rad
    if angle_rad is None or not (moves := np.abs(np.diff(angle_rad, prepend=angle_rad[:1])) > MOVING_RAD).any():
        return 0.0
    nearest_m = sample.reached_m[:, moves][..., sample.points.part == 1].min(axis=(0, 2), initial=np.inf)
    return float((nearest_m > NEAR_M).mean())


class _MovableObject(NamedTuple):
    """An object that keyframes move."""

    model: ObjectModel
    hinge_limits_rad: tuple[float, float] | None  # lowest and highest joint position
    rest_rotation: np.ndarray | None  # (3, 3) world_from_object as it stands on the table; None: as its mesh is stored
    notes: list[str]


def _object(options: HandsOptions, project: ProjectData) -> _MovableObject:
    if not options.object:
        raise BadInput("object", "a mesh file (.obj, .ply, .stl, .glb) or a dataset's object", "none", "name it first")
    if is_object_path(options.object):
        mesh = options.mesh
        user = read_user_object(Path(options.object), *astuple(mesh))
        notes, limits = list(user.notes), hinge_range(options.hinge_range, user.model) or user.joint_limits
        if user.model.is_articulated and limits is None:
            notes.append("the range of the joint is not known; --hinge-range 0:110 has it checked")
        return _MovableObject(user.model, limits, None, notes)
    names = (options.model,) if options.model else project.datasets
    folders = [StagePaths(project.profile, name).clips for name in names]
    converted = [folder for folder in folders if not empty_reason(folder) and (folder / "meta").is_dir()]
    stores = [open_store(folder, project.hands) for folder in converted]
    for store in stores:
        if options.object in list(store.objects["object"]):
            limits = hinge_range(options.hinge_range, store.object_model(options.object))
            return _recorded_object(store, options.object, limits)
    names = sorted({name for store in stores for name in store.objects["object"]})
    expected = "a mesh file (.obj, .ply, .stl, .glb)" + (f" or one of: {', '.join(names)}" if names else "")
    remedy = nearest_name(options.object, names) or ("correct the name or path" if names else "correct the path")
    raise BadInput("object", expected, unknown_object_words(options.object), remedy)


def _recorded_object(store: Store, name: str, limits_rad: tuple[float, float] | None) -> _MovableObject:
    """An object of a dataset, at rest as in the first frame of its first clip, with the recorded range of its hinge."""
    clip_ids = store.sequences.index[store.sequences["object"].to_numpy() == name]
    clips, notes = [store.clip(clip_id) for clip_id in clip_ids[:MAX_CLIPS_FOR_RANGE]], list[str]()
    first = clips[0]
    rest_rotation = upright(first.gravity) @ rotvec_to_rotmat(first.object.rotvec[0].astype(np.float64))
    angles = [clip.object.hinge_rad for clip in clips if clip.object.hinge_rad is not None]
    if angles and limits_rad is None:
        low, high = min(0.0, *(float(a.min()) for a in angles)), max(0.0, *(float(a.max()) for a in angles))
        hinge = store.object_model(name).hinge
        slides = hinge is not None and hinge.is_prismatic
        notes.append(f"recorded with its joint at {joint_range_words((low, high), slides)}")
        # Recordings show the direction in which a hinge opens, but not its stop, so half a turn is allowed.
        if not slides:
            limits_rad = (-np.pi, high) if -low > high else (low, np.pi)
    return _MovableObject(store.object_model(name), limits_rad, rest_rotation, notes)


def hinge_range(text: str, model: ObjectModel) -> tuple[float, float] | None:
    """The lowest and highest joint position of a text, in degrees or of a slide in cm, such as "0:110"; None for ""."""
    if not text:
        return None
    slides = model.hinge is not None and model.hinge.is_prismatic
    try:
        low, high = (float(word) for word in text.split(":"))
        if not -360 <= low <= 0 <= high <= 360 or low == high:
            raise ValueError
    except ValueError as error:
        remedy = "write e.g. 0:110; 0 is the joint position of the mesh as stored"
        expected = f"two {'slides in cm' if slides else 'angles in degrees'} that include 0"
        raise BadInput("--hinge-range", expected, text[:40], remedy) from error
    unit = 0.01 if slides else float(np.radians(1.0))
    return low * unit, high * unit


def _keyframed_motion(options: HandsOptions, project: ProjectData, wish: HandSamplingOptions) -> ObjectMotion:
    movable = _object(options, project)
    keys = read_keyframes(options.keyframes)
    path = keyframed_path(movable.model, keys, movable.hinge_limits_rad, options.keyframes, movable.rest_rotation)
    source = f"keyframes of {Path(options.keyframes).name}"
    up = np.array([0.0, 0.0, 1.0]) if movable.rest_rotation is None else movable.rest_rotation[2]
    return ObjectMotion(path.track, wish, source, movable.notes, path.steps, up)


def _clip_motion(options: HandsOptions, project: ProjectData, wish: HandSamplingOptions) -> ObjectMotion:
    """The object motion of a stored clip, with the hand shapes of its subject."""
    if options.object:
        raise BadInput("object", "no object with --clip, which has one", options.object, "omit it")
    paths = dataset_of_clip(options.clip, project.profile, list(project.datasets))
    store = open_store(paths.clips, project.hands)
    clip = store.clip(options.clip)
    track, limits_rad = clip.object, hinge_range(options.hinge_range, clip.object.model)
    check_joint_range(track.model, track.hinge_rad, limits_rad, options.clip)
    betas, template_m = hand_shapes(clip)
    notes = [] if clip.gravity is not None else ["up: z, assumed: the gravity of this clip is not known"]
    gravity = wish.gravity if clip.gravity is None else np.asarray(clip.gravity, np.float64)
    wish = replace(wish, words=clip.object_words, gravity=gravity, betas=betas, template_m=template_m)
    return ObjectMotion(clip.object, wish, f"clip {options.clip}", notes, verb=verbs_of(store).get(options.clip))


def _generated_motion(options: HandsOptions, project: ProjectData, wish: HandSamplingOptions) -> ObjectMotion:
    """The object motion in a motion.npz of ``hoidata generate``, with its mesh or with the object of the options."""
    path = Path(options.motion)
    if not path.is_file():
        raise BadInput(path, "a motion.npz of `hoidata generate`", "no such file", "correct the path")
    arrays = load_npz_arrays(path)
    missing = [name for name in GENERATED_ARRAYS if name not in arrays]
    if missing:
        raise BadInput(path, "a motion.npz of `hoidata generate`", f"no {missing[0]}", "give one, or --keyframes")
    model, limits, _, notes = (
        _object(options, project) if options.object else _MovableObject(_mesh_of(arrays, path), None, None, [])
    )
    if not is_object_path(options.object):  # a generated motion may leave the range of the recordings
        limits = hinge_range(options.hinge_range, model)
    hinge_rad = arrays.get("object_hinge_rad")
    if model.is_articulated != (hinge_rad is not None):
        remedy = "give the same object as `hoidata generate` had, with its hinge"
        raise BadInput(path, "an object with a hinge if the motion has one", model.name, remedy)
    if "object_hinge_axis" in arrays:  # files of older releases do not say whether the joint slides
        check_joint_kind(model, "object_hinge_origin_m" not in arrays, path)
    track = ObjectTrack(model, arrays["object_rotvec"], arrays["object_translation_m"], hinge_rad)
    _check_track(track, path)
    check_joint_range(model, hinge_rad, limits, path)
    gravity = arrays.get("gravity", np.zeros(0))
    wish = replace(wish, gravity=np.asarray(gravity, np.float64) if gravity.shape == (3,) else wish.gravity)
    return ObjectMotion(track, wish, f"generated for {str(arrays.get('text', path.name))!r}", notes)


def _mesh_of(arrays: dict[str, np.ndarray], path: Path) -> ObjectModel:
    hinge = None
    if "object_hinge_rad" in arrays:
        if "object_hinge_axis" not in arrays:
            raise BadInput(path, "an object_hinge_axis", "none", "name the object too, or generate the motion again")
        hinge = stored_hinge(arrays["object_hinge_axis"], arrays.get("object_hinge_origin_m"))
    vertices, faces, part = (arrays[f"object_{name}"] for name in ("vertices_m", "faces", "part"))
    fits = vertices.shape == (len(part), 3) and faces.ndim == 2 and faces.shape[1] == 3 and faces.dtype.kind in "iu"
    if not fits or not len(faces) or not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices):
        raise BadInput(path, "a mesh", f"{vertices.shape}, {faces.shape}", "generate the motion again")
    return ObjectModel("object", vertices.astype(np.float64), faces.astype(np.int64), part, hinge)


def _check_track(track: ObjectTrack, path: Path) -> None:
    count, arrays = len(track.translation_m), [track.rotvec, track.translation_m]
    arrays += [] if track.hinge_rad is None else [track.hinge_rad]
    shapes = [array.shape for array in arrays]
    is_finite = all(array.dtype.kind == "f" and np.isfinite(array).all() for array in arrays)
    if not is_finite or shapes != [(count, 3), (count, 3), (count,)][: len(arrays)]:
        raise BadInput(path, "finite poses of all frames", f"{shapes}", "generate the motion again")


def _retimed(motion: ObjectMotion, length_s: float) -> ObjectMotion:
    """The same trajectory with another duration. Raises BadInput for one out of range, or too short for the motion."""
    track = motion.track
    if not MIN_LENGTH_S <= length_s <= MAX_S:
        expected = f"{MIN_LENGTH_S:g} to {MAX_S:g} s"
        raise BadInput("--length", expected, f"{length_s:g} s", "set another length")
    if track.n_frames < 2:
        raise BadInput("--length", "a motion of two frames or more", "one frame", "omit the option")
    n_frames = round(length_s * FPS) + 1
    stretch = (n_frames - 1) / (track.n_frames - 1)
    if stretch < 1:
        check_pace(track, stretch, "--length")
    old, new = np.arange(track.n_frames), np.linspace(0, track.n_frames - 1, n_frames)
    rotvec = Slerp(old, Rotation.from_rotvec(track.rotvec))(new).as_rotvec().astype(np.float32)
    translation_m = CubicSpline(old, track.translation_m)(new).astype(np.float32)
    hinge_rad = None if track.hinge_rad is None else CubicSpline(old, track.hinge_rad)(new).astype(np.float32)
    steps = tuple(PathStep(step.words, step.start_s * stretch, step.end_s * stretch) for step in motion.steps)
    retimed = ObjectTrack(track.model, rotvec, translation_m, hinge_rad)
    return motion._replace(track=retimed, steps=steps, source=f"{motion.source}, in {length_s:g} s")
