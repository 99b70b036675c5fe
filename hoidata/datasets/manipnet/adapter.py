"""ManipNet (Zhang et al. 2021): motion capture of two hands and one object, in left-handed decimetres at 120 Hz.

The hands are 17-joint skeletons: a MANO-layout hand is fitted to their joints and fingertips, with one shape per
recording. There are no action labels: the noun comes from the object's file name and the verb from its motion.
Negating x of the world and of every joint frame makes the motion right-handed. Meshes already are right-handed.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, ObjectTrack, Side, WorldFrame
from hoidata.clips.hand_parameters import HandConvention, hand_track
from hoidata.clips.recording import HandRecording, SourceHandTrack
from hoidata.dataset_folders import facts_of_adapter
from hoidata.datasets.base import AdapterBase, DatasetPart, Quarantined, RawTree, SequenceKey
from hoidata.datasets.manipnet.hand import (
    HAND_REFERENCE,
    HAND_SKIN,
    LARGEST_REFERENCE,
    METRES_PER_UNIT,
    MIRROR_X,
    BvhMotion,
    angles_yxz_to_rotmat,
    parse_bvh,
    read_hand,
    unpack_text,
)
from hoidata.datasets.manipnet.segments import (
    LIFTED_M,
    SHORTEST_FRAMES,
    TOUCH_M,
    BodyMotion,
    Cut,
    Interval,
    find_cuts,
    height_above_table,
    interactions,
    motion_verb,
    object_words,
)
from hoidata.datasets.segments import segment_clips
from hoidata.errors import BadInput
from hoidata.geometry.intervals import runs, widened
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair
from hoidata.hands.fitting import fit_hands, fit_shape
from hoidata.objects.distance import closest_points
from hoidata.objects.mesh import parse_obj
from hoidata.objects.model import ObjectModel

MESH_FOLDERS = ("objects/Primitive", "objects/Dining", "objects/recovered")
THUMB_CHAIN = ("THUMB_CMC_FE", "THUMB_CMC_AA", "THUMB_MCP_FE", "THUMB_IP_FE")
FINGERS = ("INDEX", "MIDDLE", "PINKY", "RING")  # in MANO's order; the files have ring before pinky
_JOINTS_OF = {finger: tuple(f"{finger}_{joint}" for joint in ("MCP", "PIP_FE", "DIP_FE")) for finger in FINGERS}
_INDEX, _MIDDLE, _PINKY, _RING = _JOINTS_OF.values()
HAND_JOINTS = ("WRIST", *THUMB_CHAIN, *_INDEX, *_MIDDLE, *_RING, *_PINKY)
# Source joint of each of MANO's 16 joints; THUMB_CMC_FE has no counterpart.
MANO_JOINTS = ("WRIST", *_INDEX, *_MIDDLE, *_PINKY, *_RING, *THUMB_CHAIN[1:])
TIP_JOINTS = (*(f"{finger}_DIP_FE" for finger in FINGERS), "THUMB_IP_FE")
GRAVITY = np.array([0.0, -1.0, 0.0])
FRAME = WorldFrame("+y", "stated", "Unity's world seen in a mirror with normal x: right-handed, y up")
HAND_NOTE = "17-joint skeletons: a MANO-layout hand was fitted to joints and tips, one shape per recording"
CONVENTION = HandConvention(
    translation="wrist", fingers="absolute", shape="fitted", left_shape="unused", note=HAND_NOTE
)
PARTS = (
    DatasetPart("object and hand motion", ("sequences/*/*.bvh.gz",), "the data release"),
    DatasetPart("object meshes", ("objects/*/*.obj.gz",), "the data release"),
    DatasetPart("the hand's capsules and tips", (HAND_REFERENCE,), "the data release"),
    DatasetPart("the hand's skin", (HAND_SKIN,), "the data release", optional=True),
)


@dataclass(frozen=True)
class Recording:
    """One two-hand sequence at 30 fps in the right-handed world, metres."""

    source_fps: float
    source_frames: np.ndarray  # (frame,) index in the files
    keypoints_m: dict[Side, np.ndarray]  # (frame, 21, 3) in hoidata's joint order
    model: ObjectModel
    rotation: np.ndarray  # (frame, 3, 3) of the object
    translation_m: np.ndarray  # (frame, 3) of the object
    cuts: list[Cut]  # unusable intervals, in source frames
    paths: tuple[str, ...]  # source files

    def usable(self) -> np.ndarray:
        """(frame,) bool: the frame is outside of all cuts."""
        good = np.ones(len(self.source_frames), dtype=bool)
        for cut in self.cuts:
            good &= (self.source_frames < cut.start) | (self.source_frames >= cut.stop)
        return good

    def lift_m(self) -> np.ndarray:
        """(frame,) height of the object's lowest vertex above the table; y is up."""
        heights = self.model.vertices_m @ self.rotation[:, 1].T + self.translation_m[:, 1]
        return height_above_table(heights.min(axis=0))

    def centre_m(self) -> np.ndarray:
        """(frame, 3) mean vertex of the object, because its origin can be 10 cm away from the mesh."""
        return self.rotation @ self.model.vertices_m.mean(axis=0) + self.translation_m

    def distances_m(self) -> dict[Side, np.ndarray]:
        """Per side (frame, 21) distance of each recorded keypoint from the object's surface."""
        pose = self.model, self.rotation, self.translation_m
        return {side: surface_distances(*pose, points) for side, points in self.keypoints_m.items()}


def surface_distances(
    model: ObjectModel, rotation: np.ndarray, translation_m: np.ndarray, points_m: np.ndarray
) -> np.ndarray:
    """(frame, point) distance of world points (frame, point, 3) from the placed object's surface, metres."""
    local = (points_m - translation_m[:, None]) @ rotation
    return closest_points(model.vertices_m, model.faces, local.reshape(-1, 3)).distance_m.reshape(local.shape[:2])


@dataclass(frozen=True)
class ManipNetAdapter(AdapterBase):
    """Raw root: ``sequences/<name>/*.bvh.gz``, ``objects/<group>/<object>.obj.gz``, ``hand/hand_reference.json``.

    Sequences without hand files are quarantined. The hand shape is fitted to 100 frames of each recording. All
    recordings are of one subject, but a clip must not depend on other recordings.
    """

    facts = facts_of_adapter(__file__)
    # At 30 fps: usable frames kept before and after each interaction. Ids and verbs describe the interaction alone.
    margin_frames: int = 0
    clips: Literal["interactions", "segments"] = "interactions"  # at most one lift each with its verb, or segments
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION
    parts: tuple[DatasetPart, ...] = PARTS

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per folder below ``sequences``. All recordings are of one subject."""
        folders = sorted(path for path in (Path(root) / "sequences").glob("*") if path.is_dir())
        return [SequenceKey(self.name, self.name, folder.name) for folder in folders]

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """One clip per interaction or segment of one sequence, and reasons for rejected intervals."""
        recording = read_recording(raw, key.name)
        betas = fit_shape(recording.keypoints_m, hands)
        results: list[Clip | Quarantined] = [_rejected(key, *cut) for cut in recording.cuts]
        lift_m, centre_m, usable = recording.lift_m(), recording.centre_m(), recording.usable()
        nearest = np.minimum(*(distance.min(axis=1) for distance in recording.distances_m().values()))
        in_segments = self.clips == "segments"
        intervals = runs(usable) if in_segments else interactions(usable, nearest < TOUCH_M, lift_m > LIFTED_M)
        for interval in intervals:
            frames = slice(*interval)
            start, stop = (int(recording.source_frames[i]) for i in (interval.start, interval.stop - 1))
            verb = None if in_segments else motion_verb(lift_m[frames], centre_m[frames], recording.rotation[frames])
            length = interval.stop - interval.start
            if length < SHORTEST_FRAMES:
                ends = [frame for frame in (interval.start - 1, interval.stop) if 0 <= frame < len(usable)]
                got = f"{length}" if usable[ends].all() else f"{length}, next to frames that are left out"
                results.append(_rejected(key, start, stop + 1, f"{SHORTEST_FRAMES} frames or more", got))
            elif verb is None and not in_segments:
                results.append(_rejected(key, start, stop + 1, "an object that moves", "one that stays on the table"))
            else:
                frames_with_margin = widened(interval, self.margin_frames, usable)
                sources = raw.recorded(*recording.paths)
                clip = self._clip(key, recording, frames_with_margin, betas, hands)
                results.append(replace(clip, clip_id=_clip_id(key, start, stop), verb=verb, sources=sources))
        return list(segment_clips(results, hands)) if in_segments else results

    def recordings(self, raw: RawTree, key: SequenceKey) -> list[HandRecording]:
        """All frames with the 17-joint hands of the files; empty if the skin's file is missing or not listed."""
        if not raw.has(HAND_SKIN) or (raw.manifest is not None and HAND_SKIN not in raw.manifest):
            return []
        return [read_hand_recording(raw, key)]

    def _clip(
        self, key: SequenceKey, recording: Recording, interval: Interval, betas: np.ndarray, hands: HandPair
    ) -> Clip:
        """The frames of an interval as a clip. The caller replaces id, verb and sources."""
        frames = slice(*interval)
        fits = fit_hands({side: points[frames] for side, points in recording.keypoints_m.items()}, hands, betas)
        return self.new_clip(
            key,
            hands={side: hand_track(f.wrist_m, f.global_orient, f.hand_pose, f.betas) for side, f in fits.items()},
            object=ObjectTrack(
                recording.model,
                rotmat_to_rotvec(recording.rotation[frames]).astype(np.float32),
                recording.translation_m[frames].astype(np.float32),
            ),
            source_frames=recording.source_frames[frames].astype(np.int32),
            gravity=GRAVITY,
            verb=None,
            object_words=object_words(recording.model.name),
            source_from_world=np.diag([*(MIRROR_X / METRES_PER_UNIT), 1.0]),
            source_fps=recording.source_fps,
            hands_from="keypoints",
            fit_error_m=float(np.mean([fits[side].error_m for side in SIDES])),
        )


def read_recording(raw: RawTree, name: str) -> Recording:
    """Read one sequence and convert it to 30 fps, metres and a right-handed world. Raises BadInput."""
    folder = f"sequences/{name}"
    hand_paths = {side: f"{folder}/{side}Hand.bvh.gz" for side in SIDES}
    missing = [path for path in hand_paths.values() if not raw.has(path)]
    if missing:
        got = "object motion only" if len(missing) == len(SIDES) else f"no {missing[0]}"
        raise BadInput(folder, "motion of both hands", got, "nothing to do: it is released without them")
    object_path = _object_path(raw, folder)
    mesh_path, model = _read_model(raw, object_path)
    motions = {side: _read_motion(raw, path) for side, path in hand_paths.items()}
    for side, motion in motions.items():
        if motion.names != HAND_JOINTS:
            expected = f"the {len(HAND_JOINTS)} joints WRIST to PINKY_DIP_FE"
            raise BadInput(hand_paths[side], expected, f"{len(motion.names)} joints")
    left, object_motion = motions["left"], _read_motion(raw, object_path)
    for path, motion in ((hand_paths["right"], motions["right"]), (object_path, object_motion)):
        if (motion.n_frames, motion.frame_time_s) != (left.n_frames, left.frame_time_s):
            expected = f"{left.n_frames} frames of {left.frame_time_s} s as in the left hand's file"
            raise BadInput(path, expected, f"{motion.n_frames} frames of {motion.frame_time_s} s")
    frames = thirty_fps_frames(object_motion.n_frames, object_motion.frame_time_s)
    tips = _read_tips(raw)
    positions, rotations = object_motion.at(frames).world_joints()
    bodies = {"left hand": left, "right hand": motions["right"], "object": object_motion}
    return Recording(
        source_fps=round(1 / object_motion.frame_time_s, 3),
        source_frames=frames,
        keypoints_m={side: keypoints_m(motions[side].at(frames), side, tips) for side in SIDES},
        model=model,
        rotation=rotations[:, 0],
        translation_m=positions[:, 0] * METRES_PER_UNIT,
        cuts=find_cuts(*(_body(name, motion) for name, motion in bodies.items())),
        paths=(*hand_paths.values(), object_path, mesh_path, HAND_REFERENCE),
    )


def read_hand_recording(raw: RawTree, key: SequenceKey) -> HandRecording:
    """Read one sequence with every frame of the files and their 17-joint hands. Raises BadInput."""
    recording = read_recording(raw, key.name)
    left, right, object_motion = (_read_motion(raw, path) for path in recording.paths[:3])
    usable = np.ones(object_motion.n_frames, dtype=bool)
    for cut in recording.cuts:
        usable[cut.start : cut.stop] = False
    body = _body("object", object_motion)
    rotvec, position_m = rotmat_to_rotvec(body.rotation).astype(np.float32), body.position_m.astype(np.float32)
    return HandRecording(
        dataset=key.dataset,
        subject=key.subject,
        sequence=key.name,
        fps=recording.source_fps,
        hand=read_hand(raw, right),
        hands={"left": _hand_track(left), "right": _hand_track(right)},
        object=ObjectTrack(recording.model, rotvec, position_m),
        usable=usable,
        gravity=GRAVITY,
        sources=raw.recorded(*recording.paths, HAND_SKIN),
    )


def _hand_track(motion: BvhMotion) -> SourceHandTrack:
    wrist_m = (motion.root_position + motion.offsets[0]) * METRES_PER_UNIT
    rotvec = rotmat_to_rotvec(angles_yxz_to_rotmat(motion.angles_yxz_rad))
    return SourceHandTrack(wrist_m.astype(np.float32), rotvec.astype(np.float32))


def keypoints_m(motion: BvhMotion, side: Side, tips: dict[str, np.ndarray]) -> np.ndarray:
    """World keypoints (frame, 21, 3) of a right-handed hand motion in hoidata's order, metres.

    tips: fingertip by joint in the joint's frame, of the right hand, right-handed, source units.
    """
    positions, rotations = motion.world_joints()
    index = {joint: i for i, joint in enumerate(motion.names)}
    points = [positions[:, index[joint]] for joint in MANO_JOINTS]
    for joint in TIP_JOINTS:
        tip = tips[joint] if side == "right" else tips[joint] * MIRROR_X
        points.append(positions[:, index[joint]] + rotations[:, index[joint]] @ tip)
    return np.stack(points, axis=1) * METRES_PER_UNIT


def thirty_fps_frames(n_frames: int, frame_time_s: float) -> np.ndarray:
    """The source frame closest to each multiple of 1/30 s: every 4th frame of a 120 Hz file."""
    count = int(np.floor((n_frames - 1) * frame_time_s * FPS + 1e-3)) + 1
    frames = np.rint(np.arange(count) / (FPS * frame_time_s)).astype(int)
    return frames[frames < n_frames]


def _object_path(raw: RawTree, folder: str) -> str:
    names = [name for name in raw.names(folder, ".bvh.gz") if name not in ("leftHand.bvh.gz", "rightHand.bvh.gz")]
    if len(names) != 1:
        raise BadInput(folder, "motion of one object", f"{len(names)}: {', '.join(names) or 'none'}")
    return f"{folder}/{names[0]}"


def _read_model(raw: RawTree, object_path: str) -> tuple[str, ObjectModel]:
    name = Path(object_path).name.removesuffix(".bvh.gz")
    mesh_paths = [f"{folder}/{name}.obj.gz" for folder in MESH_FOLDERS if raw.has(f"{folder}/{name}.obj.gz")]
    if not mesh_paths:
        raise BadInput(f"objects/*/{name}.obj.gz", "the mesh of the recorded object", "nothing there")
    mesh = parse_obj(unpack_text(raw.read(mesh_paths[0]), mesh_paths[0]), mesh_paths[0])
    vertices_m = mesh.vertices * METRES_PER_UNIT
    return mesh_paths[0], ObjectModel(name, vertices_m, mesh.faces, np.zeros(len(vertices_m), dtype=np.uint8))


def _read_motion(raw: RawTree, path: str) -> BvhMotion:
    return parse_bvh(unpack_text(raw.read(path), path), path).seen_in_mirror_x()


def _read_tips(raw: RawTree) -> dict[str, np.ndarray]:
    """Fingertips of the right hand by last joint of the finger, in the joint's frame, right-handed, source units."""
    try:
        capsules = json.loads(raw.read(HAND_REFERENCE, LARGEST_REFERENCE))["capsules"]
        ends = {capsule["joint"]: np.array(capsule["end_local"], dtype=np.float64) for capsule in capsules}
        tips = {joint: ends[joint] * MIRROR_X for joint in TIP_JOINTS}
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        expected = f"capsules with joint and end_local for {', '.join(TIP_JOINTS)}"
        raise BadInput(HAND_REFERENCE, expected, f"{type(error).__name__}: {error}") from error
    if any(tip.shape != (3,) or not np.isfinite(tip).all() for tip in tips.values()):
        raise BadInput(HAND_REFERENCE, "three finite numbers per capsule end", "something else")
    return tips


def _body(name: str, motion: BvhMotion) -> BodyMotion:
    """Position and rotation of a BVH file's root joint, and the values of all its channels."""
    first = {"names": motion.names[:1], "parents": motion.parents[:1], "angles_yxz_rad": motion.angles_yxz_rad[:, :1]}
    positions, rotations = replace(motion, **first).world_joints()
    raw = np.concatenate((motion.root_position, motion.angles_yxz_rad.reshape(motion.n_frames, -1)), axis=1)
    return BodyMotion(name, positions[:, 0] * METRES_PER_UNIT, rotations[:, 0], raw)


def _clip_id(key: SequenceKey, start: int, last: int) -> str:
    """Clip id from source frames, both included."""
    return f"{key}/{start:06d}-{last:06d}"


def _rejected(key: SequenceKey, start: int, stop: int, expected: str, got: str) -> Quarantined:
    location = f"sequences/{key.name}, source frames {start} to {stop - 1}"
    remedy = "nothing to do: they are left out"
    return Quarantined(_clip_id(key, start, stop - 1), where=location, expected=expected, got=got, remedy=remedy)
