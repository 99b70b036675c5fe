"""HOI4D (Liu et al. 2022): a head-worn camera, MANO hands, rigid and hinged objects, 15 frames per second.

All numbers are in the camera's frame; the world is that of the camera's own trajectory, whose axes nobody states. Clips
have 30 frames per second, of which every second one is made (``twice_frames``).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from hoidata.clips.clip import SIDES, CameraTrack, Clip, HandTrack, HandType, ObjectTrack, Side, WorldFrame
from hoidata.clips.hand_parameters import FrameChange, HandConvention, SourceHand, to_track
from hoidata.dataset_folders import facts_beside
from hoidata.datasets.base import DatasetPart, Described, Quarantined, RawTree, SequenceKey
from hoidata.datasets.gaps import bridge, has_pose, missing_poses, numbered, trimmed
from hoidata.datasets.gravity import TrackedObject, estimate_gravity
from hoidata.datasets.hinge import box_corners, fit_hinge, hinged_model
from hoidata.datasets.hoi4d.files import (
    CATEGORIES,
    EVENTS,
    TASKS,
    Category,
    PartPose,
    ShortPose,
    action_events,
    camera_poses,
    frame_numbers,
    hand_frame,
    hinge_joint,
    object_poses,
)
from hoidata.datasets.hoi4d.parts import (
    aligned_from_whole,
    matched,
    twice_frames,
    twice_hand,
    twice_rotvecs,
    twice_values,
)
from hoidata.datasets.known_meshes import raw_mesh
from hoidata.errors import BadInput
from hoidata.geometry.intervals import runs
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair, track_joints
from hoidata.objects.model import Hinge, ObjectModel
from hoidata.objects.resting import footing

ANNOTATIONS, MODELS = "HOI4D_annotations", "HOI4D_CAD_Model_for_release"
CLIP = "ZY*/H*/C*/N*/S*/s*/T*"
HAND_FOLDERS = ("handpose/refinehandpose_{}", "Hand_pose/handpose_{}_hand")  # an older download, the current one
FRAME = WorldFrame(None, "estimated", "the world of the camera's trajectory, right-handed, metres, axes not documented")
CONVENTION = HandConvention(
    translation="transl",
    fingers="absolute",
    shape="betas per sequence",
    left_shape="as released",
    note="MANO: absolute axis-angles, one shape per person, translation added to the rest wrist, camera frame",
)
# A folder of frame files is one source, so it is named as well as its files.
_HANDS = tuple(
    f"{folder.format(side)}/{CLIP}{files}" for folder in HAND_FOLDERS for side in SIDES for files in ("/*.pickle", "")
)
_POSES = tuple(f"{ANNOTATIONS}/{CLIP}/objpose{files}" for files in ("/*.json", ""))
PARTS = (
    DatasetPart("object poses", _POSES, "HOI4D_annotations.zip"),
    DatasetPart("camera trajectory", (f"{ANNOTATIONS}/{CLIP}/3Dseg/output.log",), "HOI4D_annotations.zip"),
    DatasetPart("hand poses", _HANDS, "HOI4D_Handpose.zip"),
    DatasetPart(
        "object meshes", (f"{MODELS}/rigid/*/*.obj", f"{MODELS}/articulated/*/*/objs/*.obj"), "HOI4D_CAD_models.zip"
    ),
    DatasetPart(
        "hinges",
        (f"{MODELS}/articulated/*/*/mobility_v2.json", f"{MODELS}/articulated/*/*/result.json"),
        "HOI4D_CAD_models.zip",
        optional=True,
    ),
)
EVENT_FILES = (f"{ANNOTATIONS}/{CLIP}/action/color.json",)
Cut = Literal["described", "whole"]


class _Object(NamedTuple):
    """track, tracked (frame,): at 30 fps, short gaps bridged and poses of the source or made between two of them.

    recorded: (frame,) poses of the source. note: how boxes and hinge fit. left_out: frames too far off the hinge.
    """

    track: ObjectTrack
    tracked: np.ndarray
    recorded: np.ndarray
    note: str
    left_out: list[Quarantined]


class _Wanted(NamedTuple):
    """A range of source frames, half-open. verb, hand: as the source says, else None. clip_id: where it is whole."""

    clip_id: str
    start: int
    stop: int
    verb: str | None
    hand: HandType | None


@dataclass(frozen=True)
class Hoi4dAdapter(Described):
    """Raw root: the folder with ``HOI4D_annotations``, the CAD models, and ``handpose`` or ``Hand_pose``.

    clips: "described" gives one clip per event of ``action/color.json`` in which something is done to the object;
    "whole" one clip per recording. margin_frames: kept before and after each event; shortest_frames: shorter ones are
    no clips; both at 30 fps. most_off_mm, most_off_deg: frames in which two tracked parts lie farther off their hinge
    are left out.
    """

    facts = facts_beside(__file__)
    margin_frames: int = 0
    shortest_frames: int = 20
    clips: Cut = "described"
    most_off_mm: int = 20
    most_off_deg: int = 10
    frame: WorldFrame = FRAME
    hand_convention: HandConvention = CONVENTION

    @property
    def parts(self) -> tuple[DatasetPart, ...]:
        """Events are needed only where clips are cut by them."""
        optional = self.clips == "whole"
        return (*PARTS, DatasetPart("events", EVENT_FILES, "HOI4D_annotations.zip", optional, "clips=whole"))

    def sequences(self, root: Path) -> list[SequenceKey]:
        """One key per recording that has a folder of annotations; its subject is the person, ``H2``."""
        found = [path for path in Path(root).glob(f"{ANNOTATIONS}/{CLIP}") if path.is_dir()]
        names = ["/".join(path.parts[-7:]) for path in found]
        return sorted(SequenceKey(self.name, name.split("/")[1], name) for name in names)

    def load(self, raw: RawTree, key: SequenceKey, hands: HandPair) -> list[Clip | Quarantined]:
        """Clips of one recording; events, frames and hand files that cannot be used, with their reasons."""
        category = _category(key)
        camera = camera_poses(raw.read(path := f"{ANNOTATIONS}/{key.name}/3Dseg/output.log"), path)
        thing = self._object(raw, key, category, camera)
        tracks, results = _hands(raw, key, camera, hands)
        wanted, unknown = self._wanted(raw, key, len(camera))
        eyes = CameraTrack(
            key.name.partition("/")[0],
            twice_rotvecs(rotmat_to_rotvec(camera[:, :3, :3])).astype(np.float32),
            twice_values(camera[:, :3, 3]).astype(np.float32),
            twice_frames(len(camera)).astype(np.int32),
        )
        gravity, gravity_note = _gravity(thing, tracks, camera, hands)
        whole = Clip(
            clip_id=str(key),
            dataset=self.name,
            subject=key.subject,
            sequence=key.name,
            hands=tracks,
            object=thing.track,
            source_frames=numbered(eyes.images, thing.recorded),
            gravity=gravity,
            gravity_note=f"{gravity_note}; {thing.note}",
            verb=None,
            object_words=category.words,
            sources=raw.sources,
            source_fps=self.source_fps,
            camera=eyes,
        )
        return [*results, *thing.left_out, *unknown, *self._cut(whole, eyes.images, wanted, thing)]

    def _cut(
        self, whole: Clip, numbers: np.ndarray, wanted: list[_Wanted], thing: _Object
    ) -> Iterator[Clip | Quarantined]:
        """The stretches of each wanted range in which the object has a pose. numbers: (frame,) frames of the source."""
        for item in wanted:
            start, stop = max(0, 2 * item.start - self.margin_frames), 2 * item.stop - 1 + self.margin_frames
            inside, where = slice(start, stop), f"{ANNOTATIONS}/{whole.sequence}/objpose"
            found = [(start + a, start + b) for a, b in runs(has_pose(thing.tracked)[inside])]
            pieces = [trimmed(piece, thing.recorded) for piece in found]
            yield from missing_poses(
                f"{item.clip_id}/missing", where, "the object", numbers[inside], thing.tracked[inside]
            )
            long = [piece for piece in pieces if piece[1] - piece[0] >= self.shortest_frames]
            if not long:
                got = f"{max((b - a for a, b in pieces), default=0)} in frames {item.start} to {item.stop - 1}"
                expected = f"{self.shortest_frames} frames (at 30 per second) with the object"
                yield Quarantined(item.clip_id, whole.clip_id, expected, got, "nothing to do, or lower shortest_frames")
            for a, b in long:
                frames = (int(whole.source_frames[a]), int(whole.source_frames[b - 1]) + 1)
                name = item.clip_id if len(long) == 1 else f"{whole.clip_id}/{frames[0]:04d}-{frames[1]:04d}"
                yield replace(whole.take(slice(a, b)), clip_id=name, verb=item.verb, labelled_hand=item.hand)

    def _wanted(self, raw: RawTree, key: SequenceKey, n_frames: int) -> tuple[list[_Wanted], list[Quarantined]]:
        """Ranges that are to be clips, and events whose word nobody knows."""
        if self.clips == "whole":
            _, _, category, *_, task = key.name.split("/")
            return [_Wanted(str(key), 0, n_frames, TASKS.get((category, task)), None)], []
        path = f"{ANNOTATIONS}/{key.name}/action/color.json"
        if not raw.has(path) and path not in (raw.manifest or ()):
            remedy = "unpack HOI4D_annotations.zip here, or set clips: whole, which needs no events"
            raise BadInput(path, "a file with the events of the recording", "nothing there", remedy)
        wanted, unknown = dict[tuple[int, int], _Wanted](), list[Quarantined]()
        for event in action_events(raw.read(path), path):
            start, stop = event.start, min(event.stop, n_frames)
            word, clip_id = event.word.lower(), f"{key}/{start:04d}-{stop:04d}"
            if word not in EVENTS:
                expected = f"one of {', '.join(EVENTS)}"
                unknown.append(Quarantined(clip_id, path, expected, repr(event.word)[:40], "nothing to do"))
            elif (action := EVENTS[word]) is not None and stop > start:
                wanted[start, stop] = _Wanted(clip_id, start, stop, *action)
        return list(wanted.values()), unknown

    def _object(self, raw: RawTree, key: SequenceKey, category: Category, camera: np.ndarray) -> _Object:
        folder = f"{ANNOTATIONS}/{key.name}/objpose"
        numbers = frame_numbers(folder, raw.names(folder, ".json"))
        if not numbers or max(numbers) >= len(camera):
            got = f"{len(numbers)} files, the last of frame {max(numbers, default=-1)}"
            raise BadInput(folder, f"object poses of frames 0 to {len(camera) - 1}, as output.log has", got)
        frames = np.array(sorted(numbers))
        names = [numbers[frame] for frame in frames]
        contents = _read_frames(raw, folder, names)
        poses = [object_poses(data, f"{folder}/{name}") for name, data in zip(names, contents, strict=True)]
        labels = [pose.label for pose in poses[0]]
        for name, own in zip(names, poses, strict=True):
            if [pose.label for pose in own] != labels:
                raise BadInput(f"{folder}/{name}", f"the parts {', '.join(labels)}", ", ".join(p.label for p in own))
        tracked = np.zeros(len(camera), bool)
        tracked[frames] = True
        boxes = [camera[frames] @ _transforms([own[number] for own in poses]) for number in range(len(labels))]
        extents = np.array([pose.extents_m for pose in poses[0]])
        build = self._hinged if category.hinged else _rigid
        return build(raw, key, category, extents, boxes, tracked)

    def _hinged(
        self,
        raw: RawTree,
        key: SequenceKey,
        category: Category,
        extents_m: np.ndarray,
        boxes: list[np.ndarray],
        tracked: np.ndarray,
    ) -> _Object:
        where = f"{ANNOTATIONS}/{key.name}/objpose"
        model, names, whole_from = _hinged_model(raw, category, _instance(key))
        corners = [model.vertices_m[model.part == part] for part in (0, 1)]
        aligned = [own @ turn[:3, :3].T + turn[:3, 3] for own, turn in zip(corners, whole_from, strict=True)]
        chosen, ratio = matched(where, extents_m, names, np.array([np.ptp(own, axis=0) for own in aligned]))
        seen = [boxes[box] @ turn for box, turn in zip(chosen, whole_from, strict=True)]
        assert model.hinge is not None
        fit = fit_hinge(seen[0], seen[1], model.hinge, (box_corners(corners[0]), box_corners(corners[1])))
        frames, off = np.flatnonzero(tracked), fit.off(self.most_off_mm, self.most_off_deg)
        tracked[frames[off]] = False
        limits = (self.most_off_mm, self.most_off_deg)
        left_out = [fit.left_out(f"{key}/hinge", where, frames, *limits)] if off.any() else []
        note = f"{fit.note}; {_box_note(ratio, aligned)}"
        return _placed(model, fit.world_from_object, fit.hinge_rad, frames, tracked, note, left_out)


def _category(key: SequenceKey) -> Category:
    name = key.name.split("/")[2]
    if name not in CATEGORIES:
        raise BadInput(str(key), f"a category among {', '.join(CATEGORIES)}", name, "nothing to do")
    return CATEGORIES[name]


def _instance(key: SequenceKey) -> str:
    number = key.name.split("/")[3][1:]
    if not number.isdecimal():
        raise BadInput(str(key), "an object number such as N12", number, "restore the folder's name")
    return f"{int(number):03d}"


def _transforms(poses: list[PartPose]) -> np.ndarray:
    """(frame, 4, 4) camera from the part's own mesh."""
    found = np.tile(np.eye(4), (len(poses), 1, 1))
    found[:, :3, :3] = [pose.rotation for pose in poses]
    found[:, :3, 3] = [pose.centre_m for pose in poses]
    return found


def _rigid(
    raw: RawTree,
    key: SequenceKey,
    category: Category,
    extents_m: np.ndarray,
    boxes: list[np.ndarray],
    tracked: np.ndarray,
) -> _Object:
    number = _instance(key)
    mesh = raw_mesh(raw, f"{MODELS}/rigid/{category.folder}/{number}.obj")
    name = f"{category.folder.lower()}_{number}"
    (chosen,), ratio = matched(
        f"{ANNOTATIONS}/{key.name}/objpose", extents_m, [name], np.ptp(mesh.vertices, axis=0)[None]
    )
    model = ObjectModel(name, mesh.vertices, mesh.faces, np.zeros(len(mesh.vertices), np.uint8))
    note = _box_note(ratio, [mesh.vertices])
    return _placed(model, boxes[chosen], None, np.flatnonzero(tracked), tracked, note, [])


def _hinged_model(raw: RawTree, category: Category, number: str) -> tuple[ObjectModel, list[str], list[np.ndarray]]:
    """The whole object at rest; the names of its two meshes, base first; each one's own frame from the whole (4, 4)."""
    folder = f"{MODELS}/articulated/{category.folder}/{number}"
    mobility, tree = f"{folder}/mobility_v2.json", f"{folder}/result.json"
    joint = hinge_joint(raw.read(mobility), raw.read(tree), mobility, tree)
    names = [joint.base, joint.moving]
    meshes = [raw_mesh(raw, f"{folder}/objs/{name}.obj") for name in names]
    paths = [f"{folder}/objs/{name}-align.obj" for name in names]
    own = [raw_mesh(raw, path).vertices for path in paths]
    turns = [aligned_from_whole(*item) for item in zip(paths, own, [mesh.vertices for mesh in meshes], strict=True)]
    faces = [mesh.faces for mesh in meshes]
    vertices, hinge = [mesh.vertices for mesh in meshes], Hinge(joint.axis, joint.origin_m)
    model = hinged_model(f"{category.folder.lower()}_{number}", vertices, faces, hinge)
    return model, names, turns


def _box_note(ratio: np.ndarray, aligned_m: list[np.ndarray]) -> str:
    """How annotated boxes compare with the meshes, which are not resized."""
    off = max(float(np.linalg.norm((own.min(axis=0) + own.max(axis=0)) / 2)) for own in aligned_m)
    return f"boxes {ratio.min():.2f} to {ratio.max():.2f} of the mesh, whose middle is {1000 * off:.1f} mm off"


def _placed(
    model: ObjectModel,
    world_from_object: np.ndarray,
    hinge_rad: np.ndarray | None,
    frames: np.ndarray,
    tracked: np.ndarray,
    note: str,
    left_out: list[Quarantined],
) -> _Object:
    """Poses of some source frames as a track at 30 fps; frames without a pose repeat the one before."""
    source = np.clip(np.searchsorted(frames, np.arange(len(tracked)), side="right") - 1, 0, None)
    rotvec, place = rotmat_to_rotvec(world_from_object[:, :3, :3])[source], world_from_object[source, :3, 3]
    angle = None if hinge_rad is None else twice_values(hinge_rad[source], tracked).astype(np.float32)
    track = ObjectTrack(
        model,
        twice_rotvecs(rotvec).astype(np.float32),
        twice_values(place, tracked).astype(np.float32),
        angle,
    )
    both = np.zeros(track.n_frames, bool)
    both[::2], both[1::2] = tracked, tracked[:-1] & tracked[1:]
    recorded = np.zeros(track.n_frames, bool)
    recorded[::2] = tracked
    return _Object(bridge(track, both), both, recorded, note, left_out)


def _hands(
    raw: RawTree, key: SequenceKey, camera: np.ndarray, hands: HandPair
) -> tuple[dict[Side, HandTrack], list[Clip | Quarantined]]:
    """Both hands in the world at 30 fps, and the files that could not be used. Raises BadInput where none could."""
    tracks, faulty = dict[Side, HandTrack](), list[Clip | Quarantined]()
    change = FrameChange(camera[:, :3, :3], camera[:, :3, 3])
    for side in SIDES:
        source, problems = _source_hand(raw, key, side, len(camera))
        tracks[side] = twice_hand(to_track(source, CONVENTION, hands[side], change))
        faulty += problems
    if not any(track.valid.any() for track in tracks.values()):
        folders = " or ".join(folder.format("right") for folder in HAND_FOLDERS)
        remedy = "nothing to do: the makers publish no hands of some recordings"
        raise BadInput(key.name, f"hand poses below {folders}", "none", remedy)
    return tracks, faulty


def _read_frames(raw: RawTree, folder: str, names: list[str]) -> list[bytes]:
    """The files of a folder in the order given, read in that of their names: the folder has one digest."""
    in_order = sorted(names)
    contents = dict(zip(in_order, raw.read_folder(folder, in_order) if names else [], strict=True))
    return [contents[name] for name in names]


def _source_hand(raw: RawTree, key: SequenceKey, side: Side, n_frames: int) -> tuple[SourceHand, list[Quarantined]]:
    folders = [f"{folder.format(side)}/{key.name}" for folder in HAND_FOLDERS]
    folder = next((own for own in folders if raw.names(own, ".pickle")), folders[0])
    numbers = frame_numbers(folder, raw.names(folder, ".pickle"))
    pose, translation_m, betas = np.zeros((n_frames, 48)), np.zeros((n_frames, 3)), np.zeros((n_frames, 10))
    valid, faulty = np.zeros(n_frames, bool), []
    frames = sorted(numbers)
    if frames and frames[-1] >= n_frames:
        raise BadInput(folder, f"frames 0 to {n_frames - 1}, as output.log has", f"{frames[-1]}")
    contents = _read_frames(raw, folder, [numbers[frame] for frame in frames])
    for frame, data in zip(frames, contents, strict=True):
        try:
            found = hand_frame(data, f"{folder}/{numbers[frame]}")
        except ShortPose as problem:
            faulty.append(Quarantined.from_error(f"{key}/{side}-{frame:05d}", problem))
            continue
        pose[frame], betas[frame], translation_m[frame], valid[frame] = *found[:2], found.translation_m, True
    betas[~valid] = betas[valid][0] if valid.any() else 0
    return SourceHand(translation_m, pose[:, :3], pose[:, 3:], betas, valid), faulty


def _gravity(
    thing: _Object, tracks: dict[Side, HandTrack], camera: np.ndarray, hands: HandPair
) -> tuple[np.ndarray | None, str]:
    """Estimated from the base of the object where it rests; nothing in the source says which way is down."""
    track = thing.track
    joints = [np.where(t.valid[:, None, None], track_joints(t, hands[side]), np.nan) for side, t in tracks.items()]
    poses = np.tile(np.eye(4), (track.n_frames, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = track.world_from_object.rotation, track.translation_m
    turned = np.repeat(camera[:, :3, :3], 2, axis=0)[: track.n_frames]
    base = TrackedObject(footing(track.model.vertices_m, track.model.faces_of(0)), thing.tracked, poses)
    return estimate_gravity([base], np.concatenate(joints, axis=1).astype(np.float64), turned)
