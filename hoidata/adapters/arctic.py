"""ARCTIC (Fan et al. 2023): two hands and a hinged object; segments and words from Text2HOI's description files."""

import re
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, get_args

import numpy as np
import orjson

from hoidata.adapters import checks
from hoidata.adapters.base import DatasetPart, Quarantined, RawTree, SequenceKey
from hoidata.errors import BadInput
from hoidata.files import load_npy_object
from hoidata.hands import HandPair
from hoidata.objects.mesh import load_mesh
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.schema.clip import SIDES, Clip, HandTrack, HandType, ObjectTrack, Side, WorldFrame
from hoidata.schema.hand_parameters import HandConvention, SourceHand, to_track

MILLIMETRES = 1e-3
EXCLUDED = {("write", "notebook"), ("operate", "waffleiron"), ("push", "capsulemachine")}  # as Text2HOI does
OBJECT_WORDS = {
    "capsulemachine": "capsule machine",
    "espressomachine": "espresso machine",
    "waffleiron": "waffle iron",
}
ROOTS = ("", "data", "arctic_data/data")
TOPS = ("", "data/", "arctic_data/data/")
HINGE_AXIS = (0.0, 0.0, -1.0)
FRAME = WorldFrame("+z", "stated", "ARCTIC's motion-capture world, right-handed, z up, metres")
CONVENTION = HandConvention(
    translation="transl",
    fingers="mean-relative",
    shape="betas per sequence",
    left_shape="as released",
    note="MANO: axis-angles relative to the mean pose, betas per sequence, translation added to the rest wrist",
)
PARTS = (
    DatasetPart("hand and object motion", tuple(f"{top}raw_seqs/s*/*.object.npy" for top in TOPS), "raw_seqs.zip"),
    DatasetPart("object meshes", tuple(f"{top}meta/object_vtemplates/*/mesh.obj" for top in TOPS), "meta.zip"),
    DatasetPart(
        "segments and words", tuple(f"{top}description/s*/*/description.txt" for top in TOPS), "Text2HOI's repository"
    ),
)
RANGE = re.compile(r"(\d+)-(\d+)")


@dataclass(frozen=True)
class Description:
    """One line of a description file: frames ``start`` to ``stop`` counted from 1, both included."""

    start: int
    stop: int
    verb: str
    hand: HandType


@dataclass(frozen=True)
class _Motion:
    """One sequence in metres and radians, frame axis first."""

    hands: dict[Side, HandTrack]
    object: ObjectTrack

    @property
    def n_frames(self) -> int:
        return self.object.n_frames


@dataclass(frozen=True)
class ArcticAdapter:
    """Raw root: the folder with ``raw_seqs/``, ``meta/`` and ``description/`` (or ``data/`` above them).

    margin_frames: frames kept before and after each described range. shortest_frames: shorter ranges are no clips.
    """

    margin_frames: int = 0
    shortest_frames: int = 20
    name: str = "arctic"
    version: str = "1.0"
    licence: str = "ARCTIC licence (MPI): non-commercial research, no redistribution"
    where_to_register: str = "https://arctic.is.tue.mpg.de (raw_seqs.zip, meta.zip) and Text2HOI's description files"
    needs_mano: bool = True
    source_fps: float = 30.0
    may_be_shared: bool = False
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION
    parts: tuple[DatasetPart, ...] = PARTS

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per sequence that has a hand or an object file; the two are paired by name, never by position."""
        names = set()
        for top in ROOTS:
            for path in (Path(root) / top / "raw_seqs").glob("s*/*.npy"):
                stem, _, kind = path.name.partition(".")
                if kind in ("mano.npy", "object.npy"):
                    names.add((path.parent.name, stem))
        return [SequenceKey(self.name, subject, f"{subject}/{stem}") for subject, stem in sorted(names)]

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """One clip per described range of at least 20 frames."""
        where = _description_path(raw, key)
        descriptions, results = _read_descriptions(raw, where, key)
        motion = _read_motion(raw, key, hands)
        noun = motion.object.model.name
        ids = _clip_ids(key, descriptions)
        for description, clip_id in zip(descriptions, ids, strict=True):
            if (description.verb, noun) in EXCLUDED or description.stop - description.start + 1 < self.shortest_frames:
                continue
            if description.stop > motion.n_frames:
                problem = BadInput(where, f"frames 1 to {motion.n_frames}", f"{description.start}-{description.stop}")
                results.append(Quarantined.from_error(clip_id, problem))
                continue
            results.append(self._clip(raw, key, clip_id, motion, description))
        return results

    def _clip(self, raw: RawTree, key: SequenceKey, clip_id: str, motion: _Motion, description: Description) -> Clip:
        start = max(0, description.start - 1 - self.margin_frames)
        stop = min(motion.n_frames, description.stop + self.margin_frames)
        whole = Clip(
            clip_id=clip_id,
            dataset=self.name,
            subject=key.subject,
            sequence=key.name,
            hands=motion.hands,
            object=motion.object,
            source_frames=np.arange(motion.n_frames, dtype=np.int32),
            gravity=np.array([0.0, 0.0, -1.0]),
            verb=description.verb,
            object_words=OBJECT_WORDS.get(motion.object.model.name, motion.object.model.name),
            labelled_hand=description.hand,
            sources=raw.sources,
            source_fps=self.source_fps,
        )
        return whole.cut(start, stop)


def parse_description(line: str) -> Description:
    """``12-100 grab, right hand``: range from 1, verb, hand, a fourth word that means nothing. Raises ValueError."""
    words = line.split()
    if len(words) != 4:
        raise ValueError(f"{len(words)} words")
    ends = RANGE.fullmatch(words[0])
    if ends is None or not 1 <= int(ends[1]) <= int(ends[2]):
        raise ValueError(f"the range {words[0]!r}")
    if words[2] not in get_args(HandType):
        raise ValueError(f"the hand {words[2]!r}")
    return Description(int(ends[1]), int(ends[2]), words[1].rstrip(","), words[2])  # type: ignore[arg-type]


def _description_path(raw: RawTree, key: SequenceKey) -> str:
    names = [f"{top}/description/{key.name}/description.txt".lstrip("/") for top in ROOTS]
    return next((name for name in names if raw.has(name)), names[0])


def _read_descriptions(
    raw: RawTree, where: str, key: SequenceKey
) -> tuple[list[Description], list[Clip | Quarantined]]:
    if not raw.has(where):
        remedy = "nothing to do where none was published (s03, espressomachine); else add Text2HOI's description files"
        raise BadInput(where, "a description of the sequence's segments", "no file", remedy)
    try:
        lines = raw.read(where).decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise BadInput(where, "UTF-8 text", str(error)) from error
    described: list[Description] = []
    problems: list[Clip | Quarantined] = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            described.append(parse_description(line))
        except ValueError as error:
            expected = "'<start>-<end> <action>, <left|right|both> hand'"
            place = f"{where}:{number}"
            problems.append(Quarantined(f"{key}/line-{number:03d}", place, expected, str(error), "mend the line"))
    return described, problems


def _clip_ids(key: SequenceKey, descriptions: list[Description]) -> list[str]:
    """Ids from the range as written; the hand is added where one range is described for two hands."""
    names = [f"{key}/{item.start:04d}-{item.stop:04d}" for item in descriptions]
    with_hand = [f"{name}-{item.hand}" for name, item in zip(names, descriptions, strict=True)]
    ids = [full if names.count(name) > 1 else name for name, full in zip(names, with_hand, strict=True)]
    repeated = next((name for name, group in groupby(sorted(ids)) if len(list(group)) > 1), None)
    if repeated is not None:
        raise BadInput(str(key), "one line per range and hand", f"{repeated} twice", "remove one line")
    return ids


def _read_motion(raw: RawTree, key: SequenceKey, hands: HandPair) -> _Motion:
    tops = [top for top in ROOTS if (raw.root / top / "raw_seqs").is_dir()]
    stem = f"{tops[0]}/raw_seqs/{key.name}".lstrip("/")
    pose_path, hand_path = f"{stem}.object.npy", f"{stem}.mano.npy"
    pose = checks.table(pose_path, load_npy_object(raw.file(pose_path)), 7)
    params = load_npy_object(raw.file(hand_path))
    tracks: dict[Side, HandTrack] = {}
    for side in SIDES:
        tracks[side] = _hand(f"{hand_path}: {side}", checks.entry(hand_path, params, side), side, hands)
        if tracks[side].n_frames != len(pose):
            got = f"{tracks[side].n_frames}"
            raise BadInput(f"{hand_path}: {side}", f"{len(pose)} frames as in {pose_path}", got)
    name = re.sub(r"\d+$", "", key.name.partition("/")[2].split("_")[0])
    model = _object_model(raw, tops[0], name)
    track = ObjectTrack(
        model,
        rotvec=pose[:, 1:4].astype(np.float32),
        translation_m=(pose[:, 4:7] * MILLIMETRES).astype(np.float32),
        hinge_rad=pose[:, 0].astype(np.float32),
    )
    return _Motion(tracks, track)


def _hand(where: str, block: Any, side: Side, hands: HandPair) -> HandTrack:
    pose = checks.table(f"{where}.pose", checks.entry(where, block, "pose"), 45)
    rotation = checks.table(f"{where}.rot", checks.entry(where, block, "rot"), 3, len(pose))
    transl = checks.table(f"{where}.trans", checks.entry(where, block, "trans"), 3, len(pose))
    shape = np.asarray(checks.entry(where, block, "shape"))
    betas = checks.table(f"{where}.shape", shape[None] if shape.ndim == 1 else shape, 10)
    if len(betas) not in (1, len(pose)):
        raise BadInput(f"{where}.shape", f"10 numbers, or {len(pose)} rows of them", f"{len(betas)} rows")
    return to_track(SourceHand(transl, rotation, pose, betas), CONVENTION, hands[side])


def _object_model(raw: RawTree, top: str, name: str) -> ObjectModel:
    folder = f"{top}/meta/object_vtemplates/{name}".lstrip("/")
    mesh = load_mesh(raw.file(f"{folder}/mesh.obj"))
    is_base = _parts(raw, f"{folder}/parts.json", len(mesh.vertices))
    hinge = Hinge(axis=np.array(HINGE_AXIS), origin_m=np.zeros(3))
    part = (~is_base).astype(np.uint8)
    return ObjectModel(name, mesh.vertices * MILLIMETRES, mesh.faces, part, hinge)


def _parts(raw: RawTree, path: str, n_vertices: int) -> np.ndarray:
    """(vertex,) bool, True for the base. In the file 0 (false) is the top, which moves; ARCTIC's docs have it wrong."""
    try:
        values = orjson.loads(raw.read(path))
    except orjson.JSONDecodeError as error:
        raise BadInput(path, "a JSON list", str(error)) from error
    if not isinstance(values, list) or len(values) != n_vertices or any(value not in (0, 1) for value in values):
        got = f"a list of {len(values)}" if isinstance(values, list) else type(values).__name__
        raise BadInput(path, f"a list of {n_vertices} zeros and ones, one per vertex of mesh.obj", got)
    return np.array(values, dtype=bool)
