"""Hands for a motion of an object that a person made up, or that a clip or a generated motion has, as files."""

from dataclasses import dataclass, field, replace
from os.path import isfile  # of a name that is too long it says no, where a Path raises
from pathlib import Path
from typing import NamedTuple

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
from hoidata.hands import HandPair
from hoidata.object_paths import keyframed_path, read_keyframes
from hoidata.object_paths.path import MAX_S, PathStep, check_pace
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.objects.user_mesh import read_user_object
from hoidata.store.annotated import load_annotated
from hoidata.store.store import Store, open_store
from models.bimart.family import BIMART, HandsForPaths
from models.bimart.hands import MadeHands, MotionWish, hands_for
from models.common.checkpoints import FILE_NAME, read_info
from models.common.family import Sources
from models.common.repeatable import make_repeatable
from pipelines.command_inputs import (
    MeshWish,
    Written,
    check_dataset,
    mesh_notes,
    nearest_name,
    trained_on,
    trained_run,
)
from pipelines.pages.hands_page import write_hands
from pipelines.pages.motion_files import hand_shapes
from pipelines.showing import find_clip
from pipelines.stages.base import StagePaths, empty_reason, load_hands

LEAST_S = 0.3
MOST_FRAMES = round(MAX_S * FPS) + 1
CLIPS_FOR_RANGE = 60  # of an object, whose hinge angles say how far it opens
GENERATED = ("object_rotvec", "object_translation_m", "object_vertices_m", "object_faces", "object_part")


@dataclass(frozen=True)
class HandsWish:
    """What ``hoidata hands`` is told; "" for what is not.

    object: a mesh file, or the name of a dataset's object. keyframes: a file; clip: a stored clip's id; motion: a
    motion.npz of ``hoidata generate``. One of these three. hinge_range: "0:110",
    degrees. length_s: how long the motion is to last instead of its own time. model: the dataset whose networks to use.
    """

    object: str = ""
    keyframes: str = ""
    clip: str = ""
    motion: str = ""
    mesh: MeshWish = field(default_factory=MeshWish)
    hinge_range: str = ""
    hand: HandType = "both"
    samples: int = 1
    seed: int = 0
    length_s: float | None = None
    model: str = ""


class Asked(NamedTuple):
    """thing: the motion. steps: what happens when, of a path. source: where it is from, in words."""

    thing: ObjectTrack
    wish: MotionWish
    steps: tuple[PathStep, ...]
    source: str
    notes: list[str]


def hands_files(wish: HandsWish, profile: str, datasets: tuple[str, ...], out: Path) -> Written:
    """Make hands, and write arrays, an animated GLB each and a page that plays them into ``out``.

    Raises MissingResource or BadInput that says what is not there or cannot be meant, and what to do.
    """
    make_repeatable(threads=1)
    hands = load_hands(profile)
    asked = asked_motion(wish, profile, datasets, hands)
    paths, sampler = chosen_networks(wish.model, profile, datasets, hands)
    motions = hands_for(sampler, asked.thing, asked.wish)
    used = [paths.checkpoints / name / FILE_NAME for name in BIMART.uses]
    made_from = {str(path): sha256_file(path) for path in used}
    learned = trained_on(read_info(paths.checkpoints / BIMART.uses[-1] / FILE_NAME)["facts"])
    facts = [("object's motion", asked.source), ("networks", f"{paths.checkpoints} (learnt from {learned})")]
    notes = [*asked.notes, *_notes(motions)]
    return Written(write_hands(out, motions, hands, asked.steps, made_from, facts, notes), notes)


def asked_motion(wish: HandsWish, profile: str, datasets: tuple[str, ...], hands: HandPair) -> Asked:
    """The motion of the object that hands are asked for."""
    check_dataset(wish.model, profile, datasets)
    given = {name: value for name in ("keyframes", "clip", "motion") if (value := getattr(wish, name))}
    if len(given) != 1:
        got = " and ".join(f"--{name}" for name in given) or "none"
        raise BadInput("object's motion", "one of --keyframes, --clip or --motion", got, "give one of them")
    own = MotionWish(wish.seed, wish.samples, wish.hand)
    if wish.clip:
        asked = _of_clip(wish, profile, datasets, hands, own)
    elif wish.motion:
        asked = _of_generated(wish, profile, datasets, hands, own)
    else:
        asked = _of_path(wish, profile, datasets, hands, own)
    if wish.length_s is not None:
        asked = _lasting(asked, wish.length_s)
    if asked.thing.n_frames > MOST_FRAMES:
        got = f"{(asked.thing.n_frames - 1) / FPS:g} s"
        raise BadInput("object's motion", f"at most {MAX_S:g} s", got, "make two of it, or tell a --length")
    if wish.hinge_range and not asked.thing.model.is_articulated:
        note = "the object is rigid, so --hinge-range is not looked at; --hinge tells where it turns"
        asked = asked._replace(notes=[*asked.notes, note])
    return asked


def chosen_networks(
    model: str, profile: str, datasets: tuple[str, ...], hands: HandPair
) -> tuple[StagePaths, HandsForPaths]:
    """The networks of the dataset asked for, or of the first that has them. Raises MissingResource where none has."""
    paths, _ = trained_run("bimart", BIMART.uses, model, profile, datasets, hands)
    sources = Sources(load_annotated(paths.data, hands), paths.checkpoints, hands, torch.device("cpu"))
    return paths, HandsForPaths.load(sources)


def _notes(motions: list[MadeHands]) -> list[str]:
    """What a person should know of the motions: an open or repaired mesh, a hand that never touches."""
    notes = mesh_notes(motions[0].clip.object.model)
    for motion in motions:
        idle = [side for side, touching in motion.standing.touching.items() if not touching.any()]
        if idle:
            notes.append(f"sample {motion.number + 1}: the {' and the '.join(idle)} hand touches nothing")
    return notes


class _Thing(NamedTuple):
    """An object to be moved. limits_rad: the stops of its hinge. standing: see ``checked_path``. notes: what was
    assumed."""

    model: ObjectModel
    limits_rad: tuple[float, float] | None
    standing: np.ndarray | None
    notes: list[str]


def _object(wish: HandsWish, profile: str, datasets: tuple[str, ...], hands: HandPair) -> _Thing:
    if not wish.object:
        raise BadInput("object", "a mesh file (.obj, .ply, .stl, .glb) or a dataset's object", "none", "name it first")
    limits = hinge_range(wish.hinge_range) if wish.hinge_range else None
    if isfile(wish.object):
        user = read_user_object(Path(wish.object), wish.mesh.unit, wish.mesh.up, wish.mesh.hinge)
        notes = list(user.notes)
        if user.model.is_articulated and limits is None:
            notes.append("how far the hinge opens is not known; --hinge-range 0:110 has it checked")
        return _Thing(user.model, limits, None, notes)
    stores = _converted((wish.model,) if wish.model else datasets, profile, hands)
    for store in stores:
        if wish.object in list(store.objects["object"]):
            return _recorded(store, wish.object, limits)
    names = sorted({name for store in stores for name in store.objects["object"]})
    expected = "a mesh file (.obj, .ply, .stl, .glb)" + (f" or one of: {', '.join(names)}" if names else "")
    remedy = nearest_name(wish.object, names) or ("correct the name or path" if names else "correct the path")
    raise BadInput("object", expected, wish.object, remedy)


def _converted(names: tuple[str, ...], profile: str, hands: HandPair) -> list[Store]:
    """The stores of the datasets that are converted."""
    folders = [StagePaths(profile, name).clips for name in names]
    return [open_store(own, hands) for own in folders if not empty_reason(own) and (own / "meta").is_dir()]


def _recorded(store: Store, name: str, limits: tuple[float, float] | None) -> _Thing:
    """An object of a dataset: it stands as in the first frame of its first clip, and opens to the side it did there."""
    rows = [clip_id for clip_id, own in zip(store.ids, store.sequences["object"], strict=True) if own == name]
    clips, notes = [store.clip(clip_id) for clip_id in rows[:CLIPS_FOR_RANGE]], list[str]()
    first = clips[0]
    standing = upright(first.gravity) @ rotvec_to_rotmat(first.object.rotvec[0].astype(np.float64))
    angles = [clip.object.hinge_rad for clip in clips if clip.object.hinge_rad is not None]
    if angles and limits is None:
        low, high = min(0.0, *(float(a.min()) for a in angles)), max(0.0, *(float(a.max()) for a in angles))
        notes.append(f"recorded with its hinge at {np.degrees(low):.0f} to {np.degrees(high):.0f} deg")
        # Recordings say to which side it opens, not how far it could.
        limits = (-np.pi, high) if -low > high else (low, np.pi)
    return _Thing(store.object_model(name), limits, standing, notes)


def hinge_range(text: str) -> tuple[float, float]:
    """ "0:110", degrees, as radians."""
    try:
        low, high = (float(word) for word in text.split(":"))
        if not -360 <= low <= 0 <= high <= 360 or low == high:
            raise ValueError
    except ValueError as error:
        remedy = "write e.g. 0:110; 0 is the hinge as the mesh is drawn"
        raise BadInput("--hinge-range", "two angles in degrees, with 0 among them", text[:40], remedy) from error
    return float(np.radians(low)), float(np.radians(high))


def _of_path(wish: HandsWish, profile: str, datasets: tuple[str, ...], hands: HandPair, own: MotionWish) -> Asked:
    thing = _object(wish, profile, datasets, hands)
    keys = read_keyframes(wish.keyframes)
    path = keyframed_path(thing.model, keys, thing.limits_rad, wish.keyframes, thing.standing)
    return Asked(path.track, own, path.steps, f"keyframes of {Path(wish.keyframes).name}", thing.notes)


def _of_clip(wish: HandsWish, profile: str, datasets: tuple[str, ...], hands: HandPair, own: MotionWish) -> Asked:
    """A stored clip's object motion, for the hands of its person."""
    if wish.object:
        raise BadInput("object", "none beside --clip, which has its own", wish.object, "leave it out")
    paths = find_clip(wish.clip, profile, list(datasets))
    clip = open_store(paths.clips, hands).clip(wish.clip)
    betas, template_m = hand_shapes(clip)
    notes = [] if clip.gravity is not None else ["up: z, assumed: the gravity of this clip is not known"]
    gravity = own.gravity if clip.gravity is None else np.asarray(clip.gravity, np.float64)
    own = replace(own, words=clip.object_words, gravity=gravity, betas=betas, template_m=template_m)
    return Asked(clip.object, own, (), f"clip {wish.clip}", notes)


def _of_generated(wish: HandsWish, profile: str, datasets: tuple[str, ...], hands: HandPair, own: MotionWish) -> Asked:
    """The object's motion of a motion.npz that ``hoidata generate`` wrote, with the mesh in it or the one told."""
    path = Path(wish.motion)
    if not path.is_file():
        raise BadInput(path, "a motion.npz of `hoidata generate`", "nothing there", "correct the path")
    arrays = load_npz_arrays(path)
    missing = [name for name in GENERATED if name not in arrays]
    if missing:
        raise BadInput(path, "a motion.npz of `hoidata generate`", f"no {missing[0]}", "give one, or --keyframes")
    if wish.object:
        model, _, _, notes = _object(wish, profile, datasets, hands)
    else:
        model, notes = _mesh_of(arrays, path), []
    angle = arrays.get("object_hinge_rad")
    if model.is_articulated != (angle is not None):
        remedy = "give the same object as `hoidata generate` had, with its hinge"
        raise BadInput(path, "an object with a hinge where the motion has one", model.name, remedy)
    thing = ObjectTrack(model, arrays["object_rotvec"], arrays["object_translation_m"], angle)
    _check_track(thing, path)
    gravity = arrays.get("gravity", np.zeros(0))
    own = replace(own, gravity=np.asarray(gravity, np.float64) if gravity.shape == (3,) else own.gravity)
    return Asked(thing, own, (), f"generated for {str(arrays.get('text', path.name))!r}", notes)


def _mesh_of(arrays: dict[str, np.ndarray], path: Path) -> ObjectModel:
    hinge = None
    if "object_hinge_rad" in arrays:
        if "object_hinge_axis" not in arrays:
            raise BadInput(path, "an object_hinge_axis", "none", "name the object too, or generate the motion anew")
        hinge = Hinge(arrays["object_hinge_axis"], arrays["object_hinge_origin_m"])
    vertices, faces, part = (arrays[f"object_{name}"] for name in ("vertices_m", "faces", "part"))
    fits = vertices.shape == (len(part), 3) and faces.ndim == 2 and faces.shape[1] == 3 and faces.dtype.kind in "iu"
    if not fits or not len(faces) or not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices):
        raise BadInput(path, "a mesh", f"{vertices.shape}, {faces.shape}", "generate the motion anew")
    return ObjectModel("object", vertices.astype(np.float64), faces.astype(np.int64), part, hinge)


def _check_track(thing: ObjectTrack, path: Path) -> None:
    count = len(thing.translation_m)
    arrays = [thing.rotvec, thing.translation_m] + ([] if thing.hinge_rad is None else [thing.hinge_rad])
    shapes = [(count, 3), (count, 3), (count,)][: len(arrays)]
    if [a.shape for a in arrays] != shapes or not all(a.dtype.kind == "f" and np.isfinite(a).all() for a in arrays):
        raise BadInput(path, "finite poses of every frame", f"{[a.shape for a in arrays]}", "generate the motion anew")


def _lasting(asked: Asked, seconds: float) -> Asked:
    """The same way in another time. Raises BadInput for a time that is none, or too short for it."""
    thing = asked.thing
    if not LEAST_S <= seconds <= MAX_S:
        raise BadInput("--length", f"{LEAST_S:g} to {MAX_S:g} s", f"{seconds:g} s", "ask for another length")
    if thing.n_frames < 2:
        raise BadInput("--length", "a motion of two frames or more", "one frame", "leave it out")
    count = round(seconds * FPS) + 1
    pace = (count - 1) / (thing.n_frames - 1)
    if pace < 1:
        check_pace(thing, pace, "--length")
    old, new = np.arange(thing.n_frames), np.linspace(0, thing.n_frames - 1, count)
    turned = Slerp(old, Rotation.from_rotvec(thing.rotvec))(new).as_rotvec().astype(np.float32)
    place = CubicSpline(old, thing.translation_m)(new).astype(np.float32)
    hinge = None if thing.hinge_rad is None else CubicSpline(old, thing.hinge_rad)(new).astype(np.float32)
    steps = tuple(PathStep(step.words, step.start_s * pace, step.end_s * pace) for step in asked.steps)
    slowed = ObjectTrack(thing.model, turned, place, hinge)
    return asked._replace(thing=slowed, steps=steps, source=f"{asked.source}, in {seconds:g} s")
