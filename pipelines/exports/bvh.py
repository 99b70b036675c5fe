"""BVH for animators: per clip one skeleton of 21 joints for each hand, and one of the object, in metres, y up.

BVH states no axes. Blender and Maya take y for up, so the world is turned until gravity is -y. A BVH file has no
place for other facts: ``clip.json`` says which frames repeat a hand's pose. All joints have six channels, position
(which takes the place of OFFSET) and rotation, so that fingers whose length changes and tips that the skin moves are
where the clip has them.
"""

import warnings
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import orjson
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import FPS, SIDES, ObjectTrack, Side
from hoidata.hands import JOINT_NAMES, PARENTS
from pipelines.exports.motion import ExportedClip, hinge_of
from pipelines.pages.glb import upright_rotation

# The last joint of the finger each tip follows: index, middle, pinky, ring, thumb.
_TREE = (*PARENTS, 3, 6, 9, 12, 15)
_CHANNELS = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"


def write(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write <clip>/left.bvh, right.bvh (a hand that is never valid is left out), object.bvh and clip.json."""
    for item in clips:
        (folder / item.file_name).mkdir()
        skeletons = {
            side: (JOINT_NAMES, _TREE, *_hand_motion(item, side)) for side in SIDES if item.clip.hands[side].valid.any()
        }
        skeletons |= {"object": _object_motion(item.clip.object)}
        for name, (names, tree, positions_m, rotations) in skeletons.items():
            upright = _upright(positions_m, rotations, upright_rotation(item.clip.gravity))
            _write_bvh(folder / item.file_name / f"{name}.bvh", names, tree, *upright)
        (folder / item.file_name / "clip.json").write_bytes(
            orjson.dumps(item.motion_facts, option=orjson.OPT_INDENT_2) + b"\n"
        )


def _upright(positions_m: np.ndarray, rotations: Rotation, up_from_world: Rotation) -> tuple[np.ndarray, Rotation]:
    """The motion with its root turned; all other joints are relative to their parents."""
    turned_m, rotvec = positions_m.copy(), rotations.as_rotvec().reshape(positions_m.shape)
    turned_m[:, 0] = up_from_world.apply(positions_m[:, 0])
    rotvec[:, 0] = (up_from_world * Rotation.from_rotvec(rotvec[:, 0])).as_rotvec()
    return turned_m, Rotation.from_rotvec(rotvec.reshape(-1, 3))


def _hand_motion(item: ExportedClip, side: Side) -> tuple[np.ndarray, Rotation]:
    """(frame, 21, 3) positions in the parent's frame, and (frame x 21) rotations relative to it."""
    hand, joints = item.clip.hands[side], item.joints[side].astype(np.float64)
    own = np.zeros((hand.n_frames, 21, 3))
    own[:, :16] = np.concatenate([hand.global_orient, hand.hand_pose], axis=1).reshape(-1, 16, 3)
    turns, positions = [Rotation.from_rotvec(own[:, 0])], [joints[:, 0]]
    for joint, parent in list(enumerate(_TREE))[1:]:
        positions.append(turns[parent].inv().apply(joints[:, joint] - joints[:, parent]))
        turns.append(turns[parent] * Rotation.from_rotvec(own[:, joint]))
    return np.stack(positions, axis=1), Rotation.from_rotvec(own.reshape(-1, 3))


def _object_motion(track: ObjectTrack) -> tuple[tuple[str, ...], tuple[int, ...], np.ndarray, Rotation]:
    """The object, and below it the part its hinge moves."""
    place, turn = np.asarray(track.translation_m, np.float64), np.asarray(track.rotvec, np.float64)
    if track.model.hinge is None:
        return ("object",), (-1,), place[:, None], Rotation.from_rotvec(turn)
    hinge = track.model.hinge
    places = np.stack([place, np.broadcast_to(hinge.origin_m, place.shape)], axis=1)
    turns = np.stack([turn, hinge.axis * hinge_of(track)[:, None]], axis=1)
    return ("object", "moving_part"), (-1, 0), places, Rotation.from_rotvec(turns.reshape(-1, 3))


def _write_bvh(path: Path, names: Iterable[str], tree: tuple[int, ...], places_m: np.ndarray, turns: Rotation) -> None:
    """places_m: (frame, joint, 3) in the parent's frame. turns: (frame x joint) relative to the parent."""
    names = list(names)
    order: list[int] = []
    lines = ["HIERARCHY", *_joint_lines(0, names, tree, places_m[0], 0, order)]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Gimbal lock")  # any of the triples that say the same rotation will do
        angles = turns.as_euler("ZXY", degrees=True).reshape(places_m.shape)
    rows = np.concatenate([places_m, angles], axis=2)[:, order].reshape(len(places_m), -1)
    lines += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {1 / FPS:.8f}"]
    lines += [" ".join(f"{value:.7g}" for value in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")


def _joint_lines(
    joint: int, names: list[str], tree: tuple[int, ...], offsets_m: np.ndarray, depth: int, order: list[int]
) -> list[str]:
    """The lines of a joint and all below it; ``order`` collects the joints as they come."""
    order.append(joint)
    indent = "  " * depth
    children = [child for child, parent in enumerate(tree) if parent == joint]
    offset = " ".join(f"{value:.7g}" for value in (offsets_m[joint] if depth else np.zeros(3)))
    lines = [f"{indent}{'JOINT' if depth else 'ROOT'} {names[joint]}", f"{indent}{{"]
    lines += [f"{indent}  OFFSET {offset}", f"{indent}  {_CHANNELS}"]
    for child in children:
        lines += _joint_lines(child, names, tree, offsets_m, depth + 1, order)
    if not children:
        lines += [f"{indent}  End Site", f"{indent}  {{", f"{indent}    OFFSET 0 0 0", f"{indent}  }}"]
    return [*lines, f"{indent}}}"]
