"""ARCTIC (Fan et al. 2023): two hands and a hinged object; segments and verbs from Text2HOI's description files."""

import re
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any, get_args

import numpy as np

from hoidata.clips.clip import SIDES, BodyTrack, CameraTrack, Clip, HandTrack, HandType, ObjectTrack, Side, WorldFrame
from hoidata.clips.hand_parameters import HandConvention, SourceHand, to_track
from hoidata.dataset_folders import facts_of_adapter
from hoidata.datasets import checks
from hoidata.datasets.base import AdapterBase, DatasetPart, Quarantined, RawTree, SequenceKey
from hoidata.datasets.known_meshes import raw_mesh
from hoidata.datasets.segments import ClipSource, has_description, segment_clips
from hoidata.errors import BadInput
from hoidata.files import load_npy_object
from hoidata.geometry.rotations import canonical_rotvec, rotmat_to_rotvec
from hoidata.hands import HandPair
from hoidata.objects.mesh import Mesh
from hoidata.objects.model import Hinge, ObjectModel

EXCLUDED = {("write", "notebook"), ("operate", "waffleiron"), ("push", "capsulemachine")}  # as in Text2HOI
OBJECT_WORDS = {f"{kind}{noun}": f"{kind} {noun}"
                for kind, noun in (("capsule", "machine"), ("espresso", "machine"), ("waffle", "iron"))}  # fmt: skip
OBJECTS = ("box", "capsulemachine", "espressomachine", "ketchup", "laptop", "microwave", "mixer", "notebook", "phone",
           "scissors", "waffleiron")  # fmt: skip
VERBS = ("close", "cut", "grasp", "lift", "open", "operate", "place", "point", "shake", "sprinkle", "type")


def object_words(name: str) -> str:
    """ARCTIC's joined object name in words; other names are unchanged."""
    return OBJECT_WORDS.get(name, name)


# All pairs of verb and object, except verbs that apply to some objects only.
_ONLY = {"cut": ("scissors",), "sprinkle": ("ketchup",), "type": ("laptop", "phone")}
PAIRS = tuple(
    (verb, object_words(name))
    for verb in VERBS
    for name in OBJECTS
    if (verb, name) not in EXCLUDED and name in _ONLY.get(verb, OBJECTS)
)


LARGEST_TEXT_BYTES = 4 << 20
EGO_IMAGE_SIZE = (2800, 2000)  # width, height of the head camera's images
_RANGE = re.compile(r"([0-9]{1,9})-([0-9]{1,9})")
_ROTATION_ERROR = 1e-3


@dataclass(frozen=True)
class Description:
    """One line of a description file."""

    start: int  # first frame, counted from 1
    stop: int  # last frame, inclusive
    verb: str
    hand: HandType


def parse_description(line: str) -> Description:
    """Parse ``12-100 grab, right hand``: range from 1, verb, hand and an ignored fourth word. Raises ValueError."""
    words = line.split()
    if len(words) != 4:
        raise ValueError(f"{len(words)} words")
    ends = _RANGE.fullmatch(words[0])
    if ends is None or not 1 <= int(ends[1]) <= int(ends[2]):
        raise ValueError(f"the range {words[0]!r}")
    if words[2] not in get_args(HandType):
        raise ValueError(f"the hand {words[2]!r}")
    verb = words[1].rstrip(",")
    if not verb:
        raise ValueError("no verb")
    return Description(int(ends[1]), int(ends[2]), verb, words[2])  # type: ignore[arg-type]


def parse_descriptions(data: bytes, path: str) -> tuple[list[Description], list[tuple[int, BadInput]]]:
    """The valid lines of a description file, and number (from 1) and problem of each other line that is not blank."""
    described: list[Description] = []
    problems: list[tuple[int, BadInput]] = []
    for number, line in enumerate(_text(data, path).splitlines(), 1):
        if not line.strip():
            continue
        try:
            described.append(parse_description(line))
        except ValueError as error:
            expected = "'<start>-<end> <action>, <left|right|both> hand'"
            problems.append((number, BadInput(f"{path}:{number}", expected, str(error)[:80], "mend the line")))
    return described, problems


def parse_parts(data: bytes, path: str, n_vertices: int) -> np.ndarray:
    """Parse parts.json to (vertex,) bool, True for the base. In the file 0 is the top, which moves.

    ARCTIC's documentation states the opposite. Raises BadInput unless the file is a JSON list of ``n_vertices`` zeros
    and ones or booleans.
    """
    values = checks.json_value(path, _small(data, path))
    if not isinstance(values, list) or len(values) != n_vertices or any(value not in (0, 1) for value in values):
        got = f"a list of {len(values)}" if isinstance(values, list) else type(values).__name__
        raise BadInput(path, f"a list of {n_vertices} zeros and ones, one per vertex of mesh.obj", got)
    return np.array(values, dtype=bool)


def parse_misc(data: bytes, path: str) -> dict[str, int]:
    """``ioi_offset`` of each subject: image number minus frame number. Raises BadInput."""
    subjects = checks.json_value(path, _small(data, path))
    if not isinstance(subjects, dict):
        raise BadInput(path, "a JSON object with an entry per subject", type(subjects).__name__)
    offsets = {}
    for subject, entry in subjects.items():
        offset = checks.entry(f"{path}: {subject}", entry, "ioi_offset")
        if isinstance(offset, bool) or not isinstance(offset, int) or abs(offset) > 1_000_000:
            raise BadInput(f"{path}: {subject}.ioi_offset", "a whole number of frames", repr(offset)[:40])
        offsets[subject] = offset
    return offsets


def head_camera(location: str, content: Any, n_frames: int, image_offset: int) -> CameraTrack:
    """Convert the head camera: the file has camera from world (``R x + T``), a clip has world from camera.

    image_offset: image number minus frame number.
    """
    rotation = _matrices(f"{location}: R_k_cam_np", checks.entry(location, content, "R_k_cam_np"), n_frames)
    translation = np.asarray(checks.entry(location, content, "T_k_cam_np"))
    translation = translation[..., 0] if translation.ndim == 3 and translation.shape[2] == 1 else translation
    translation = checks.table(f"{location}: T_k_cam_np", translation, 3, n_frames)
    matrix = checks.table(f"{location}: intrinsics", checks.entry(location, content, "intrinsics"), 3, 3, "rows")
    world_from_camera = rotation.transpose(0, 2, 1)
    return CameraTrack(
        name="ego",
        rotvec=rotmat_to_rotvec(world_from_camera).astype(np.float32),
        position_m=-(world_from_camera @ translation[..., None])[..., 0].astype(np.float32),
        images=np.arange(n_frames, dtype=np.int32) + np.int32(image_offset),
        intrinsics=np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *EGO_IMAGE_SIZE]),
    )


def _matrices(location: str, value: Any, n_frames: int) -> np.ndarray:
    """Check and return proper rotations (frame, 3, 3)."""
    matrices = np.asarray(value)
    if matrices.ndim != 3 or matrices.shape[1:] != (3, 3):
        raise BadInput(location, "a 3 x 3 matrix per frame", f"shape {matrices.shape}")
    matrices = checks.table(location, matrices.reshape(-1, 9), 9, n_frames).reshape(-1, 3, 3)
    error = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = (error > _ROTATION_ERROR) | (np.linalg.det(matrices) < 0)
    if bad.any():
        first = int(bad.argmax())
        got = f"one off by {error[first]:.3g}" if error[first] > _ROTATION_ERROR else "a mirror"
        raise BadInput(location, "rotations", f"{got} in row {first}")
    return matrices


def _text(data: bytes, path: str) -> str:
    try:
        return _small(data, path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInput(path, "UTF-8 text", str(error)) from error


def _small(data: bytes, path: str) -> bytes:
    if len(data) > LARGEST_TEXT_BYTES:
        raise BadInput(path, f"at most {LARGEST_TEXT_BYTES} bytes", f"{len(data)}")
    return data


MILLIMETRES = 1e-3
TOP_FOLDERS = ("", "data/", "arctic_data/data/")
PARTS_ALIGNED_MM = 5.0  # tolerance: top.obj and bottom.obj have another topology than mesh.obj
HINGE_AXIS = (0.0, 0.0, -1.0)
FRAME = WorldFrame("+z", "stated", "ARCTIC's motion-capture world, right-handed, z up, metres")
HAND_NOTE = "MANO: axis-angles relative to the mean pose, betas per sequence, translation added to the rest wrist"
CONVENTION = HandConvention(
    translation="transl", fingers="mean-relative", shape="betas per sequence", left_shape="as released", note=HAND_NOTE
)


def _below_top_folders(*patterns: str) -> tuple[str, ...]:
    return tuple(f"{top}{pattern}" for top in TOP_FOLDERS for pattern in patterns)


MOTION_PARTS = (
    DatasetPart("object motion", _below_top_folders("raw_seqs/s*/*.object.npy"), "raw_seqs.zip"),
    DatasetPart("hand motion", _below_top_folders("raw_seqs/s*/*.mano.npy"), "raw_seqs.zip"),
    DatasetPart("object meshes", _below_top_folders("meta/object_vtemplates/*/mesh.obj"), "meta.zip"),
    DatasetPart("parts of the objects", _below_top_folders("meta/object_vtemplates/*/parts.json"), "meta.zip"),
    DatasetPart(
        "separate meshes of the parts",
        _below_top_folders("meta/object_vtemplates/*/bottom.obj", "meta/object_vtemplates/*/top.obj"),
        "meta.zip",
        optional=True,
    ),
    DatasetPart("head camera", _below_top_folders("raw_seqs/s*/*.egocam.dist.npy"), "raw_seqs.zip", optional=True),
    DatasetPart("bodies", _below_top_folders("raw_seqs/s*/*.smplx.npy"), "raw_seqs.zip", optional=True),
    DatasetPart("image offsets", _below_top_folders("meta/misc.json"), "meta.zip", optional=True),
)
DESCRIPTIONS = DatasetPart(
    "frame ranges and verbs",
    _below_top_folders("description/s*/*/description.txt"),
    "Text2HOI's description files (linked from its and ARCTIC's page)",
    unneeded_with="clips=segments",
)
WITHHELD_SUBJECT = "s03"
KINDS = ("mano.npy", "object.npy", "egocam.dist.npy", "smplx.npy")


@dataclass(frozen=True)
class _Motion:
    """One sequence in metres and radians, frame axis first."""

    hands: dict[Side, HandTrack]
    object: ObjectTrack
    camera: CameraTrack | None
    body: BodyTrack | None

    @property
    def n_frames(self) -> int:
        return self.object.n_frames


@dataclass(frozen=True)
class ArcticAdapter(AdapterBase):
    """Raw root: the folder with ``raw_seqs/``, ``meta/`` and ``description/`` (or ``data/`` above them).

    ``clips`` selects the clips: "described" gives one clip per line of Text2HOI's description files. Without
    descriptions, "segments" cuts a sequence by contact and motion (``hoidata.datasets.segments``), "whole" gives one
    clip per sequence. "described-else-segments" cuts only the sequences without a description.
    """

    facts = facts_of_adapter(__file__)
    margin_frames: int = 0  # frames kept before and after each described range
    shortest_frames: int = 20  # shorter ranges give no clip
    clips: ClipSource = "described"
    trimmed_frames: int = 0  # excluded at both ends of a whole sequence; ARCTIC's baselines exclude 10 (black images)
    all_pairs: bool = False  # include the three pairs of verb and object that Text2HOI excludes
    body: bool = False  # include the parameters of the subject's SMPL-X body
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION

    @property
    def parts(self) -> tuple[DatasetPart, ...]:
        """Files of a complete raw folder. Descriptions are required for the setting ``clips: described`` only."""
        return (*MOTION_PARTS, replace(DESCRIPTIONS, optional=self.clips != "described"))

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per sequence with at least one of its files. Files are paired by name."""
        names = set()
        for top in TOP_FOLDERS:
            for path in (Path(root) / top / "raw_seqs").glob("s*/*.npy"):
                stem, _, kind = path.name.partition(".")
                if kind in KINDS:
                    names.add((path.parent.name, stem))
        return [SequenceKey(self.name, subject, f"{subject}/{stem}") for subject, stem in sorted(names)]

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """One clip per described range of at least 20 frames, per segment, or per sequence."""
        path = _path_in_copy(raw, f"description/{key.name}/description.txt")
        if not has_description(self.clips, raw, path):
            whole = self._whole(raw, key, _read_motion(raw, key, hands, self.body))
            return [whole] if self.clips == "whole" else list(segment_clips([whole], hands))
        descriptions, results = _read_descriptions(raw, path, key)
        motion = _read_motion(raw, key, hands, self.body)
        object_name = motion.object.model.name
        for description, clip_id in zip(descriptions, _clip_ids(key, descriptions), strict=True):
            problem = self._unusable_reason(path, description, object_name, motion.n_frames)
            if problem is None:
                start, stop = description.start - 1 - self.margin_frames, description.stop + self.margin_frames
                results.append(self._cut(raw, key, clip_id, motion, description, start, stop))
            else:
                results.append(Quarantined.from_error(clip_id, problem))
        return results

    def _unusable_reason(self, path: str, description: Description, object_name: str, n_frames: int) -> BadInput | None:
        """Why a described range gives no clip, or None."""
        length, range_in_words = description.stop - description.start + 1, f"{description.start}-{description.stop}"
        if description.stop > n_frames:
            return BadInput(path, f"frames 1 to {n_frames}", range_in_words)
        if length < self.shortest_frames:
            remedy = "nothing to do, or lower the setting shortest_frames"
            return BadInput(f"{path}: {range_in_words}", f"{self.shortest_frames} frames or more", f"{length}", remedy)
        if not self.all_pairs and (description.verb, object_name) in EXCLUDED:
            remedy = "nothing to do, or set all_pairs"
            got = f"{description.verb} {object_name}"
            return BadInput(f"{path}: {range_in_words}", "none of the pairs Text2HOI leaves out", got, remedy)
        return None

    def _whole(self, raw: RawTree, key: SequenceKey, motion: _Motion) -> Clip:
        start, stop = self.trimmed_frames, motion.n_frames - self.trimmed_frames
        if start >= stop:
            remedy = "nothing to do, or lower the setting trimmed_frames"
            raise BadInput(str(key), f"more than {2 * self.trimmed_frames} frames", f"{motion.n_frames}", remedy)
        return self._cut(raw, key, str(key), motion, None, start, stop)

    def _cut(
        self,
        raw: RawTree,
        key: SequenceKey,
        clip_id: str,
        motion: _Motion,
        description: Description | None,
        start: int,
        stop: int,
    ) -> Clip:
        whole = self.new_clip(
            key,
            clip_id=clip_id,
            hands=motion.hands,
            object=motion.object,
            source_frames=np.arange(motion.n_frames, dtype=np.int32),
            gravity=np.array([0.0, 0.0, -1.0]),
            verb=None if description is None else description.verb,
            object_words=object_words(motion.object.model.name),
            labelled_hand=None if description is None else description.hand,
            sources=raw.sources,
            camera=motion.camera,
            body=motion.body,
        )
        return whole.take(slice(max(0, start), stop))


def _path_in_copy(raw: RawTree, path: str) -> str:
    """The path below the top folder that contains it; the expected path if none does."""
    names = [f"{top}{path}" for top in TOP_FOLDERS]
    usual = [name for name, top in zip(names, TOP_FOLDERS, strict=True) if (raw.root / top / "raw_seqs").is_dir()]
    return next((name for name in names if raw.has(name)), (usual or names)[0])


def _read_descriptions(raw: RawTree, path: str, key: SequenceKey) -> tuple[list[Description], list[Clip | Quarantined]]:
    _refuse_withheld(raw, key)
    if not raw.has(path):
        remedy = (
            "add Text2HOI's description files; where none was published (espressomachine), nothing to do, or set "
            "clips: described-else-segments"
        )
        raise BadInput(path, "a description of the sequence's segments", "no file", remedy)
    described, problems = parse_descriptions(raw.read(path), path)
    return described, [Quarantined.from_error(f"{key}/line-{number:03d}", problem) for number, problem in problems]


def _clip_ids(key: SequenceKey, descriptions: list[Description]) -> list[str]:
    """Ids from the described ranges, with the hand if one range is described for both hands separately."""
    names = [f"{key}/{item.start:04d}-{item.stop:04d}" for item in descriptions]
    with_hand = [f"{name}-{item.hand}" for name, item in zip(names, descriptions, strict=True)]
    ids = [full if names.count(name) > 1 else name for name, full in zip(names, with_hand, strict=True)]
    repeated = next((name for name, group in groupby(sorted(ids)) if len(list(group)) > 1), None)
    if repeated is not None:
        raise BadInput(str(key), "one line per range and hand", f"{repeated} twice", "remove one line")
    return ids


def _refuse_withheld(raw: RawTree, key: SequenceKey) -> None:
    """Raise BadInput with the reason if the missing files are unpublished."""
    paths = [_path_in_copy(raw, f"raw_seqs/{key.name}.{kind}") for kind in ("mano.npy", "object.npy")]
    missing = [path for path in paths if not raw.has(path)]
    if key.subject == WITHHELD_SUBJECT and missing:
        got = f"none: ARCTIC withholds the motion of its test subject {WITHHELD_SUBJECT}"
        raise BadInput(missing[0], "a motion file", got, "nothing to do; its results are scored by ARCTIC's server")


def _read_motion(raw: RawTree, key: SequenceKey, hands: HandPair, with_body: bool) -> _Motion:
    _refuse_withheld(raw, key)
    paths = {kind: _path_in_copy(raw, f"raw_seqs/{key.name}.{kind}") for kind in KINDS}
    pose_path, hand_path = paths["object.npy"], paths["mano.npy"]
    pose = checks.table(pose_path, load_npy_object(raw.file(pose_path)), 7)
    params = load_npy_object(raw.file(hand_path))
    tracks: dict[Side, HandTrack] = {}
    for side in SIDES:
        tracks[side] = _hand(f"{hand_path}: {side}", checks.entry(hand_path, params, side), side, hands)
        if tracks[side].n_frames != len(pose):
            got = f"{tracks[side].n_frames}"
            raise BadInput(f"{hand_path}: {side}", f"{len(pose)} frames as in {pose_path}", got)
    object_name = re.sub(r"\d+$", "", key.name.partition("/")[2].split("_")[0])
    track = ObjectTrack(
        _object_model(raw, object_name),
        rotvec=canonical_rotvec(pose[:, 1:4]).astype(np.float32),
        translation_m=(pose[:, 4:7] * MILLIMETRES).astype(np.float32),
        hinge_rad=pose[:, 0].astype(np.float32),
    )
    camera = _camera(raw, paths["egocam.dist.npy"], key.subject, len(pose))
    body_path = paths["smplx.npy"]
    body = checks.body_track(body_path, load_npy_object(raw.file(body_path)), len(pose)) if with_body else None
    return _Motion(tracks, track, camera, body)


def _camera(raw: RawTree, path: str, subject: str, n_frames: int) -> CameraTrack | None:
    if not raw.has(path):
        return None
    misc = _path_in_copy(raw, "meta/misc.json")
    offset = parse_misc(raw.read(misc), misc).get(subject, 0) if raw.has(misc) else 0
    return head_camera(path, load_npy_object(raw.file(path)), n_frames, offset)


def _hand(location: str, params: Any, side: Side, hands: HandPair) -> HandTrack:
    pose = checks.table(f"{location}.pose", checks.entry(location, params, "pose"), 45)
    rotation = checks.table(f"{location}.rot", checks.entry(location, params, "rot"), 3, len(pose))
    transl = checks.table(f"{location}.trans", checks.entry(location, params, "trans"), 3, len(pose))
    shape = np.asarray(checks.entry(location, params, "shape"))
    betas = checks.table(f"{location}.shape", shape[None] if shape.ndim == 1 else shape, 10)
    if len(betas) not in (1, len(pose)):
        raise BadInput(f"{location}.shape", f"10 numbers, or {len(pose)} rows of them", f"{len(betas)} rows")
    return to_track(SourceHand(transl, rotation, pose, betas), CONVENTION, hands[side])


def _object_model(raw: RawTree, name: str) -> ObjectModel:
    """Join bottom.obj and top.obj if the release has both, else split mesh.obj by parts.json."""
    folder = f"meta/object_vtemplates/{name}"
    mesh_path = _path_in_copy(raw, f"{folder}/mesh.obj")
    part_path = _path_in_copy(raw, f"{folder}/parts.json")
    mesh = raw_mesh(raw, mesh_path)
    is_base = parse_parts(raw.read(part_path), part_path, len(mesh.vertices))
    part_paths = [_path_in_copy(raw, f"{folder}/{half}.obj") for half in ("bottom", "top")]
    if all(raw.has(path) for path in part_paths):
        mesh, is_base = _parts_joined([raw_mesh(raw, path) for path in part_paths], part_paths, mesh, mesh_path)
    hinge = Hinge(axis=np.array(HINGE_AXIS), origin_m=np.zeros(3))
    part = (~is_base).astype(np.uint8)
    return ObjectModel(name, vertices_m=mesh.vertices * MILLIMETRES, faces=mesh.faces, part=part, hinge=hinge)


def _parts_joined(parts: list[Mesh], part_paths: list[str], whole: Mesh, whole_path: str) -> tuple[Mesh, np.ndarray]:
    """Join base and moving part to one mesh. Also returns (vertex,) bool, True for the base.

    Raises BadInput if their bounding box differs from that of the whole object's mesh.
    """
    base, moving = parts
    faces = np.concatenate([base.faces, moving.faces + len(base.vertices)])
    joined = Mesh(np.concatenate([base.vertices, moving.vertices]), faces)
    boxes = [np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)]) for mesh in (joined, whole)]
    difference_mm = float(np.abs(boxes[0] - boxes[1]).max())
    if difference_mm > PARTS_ALIGNED_MM:
        expected = f"parts with the bounding box of {whole_path}, within {PARTS_ALIGNED_MM:g} mm"
        remedy = "remove both files to use mesh.obj and parts.json, or download them again"
        raise BadInput(", ".join(part_paths), expected, f"a difference of {difference_mm:.3g} mm", remedy)
    return joined, np.arange(len(joined.vertices)) < len(base.vertices)
