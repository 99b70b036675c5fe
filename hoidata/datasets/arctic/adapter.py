"""ARCTIC (Fan et al. 2023): two hands and a hinged object; segments and words from Text2HOI's description files."""

import re
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hoidata.clips.clip import SIDES, BodyTrack, CameraTrack, Clip, HandTrack, ObjectTrack, Side, WorldFrame
from hoidata.clips.hand_parameters import HandConvention, SourceHand, to_track
from hoidata.dataset_folders import facts_beside
from hoidata.datasets import checks
from hoidata.datasets.arctic.files import (
    EXCLUDED,
    Description,
    head_camera,
    object_words,
    parse_descriptions,
    parse_misc,
    parse_parts,
)
from hoidata.datasets.base import DatasetPart, Described, Quarantined, RawTree, SequenceKey
from hoidata.datasets.known_meshes import raw_mesh
from hoidata.errors import BadInput
from hoidata.files import load_npy_object
from hoidata.geometry.rotations import canonical_rotvec
from hoidata.hands import HandPair
from hoidata.objects.mesh import Mesh
from hoidata.objects.model import Hinge, ObjectModel

MILLIMETRES = 1e-3
TOPS = ("", "data/", "arctic_data/data/")
PARTS_ALIGNED_MM = 5.0  # top.obj and bottom.obj have a topology of their own
HINGE_AXIS = (0.0, 0.0, -1.0)
FRAME = WorldFrame("+z", "stated", "ARCTIC's motion-capture world, right-handed, z up, metres")
CONVENTION = HandConvention(
    translation="transl",
    fingers="mean-relative",
    shape="betas per sequence",
    left_shape="as released",
    note="MANO: axis-angles relative to the mean pose, betas per sequence, translation added to the rest wrist",
)


def _below_tops(*patterns: str) -> tuple[str, ...]:
    return tuple(f"{top}{pattern}" for top in TOPS for pattern in patterns)


MOTION_PARTS = (
    DatasetPart("object motion", _below_tops("raw_seqs/s*/*.object.npy"), "raw_seqs.zip"),
    DatasetPart("hand motion", _below_tops("raw_seqs/s*/*.mano.npy"), "raw_seqs.zip"),
    DatasetPart("object meshes", _below_tops("meta/object_vtemplates/*/mesh.obj"), "meta.zip"),
    DatasetPart("parts of the objects", _below_tops("meta/object_vtemplates/*/parts.json"), "meta.zip"),
    DatasetPart(
        "separate meshes of the parts",
        _below_tops("meta/object_vtemplates/*/bottom.obj", "meta/object_vtemplates/*/top.obj"),
        "meta.zip",
        optional=True,
    ),
    DatasetPart("head camera", _below_tops("raw_seqs/s*/*.egocam.dist.npy"), "raw_seqs.zip", optional=True),
    DatasetPart("bodies", _below_tops("raw_seqs/s*/*.smplx.npy"), "raw_seqs.zip", optional=True),
    DatasetPart("image offsets", _below_tops("meta/misc.json"), "meta.zip", optional=True),
)
WITHHELD_SUBJECT = "s03"
KINDS = ("mano.npy", "object.npy", "egocam.dist.npy", "smplx.npy")
Stretches = Literal["described", "whole", "described-else-whole"]


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
class ArcticAdapter(Described):
    """Raw root: the folder with ``raw_seqs/``, ``meta/`` and ``description/`` (or ``data/`` above them).

    clips: "described" gives one clip per line of Text2HOI's description files; "whole" one clip per sequence without
    a verb, descriptions or not; "described-else-whole" the latter only where a sequence has no description.
    margin_frames: frames kept before and after each described range. shortest_frames: shorter ranges are no clips.
    all_pairs: keep the three pairs of verb and object that Text2HOI leaves out.
    trimmed_frames: left out at both ends of a whole sequence (ARCTIC's own baselines leave out 10, whose images are
    black). body: keep the parameters of the subject's SMPL-X body.
    """

    facts = facts_beside(__file__)
    margin_frames: int = 0
    shortest_frames: int = 20
    clips: Stretches = "described"
    trimmed_frames: int = 0
    all_pairs: bool = False
    body: bool = False
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION

    @property
    def parts(self) -> tuple[DatasetPart, ...]:
        """Descriptions are needed only where clips are cut by them."""
        files = _below_tops("description/s*/*/description.txt")
        where = "Text2HOI's description files (linked from its and ARCTIC's page)"
        optional = self.clips != "described"
        return (*MOTION_PARTS, DatasetPart("segments and words", files, where, optional, "clips=whole"))

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per sequence that has any of its files; they are paired by name, never by position."""
        names = set()
        for top in TOPS:
            for path in (Path(root) / top / "raw_seqs").glob("s*/*.npy"):
                stem, _, kind = path.name.partition(".")
                if kind in KINDS:
                    names.add((path.parent.name, stem))
        return [SequenceKey(self.name, subject, f"{subject}/{stem}") for subject, stem in sorted(names)]

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """One clip per described range of at least 20 frames; or the whole sequence as one."""
        where = _found(raw, f"description/{key.name}/description.txt")
        if self.clips == "whole" or (self.clips == "described-else-whole" and not raw.has(where)):
            return [self._whole(raw, key, _read_motion(raw, key, hands, self.body))]
        descriptions, results = _read_descriptions(raw, where, key)
        motion = _read_motion(raw, key, hands, self.body)
        noun = motion.object.model.name
        for description, clip_id in zip(descriptions, _clip_ids(key, descriptions), strict=True):
            problem = self._why_no_clip(where, description, noun, motion.n_frames)
            if problem is None:
                start, stop = description.start - 1 - self.margin_frames, description.stop + self.margin_frames
                results.append(self._cut(raw, key, clip_id, motion, description, start, stop))
            else:
                results.append(Quarantined.from_error(clip_id, problem))
        return results

    def _why_no_clip(self, where: str, description: Description, noun: str, n_frames: int) -> BadInput | None:
        """What keeps a described range from being a clip, or None."""
        length, given = description.stop - description.start + 1, f"{description.start}-{description.stop}"
        if description.stop > n_frames:
            return BadInput(where, f"frames 1 to {n_frames}", given)
        if length < self.shortest_frames:
            remedy = "nothing to do, or lower the setting shortest_frames"
            return BadInput(f"{where}: {given}", f"{self.shortest_frames} frames or more", f"{length}", remedy)
        if not self.all_pairs and (description.verb, noun) in EXCLUDED:
            remedy = "nothing to do, or set all_pairs"
            got = f"{description.verb} {noun}"
            return BadInput(f"{where}: {given}", "none of the pairs Text2HOI leaves out", got, remedy)
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
        whole = Clip(
            clip_id=clip_id,
            dataset=self.name,
            subject=key.subject,
            sequence=key.name,
            hands=motion.hands,
            object=motion.object,
            source_frames=np.arange(motion.n_frames, dtype=np.int32),
            gravity=np.array([0.0, 0.0, -1.0]),
            verb=None if description is None else description.verb,
            object_words=object_words(motion.object.model.name),
            labelled_hand=None if description is None else description.hand,
            sources=raw.sources,
            source_fps=self.source_fps,
            camera=motion.camera,
            body=motion.body,
        )
        return whole.take(slice(max(0, start), stop))


def _found(raw: RawTree, path: str) -> str:
    """The path below whichever top folder holds it; where it should be when none does."""
    names = [f"{top}{path}" for top in TOPS]
    usual = [name for name, top in zip(names, TOPS, strict=True) if (raw.root / top / "raw_seqs").is_dir()]
    return next((name for name in names if raw.has(name)), (usual or names)[0])


def _read_descriptions(
    raw: RawTree, where: str, key: SequenceKey
) -> tuple[list[Description], list[Clip | Quarantined]]:
    _refuse_withheld(raw, key)
    if not raw.has(where):
        remedy = (
            "add Text2HOI's description files; where none was published (espressomachine), nothing to do, or set "
            "clips: described-else-whole"
        )
        raise BadInput(where, "a description of the sequence's segments", "no file", remedy)
    described, problems = parse_descriptions(raw.read(where), where)
    return described, [Quarantined.from_error(f"{key}/line-{number:03d}", problem) for number, problem in problems]


def _clip_ids(key: SequenceKey, descriptions: list[Description]) -> list[str]:
    """Ids from the range as written; the hand is added where one range is described for two hands."""
    names = [f"{key}/{item.start:04d}-{item.stop:04d}" for item in descriptions]
    with_hand = [f"{name}-{item.hand}" for name, item in zip(names, descriptions, strict=True)]
    ids = [full if names.count(name) > 1 else name for name, full in zip(names, with_hand, strict=True)]
    repeated = next((name for name, group in groupby(sorted(ids)) if len(list(group)) > 1), None)
    if repeated is not None:
        raise BadInput(str(key), "one line per range and hand", f"{repeated} twice", "remove one line")
    return ids


def _refuse_withheld(raw: RawTree, key: SequenceKey) -> None:
    """Say so when the files that are missing were never published."""
    paths = [_found(raw, f"raw_seqs/{key.name}.{kind}") for kind in ("mano.npy", "object.npy")]
    missing = [path for path in paths if not raw.has(path)]
    if key.subject == WITHHELD_SUBJECT and missing:
        got = f"none: ARCTIC withholds the motion of its test subject {WITHHELD_SUBJECT}"
        raise BadInput(missing[0], "a motion file", got, "nothing to do; its results are scored by ARCTIC's server")


def _read_motion(raw: RawTree, key: SequenceKey, hands: HandPair, with_body: bool) -> _Motion:
    _refuse_withheld(raw, key)
    paths = {kind: _found(raw, f"raw_seqs/{key.name}.{kind}") for kind in KINDS}
    pose_path, hand_path = paths["object.npy"], paths["mano.npy"]
    pose = checks.table(pose_path, load_npy_object(raw.file(pose_path)), 7)
    params = load_npy_object(raw.file(hand_path))
    tracks: dict[Side, HandTrack] = {}
    for side in SIDES:
        tracks[side] = _hand(f"{hand_path}: {side}", checks.entry(hand_path, params, side), side, hands)
        if tracks[side].n_frames != len(pose):
            got = f"{tracks[side].n_frames}"
            raise BadInput(f"{hand_path}: {side}", f"{len(pose)} frames as in {pose_path}", got)
    name = re.sub(r"\d+$", "", key.name.partition("/")[2].split("_")[0])
    track = ObjectTrack(
        _object_model(raw, name),
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
    misc = _found(raw, "meta/misc.json")
    offset = parse_misc(raw.read(misc), misc).get(subject, 0) if raw.has(misc) else 0
    return head_camera(path, load_npy_object(raw.file(path)), n_frames, offset)


def _hand(where: str, block: Any, side: Side, hands: HandPair) -> HandTrack:
    pose = checks.table(f"{where}.pose", checks.entry(where, block, "pose"), 45)
    rotation = checks.table(f"{where}.rot", checks.entry(where, block, "rot"), 3, len(pose))
    transl = checks.table(f"{where}.trans", checks.entry(where, block, "trans"), 3, len(pose))
    shape = np.asarray(checks.entry(where, block, "shape"))
    betas = checks.table(f"{where}.shape", shape[None] if shape.ndim == 1 else shape, 10)
    if len(betas) not in (1, len(pose)):
        raise BadInput(f"{where}.shape", f"10 numbers, or {len(pose)} rows of them", f"{len(betas)} rows")
    return to_track(SourceHand(transl, rotation, pose, betas), CONVENTION, hands[side])


def _object_model(raw: RawTree, name: str) -> ObjectModel:
    """The object's bottom.obj and top.obj where the release has both, else mesh.obj divided by parts.json."""
    folder = f"meta/object_vtemplates/{name}"
    mesh_path = _found(raw, f"{folder}/mesh.obj")
    part_path = _found(raw, f"{folder}/parts.json")
    mesh = raw_mesh(raw, mesh_path)
    is_base = parse_parts(raw.read(part_path), part_path, len(mesh.vertices))
    part_paths = [_found(raw, f"{folder}/{half}.obj") for half in ("bottom", "top")]
    if all(raw.has(path) for path in part_paths):
        mesh, is_base = _parts_joined([raw_mesh(raw, path) for path in part_paths], part_paths, mesh, mesh_path)
    hinge = Hinge(axis=np.array(HINGE_AXIS), origin_m=np.zeros(3))
    return ObjectModel(name, mesh.vertices * MILLIMETRES, mesh.faces, (~is_base).astype(np.uint8), hinge)


def _parts_joined(parts: list[Mesh], part_paths: list[str], whole: Mesh, whole_path: str) -> tuple[Mesh, np.ndarray]:
    """Base and moving part as one mesh, and which vertices (vertex,) are the base's.

    Raises BadInput where their bounding box is not that of the whole object's mesh, in millimetres.
    """
    base, moving = parts
    joined = Mesh(
        np.concatenate([base.vertices, moving.vertices]),
        np.concatenate([base.faces, moving.faces + len(base.vertices)]),
    )
    boxes = [np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)]) for mesh in (joined, whole)]
    difference_mm = float(np.abs(boxes[0] - boxes[1]).max())
    if difference_mm > PARTS_ALIGNED_MM:
        raise BadInput(
            ", ".join(part_paths),
            f"parts with the bounding box of {whole_path}, within {PARTS_ALIGNED_MM:g} mm",
            f"a difference of {difference_mm:.3g} mm",
            "remove both files to use mesh.obj and parts.json, or download them again",
        )
    return joined, np.arange(len(joined.vertices)) < len(base.vertices)
