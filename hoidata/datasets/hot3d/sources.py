"""What the files of one recording, or of one clip cut from it, say: the full release and HOT3D-Clips, read alike."""

from collections.abc import Mapping
from typing import NamedTuple, get_args

import numpy as np

from hoidata.clips.clip import Side
from hoidata.datasets import checks
from hoidata.datasets.base import DatasetPart, RawTree, SequenceKey
from hoidata.datasets.hot3d import files, packed, umetrack
from hoidata.datasets.hot3d.files import LARGEST_JSON, LARGEST_ROWS, HandFormat, Poses
from hoidata.errors import BadInput

OBJECTS, METADATA, PROFILE = "dynamic_objects.csv", "metadata.json", "umetrack_hand_user_profile.json"
HANDS: Mapping[HandFormat, str] = {kind: f"{kind}_hand_pose_trajectory.jsonl" for kind in get_args(HandFormat)}
ASSETS, CHECKED = "assets", "masks/mask_qa_pass.csv"
DEFINITIONS, MODEL_FOLDERS = "clip_definitions.json", ("object_models_eval", "object_models")
WITHHELD = "nothing to do: of some participants the makers withhold the ground truth"
PARTS = (
    DatasetPart(
        "hand motion",
        (*(f"P*/{name}" for name in HANDS.values()), "*_*/clip-*.tar"),
        "Aria and Quest downloads, or HOT3D-Clips",
    ),
    DatasetPart(
        "object motion and headset",
        (f"P*/{OBJECTS}", f"P*/{METADATA}", DEFINITIONS),
        "Aria and Quest downloads, or HOT3D-Clips",
    ),
    DatasetPart(
        "object meshes and names",
        (f"{ASSETS}/*.glb", f"{ASSETS}/instance.json", *(f"{folder}/obj_*.glb" for folder in MODEL_FOLDERS)),
        "Assets download, or HOT3D-Clips",
    ),
    DatasetPart("UmeTrack's profiles", (f"P*/{PROFILE}",), "Aria and Quest downloads", optional=True),
    DatasetPart("frames the makers checked", (f"P*/{CHECKED}",), "Aria and Quest downloads", optional=True),
)


class Source(NamedTuple):
    """What the files of one sequence say. place: below the raw root. subject: the participant.

    placed: by object; models: name and mesh of each. profile: UmeTrack's, where its hands are used.
    """

    place: str
    subject: str
    headset: str
    poses: dict[Side, Poses]
    profile: umetrack.Profile | None
    placed: dict[str, Poses]
    models: dict[str, tuple[str, str]]
    failed_ns: np.ndarray


def read_source(raw: RawTree, key: SequenceKey, wanted: HandFormat) -> Source:
    """One sequence with hands of the format, or UmeTrack's where MANO's are wanted and not there."""
    return _packed(raw, key, wanted) if "/" in key.name else _folder(raw, key, wanted)


def _folder(raw: RawTree, key: SequenceKey, wanted: HandFormat) -> Source:
    """One recording of the full release."""

    def read(path: str, largest: int) -> tuple[bytes, str]:
        return raw.read(path, largest), path

    headset = files.headset(*read(f"{key.name}/{METADATA}", LARGEST_JSON))
    poses, profile = dict[Side, Poses](), None
    for kind in _formats(wanted):
        path = f"{key.name}/{HANDS[kind]}"
        if not poses and raw.has(path):
            poses = files.hand_poses(*read(path, LARGEST_ROWS), kind)
            if poses and kind == "umetrack":
                profile = umetrack.parse_profile(*read(f"{key.name}/{PROFILE}", LARGEST_JSON))
    if not poses:
        raise BadInput(f"{key.name}/{HANDS[wanted]}", "poses of a hand", "none", WITHHELD)
    placed = files.object_poses(*read(f"{key.name}/{OBJECTS}", LARGEST_ROWS))
    names = files.object_names(*read(f"{ASSETS}/instance.json", LARGEST_JSON))
    if unknown := sorted(placed.keys() - names.keys()):
        raise BadInput(f"{ASSETS}/instance.json", f"the object {unknown[0]}", f"{len(names)} others")
    failed_ns, path = np.zeros(0, np.int64), f"{key.name}/{CHECKED}"
    if raw.has(path):
        failed_ns = files.failed_times(*read(path, LARGEST_ROWS))
    models = {uid: (names[uid], f"{ASSETS}/{uid}.glb") for uid in placed}
    return Source(key.name, key.subject, headset, poses, profile, placed, models, failed_ns)


def _packed(raw: RawTree, key: SequenceKey, wanted: HandFormat) -> Source:
    """One of HOT3D-Clips, whose recording stands in a table of all."""
    path, number = f"{key.name}.tar", int(key.name.rpartition("-")[2])
    recording, headset = packed.definition(raw.read(DEFINITIONS, LARGEST_JSON), DEFINITIONS, number)
    found = packed.read_packed(raw.read(path), path)
    kinds: list[HandFormat] = [kind for kind in _formats(wanted) if found.hands[kind]]
    if not kinds:
        raise BadInput(path, "poses of a hand", "none", WITHHELD)
    kind = kinds[0]
    shape, profile = checks.entry(f"{path}/{packed.SHAPES}", found.shapes, kind), None
    poses: dict[Side, Poses] = dict(found.hands[kind])
    if kind == "umetrack":
        profile = umetrack.profile_of(shape, f"{path}/{packed.SHAPES}")
    else:
        betas = files.small_table(f"{path}/{packed.SHAPES}: mano", [shape], 10, 1)
        for side, own in poses.items():
            poses[side] = own._replace(numbers={**own.numbers, "betas": np.repeat(betas, len(own.time_ns), axis=0)})
    folder = next((folder for folder in MODEL_FOLDERS if raw.names(folder, ".glb")), MODEL_FOLDERS[0])
    models = {thing: (name, f"{folder}/obj_{int(thing):06d}.glb") for thing, name in found.names.items()}
    return Source(
        path, recording.partition("_")[0], headset, poses, profile, found.objects, models, np.zeros(0, np.int64)
    )


def _formats(wanted: HandFormat) -> tuple[HandFormat, ...]:
    """In the order in which they are tried."""
    return ("mano", "umetrack") if wanted == "mano" else ("umetrack",)
