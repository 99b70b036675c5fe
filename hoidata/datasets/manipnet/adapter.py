"""ManipNet (Zhang et al. 2021): motion capture of two hands and one object, in left-handed decimetres at 120 Hz.

The hands are 17-joint skeletons, not MANO: a MANO-layout hand is fitted to their joints and finger tips, with one shape
per recording. There are no action labels: the words come from the object's file name and from what it does.
To go right-handed, the world and every joint frame are seen in a mirror with normal x; meshes already are right-handed.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hoidata.clips.clip import FPS, SIDES, Clip, ObjectTrack, Side, WorldFrame
from hoidata.clips.hand_parameters import HandConvention, hand_track
from hoidata.clips.recording import HandRecording, OwnHandTrack
from hoidata.dataset_folders import facts_beside
from hoidata.datasets.base import DatasetPart, Described, Quarantined, RawTree, SequenceKey
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
from hoidata.errors import BadInput
from hoidata.geometry.intervals import widened
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair
from hoidata.hands.fitting import fit_hands, fit_shape
from hoidata.objects.distance import closest_points
from hoidata.objects.mesh import parse_obj
from hoidata.objects.model import ObjectModel

MESH_FOLDERS = ("objects/Primitive", "objects/Dining", "objects/recovered")
THUMB_CHAIN = ("THUMB_CMC_FE", "THUMB_CMC_AA", "THUMB_MCP_FE", "THUMB_IP_FE")
FINGERS = ("INDEX", "MIDDLE", "PINKY", "RING")  # in MANO's order; the files have ring before pinky
HAND_JOINTS = (
    "WRIST",
    *THUMB_CHAIN,
    *(f"{finger}_{joint}" for finger in ("INDEX", "MIDDLE", "RING", "PINKY") for joint in ("MCP", "PIP_FE", "DIP_FE")),
)
# The source joint behind each of MANO's 16; THUMB_CMC_FE has no counterpart.
MANO_JOINTS = (
    "WRIST",
    *(f"{finger}_{joint}" for finger in FINGERS for joint in ("MCP", "PIP_FE", "DIP_FE")),
    *THUMB_CHAIN[1:],
)
TIP_JOINTS = (*(f"{finger}_DIP_FE" for finger in FINGERS), "THUMB_IP_FE")
GRAVITY = np.array([0.0, -1.0, 0.0])
FRAME = WorldFrame("+y", "stated", "Unity's world seen in a mirror with normal x: right-handed, y up")
CONVENTION = HandConvention(
    translation="wrist",
    fingers="absolute",
    shape="fitted",
    left_shape="unused",
    note="17-joint skeletons: a MANO-layout hand was fitted to joints and tips, one shape per recording",
)
PARTS = (
    DatasetPart("object and hand motion", ("sequences/*/*.bvh.gz",), "the data release"),
    DatasetPart("object meshes", ("objects/*/*.obj.gz",), "the data release"),
    DatasetPart("the hand's capsules and tips", (HAND_REFERENCE,), "the data release"),
    DatasetPart("the hand's skin", (HAND_SKIN,), "the data release", optional=True),
)


@dataclass(frozen=True)
class Recording:
    """One two-hand sequence at 30 fps in the right-handed world, metres.

    source_frames: (frame,) index in the files. keypoints_m: per side (frame, 21, 3) in hoidata's joint order.
    rotation: (frame, 3, 3) and translation_m: (frame, 3) of the object. cuts: unusable stretches, in source frames.
    """

    source_fps: float
    source_frames: np.ndarray
    keypoints_m: dict[Side, np.ndarray]
    model: ObjectModel
    rotation: np.ndarray
    translation_m: np.ndarray
    cuts: list[Cut]
    paths: tuple[str, ...]

    def usable(self) -> np.ndarray:
        """(frame,) bool: not inside a cut."""
        good = np.ones(len(self.source_frames), dtype=bool)
        for cut in self.cuts:
            good &= (self.source_frames < cut.start) | (self.source_frames >= cut.stop)
        return good

    def lift_m(self) -> np.ndarray:
        """(frame,) height of the object's lowest vertex above the table; y is up."""
        heights = self.model.vertices_m @ self.rotation[:, 1].T + self.translation_m[:, 1]
        return height_above_table(heights.min(axis=0))

    def centre_m(self) -> np.ndarray:
        """(frame, 3) mean vertex of the object: its origin can lie 10 cm away from the mesh."""
        return self.rotation @ self.model.vertices_m.mean(axis=0) + self.translation_m

    def distances_m(self) -> dict[Side, np.ndarray]:
        """Per side (frame, 21) distance of each recorded keypoint from the object's surface."""
        return {
            side: surface_distances(self.model, self.rotation, self.translation_m, points)
            for side, points in self.keypoints_m.items()
        }


def surface_distances(
    model: ObjectModel, rotation: np.ndarray, translation_m: np.ndarray, points_m: np.ndarray
) -> np.ndarray:
    """(frame, point) distance of world points (frame, point, 3) from the placed object's surface, metres."""
    local = (points_m - translation_m[:, None]) @ rotation
    return closest_points(model.vertices_m, model.faces, local.reshape(-1, 3)).distance_m.reshape(local.shape[:2])


@dataclass(frozen=True)
class ManipNetAdapter(Described):
    """Raw root: ``sequences/<name>/*.bvh.gz``, ``objects/<group>/<object>.obj.gz``, ``hand/hand_reference.json``.

    margin_frames: frames (of 30 fps) kept before and after each interaction, as far as the tracking is usable; ids and
    verbs are those of the interaction itself. Sequences without hand files are refused with that reason.
    The shape of the hands is fitted to 100 frames of the recording itself: all are of one subject, but no clip may
    depend on which other recordings are there.
    """

    facts = facts_beside(__file__)
    margin_frames: int = 0
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION
    parts: tuple[DatasetPart, ...] = PARTS

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per folder below ``sequences``; all recordings are of one subject."""
        folders = sorted(path for path in (Path(root) / "sequences").glob("*") if path.is_dir())
        return [SequenceKey(self.name, self.name, folder.name) for folder in folders]

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """Clips of interaction of one sequence, and the stretches left out with their reasons."""
        recording = read_recording(raw, key.name)
        betas = fit_shape(recording.keypoints_m, hands)
        results: list[Clip | Quarantined] = [_left_out(key, *cut) for cut in recording.cuts]
        lift_m, centre_m, usable = recording.lift_m(), recording.centre_m(), recording.usable()
        nearest = np.minimum(*(distance.min(axis=1) for distance in recording.distances_m().values()))
        for stretch in interactions(usable, nearest < TOUCH_M, lift_m > LIFTED_M):
            frames = slice(*stretch)
            start, stop = (int(recording.source_frames[i]) for i in (stretch.start, stretch.stop - 1))
            verb = motion_verb(lift_m[frames], centre_m[frames], recording.rotation[frames])
            length = stretch.stop - stretch.start
            if length < SHORTEST_FRAMES:
                ends = [frame for frame in (stretch.start - 1, stretch.stop) if 0 <= frame < len(usable)]
                got = f"{length}" if usable[ends].all() else f"{length}, next to frames that are left out"
                results.append(_left_out(key, start, stop + 1, f"{SHORTEST_FRAMES} frames or more", got))
            elif verb is None:
                results.append(_left_out(key, start, stop + 1, "an object that moves", "one that stays on the table"))
            else:
                kept = widened(stretch, self.margin_frames, usable)
                sources = raw.recorded(*recording.paths)
                clip = self._clip(key, recording, kept, betas, hands)
                results.append(replace(clip, clip_id=_clip_id(key, start, stop), verb=verb, sources=sources))
        return results

    def recordings(self, raw: RawTree, key: SequenceKey) -> list[HandRecording]:
        """All frames with the 17-joint hands of the files; none where the skin's file is missing or not listed."""
        if not raw.has(HAND_SKIN) or (raw.manifest is not None and HAND_SKIN not in raw.manifest):
            return []
        return [read_hand_recording(raw, key)]

    def _clip(
        self, key: SequenceKey, recording: Recording, stretch: Interval, betas: np.ndarray, hands: HandPair
    ) -> Clip:
        """The frames of a stretch as a clip; its id, verb and sources are the caller's to say."""
        frames = slice(*stretch)
        fits = fit_hands({side: points[frames] for side, points in recording.keypoints_m.items()}, hands, betas)
        return Clip(
            clip_id=str(key),
            dataset=self.name,
            subject=key.subject,
            sequence=key.name,
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
    left, thing = motions["left"], _read_motion(raw, object_path)
    for path, motion in ((hand_paths["right"], motions["right"]), (object_path, thing)):
        if (motion.n_frames, motion.frame_time_s) != (left.n_frames, left.frame_time_s):
            expected = f"{left.n_frames} frames of {left.frame_time_s} s as in the left hand's file"
            raise BadInput(path, expected, f"{motion.n_frames} frames of {motion.frame_time_s} s")
    frames = thirty_fps_frames(thing.n_frames, thing.frame_time_s)
    tips = _read_tips(raw)
    positions, rotations = thing.at(frames).world_joints()
    return Recording(
        source_fps=round(1 / thing.frame_time_s, 3),
        source_frames=frames,
        keypoints_m={side: keypoints_m(motions[side].at(frames), side, tips) for side in SIDES},
        model=model,
        rotation=rotations[:, 0],
        translation_m=positions[:, 0] * METRES_PER_UNIT,
        cuts=find_cuts(
            _body("left hand", motions["left"]), _body("right hand", motions["right"]), _body("object", thing)
        ),
        paths=(*hand_paths.values(), object_path, mesh_path, HAND_REFERENCE),
    )


def read_hand_recording(raw: RawTree, key: SequenceKey) -> HandRecording:
    """One sequence with every frame of the files and their own hands. Raises BadInput as ``read_recording`` does."""
    recording = read_recording(raw, key.name)
    left, right, thing = (_read_motion(raw, path) for path in recording.paths[:3])
    usable = np.ones(thing.n_frames, dtype=bool)
    for cut in recording.cuts:
        usable[cut.start : cut.stop] = False
    world = _body("object", thing)
    return HandRecording(
        dataset=key.dataset,
        subject=key.subject,
        sequence=key.name,
        fps=recording.source_fps,
        hand=read_hand(raw, right),
        hands={"left": _own_hand(left), "right": _own_hand(right)},
        object=ObjectTrack(
            recording.model,
            rotmat_to_rotvec(world.rotation).astype(np.float32),
            world.position_m.astype(np.float32),
        ),
        usable=usable,
        gravity=GRAVITY,
        sources=raw.recorded(*recording.paths, HAND_SKIN),
    )


def _own_hand(motion: BvhMotion) -> OwnHandTrack:
    wrist_m = (motion.root_position + motion.offsets[0]) * METRES_PER_UNIT
    rotvec = rotmat_to_rotvec(angles_yxz_to_rotmat(motion.angles_yxz_rad))
    return OwnHandTrack(wrist_m.astype(np.float32), rotvec.astype(np.float32))


def keypoints_m(motion: BvhMotion, side: Side, tips: dict[str, np.ndarray]) -> np.ndarray:
    """(frame, 21, 3) world keypoints in hoidata's order of a hand motion already seen in the mirror, metres.

    tips: per joint the finger tip in that joint's frame, right hand, right-handed axes, source units.
    """
    positions, rotations = motion.world_joints()
    index = {joint: i for i, joint in enumerate(motion.names)}
    points = [positions[:, index[joint]] for joint in MANO_JOINTS]
    for joint in TIP_JOINTS:
        tip = tips[joint] if side == "right" else tips[joint] * MIRROR_X
        points.append(positions[:, index[joint]] + rotations[:, index[joint]] @ tip)
    return np.stack(points, axis=1) * METRES_PER_UNIT


def thirty_fps_frames(n_frames: int, frame_time_s: float) -> np.ndarray:
    """The source frame nearest to each 1/30 s, from frame 0 on: every 4th frame of a 120 Hz file."""
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
    found = [f"{folder}/{name}.obj.gz" for folder in MESH_FOLDERS if raw.has(f"{folder}/{name}.obj.gz")]
    if not found:
        raise BadInput(f"objects/*/{name}.obj.gz", "the mesh of the recorded object", "nothing there")
    mesh = parse_obj(unpack_text(raw.read(found[0]), found[0]), found[0])
    vertices_m = mesh.vertices * METRES_PER_UNIT
    return found[0], ObjectModel(name, vertices_m, mesh.faces, np.zeros(len(vertices_m), dtype=np.uint8))


def _read_motion(raw: RawTree, path: str) -> BvhMotion:
    return parse_bvh(unpack_text(raw.read(path), path), path).seen_in_mirror_x()


def _read_tips(raw: RawTree) -> dict[str, np.ndarray]:
    """Finger tips of the right hand in the frames of the last joints, right-handed axes, source units."""
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
    """The root of a motion, and all its numbers."""
    root = replace(
        motion, names=motion.names[:1], parents=motion.parents[:1], angles_yxz_rad=motion.angles_yxz_rad[:, :1]
    )
    positions, rotations = root.world_joints()
    raw = np.concatenate((motion.root_position, motion.angles_yxz_rad.reshape(motion.n_frames, -1)), axis=1)
    return BodyMotion(name, positions[:, 0] * METRES_PER_UNIT, rotations[:, 0], raw)


def _clip_id(key: SequenceKey, start: int, last: int) -> str:
    """From source frames, both included."""
    return f"{key}/{start:06d}-{last:06d}"


def _left_out(key: SequenceKey, start: int, stop: int, expected: str, got: str) -> Quarantined:
    where = f"sequences/{key.name}, source frames {start} to {stop - 1}"
    return Quarantined(_clip_id(key, start, stop - 1), where, expected, got, "nothing to do: they are left out")
