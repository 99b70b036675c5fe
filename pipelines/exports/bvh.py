"""BVH for animators: per clip a skeleton of 21 joints for each hand, and one for the object, in metres, y up.

BVH does not state axes. Blender and Maya assume y up, so the world is rotated until gravity is -y. A BVH file has no
field for other facts: ``clip.json`` lists the frames that repeat a hand's pose. All joints have six channels, because
bone lengths change and fingertips move with the skin: position, which replaces OFFSET, and rotation.
"""

import warnings
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import FPS, SIDES, ObjectTrack, Side
from hoidata.hands import JOINT_NAMES, PARENTS
from pipelines.exports.motion import ExportedClip, hinge_of, write_json
from pipelines.pages.glb import upright_rotation

# Parents of the tips: the last joints of index, middle, pinky, ring, thumb.
_TREE = (*PARENTS, 3, 6, 9, 12, 15)
_CHANNELS = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"


def write(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write <clip>/left.bvh, right.bvh, object.bvh and clip.json; hands without a valid frame are skipped."""
    for item in clips:
        (folder / item.file_name).mkdir()
        skeletons = {
            side: (JOINT_NAMES, _TREE, *_hand_motion(item, side)) for side in SIDES if item.clip.hands[side].valid.any()
        }
        skeletons |= {"object": _object_motion(item.clip.object)}
        for name, (names, tree, positions_m, rotations) in skeletons.items():
            upright = _upright(positions_m, rotations, upright_rotation(item.clip.gravity))
            _write_bvh(folder / item.file_name / f"{name}.bvh", names, tree, *upright)
        write_json(folder / item.file_name / "clip.json", item.motion_facts)


def _upright(positions_m: np.ndarray, rotations: Rotation, up_from_world: Rotation) -> tuple[np.ndarray, Rotation]:
    """Rotate the root joint of a motion; all other joints are relative to their parents."""
    rotated_m, rotvec = positions_m.copy(), rotations.as_rotvec().reshape(positions_m.shape)
    rotated_m[:, 0] = up_from_world.apply(positions_m[:, 0])
    rotvec[:, 0] = (up_from_world * Rotation.from_rotvec(rotvec[:, 0])).as_rotvec()
    return rotated_m, Rotation.from_rotvec(rotvec.reshape(-1, 3))


def _hand_motion(item: ExportedClip, side: Side) -> tuple[np.ndarray, Rotation]:
    """Joint positions (frame, 21, 3) in the parent joint's frame, metres, and rotations (frame x 21) relative to it."""
    hand, joints = item.clip.hands[side], item.joints[side].astype(np.float64)
    local_rotvec = np.zeros((hand.n_frames, 21, 3))  # tips do not rotate
    local_rotvec[:, :16] = np.concatenate([hand.global_orient, hand.hand_pose], axis=1).reshape(-1, 16, 3)
    world_rotations, positions = [Rotation.from_rotvec(local_rotvec[:, 0])], [joints[:, 0]]
    for joint, parent in list(enumerate(_TREE))[1:]:
        positions.append(world_rotations[parent].inv().apply(joints[:, joint] - joints[:, parent]))
        world_rotations.append(world_rotations[parent] * Rotation.from_rotvec(local_rotvec[:, joint]))
    return np.stack(positions, axis=1), Rotation.from_rotvec(local_rotvec.reshape(-1, 3))


def _object_motion(track: ObjectTrack) -> tuple[tuple[str, ...], tuple[int, ...], np.ndarray, Rotation]:
    """A joint for the object, with a child joint for the part that its hinge moves."""
    translation_m, rotvec = np.asarray(track.translation_m, np.float64), np.asarray(track.rotvec, np.float64)
    if track.model.hinge is None:
        return ("object",), (-1,), translation_m[:, None], Rotation.from_rotvec(rotvec)
    part_m, part_rotvec = track.model.hinge.node_motion(hinge_of(track))
    positions_m, rotvecs = np.stack([translation_m, part_m], axis=1), np.stack([rotvec, part_rotvec], axis=1)
    return ("object", "moving_part"), (-1, 0), positions_m, Rotation.from_rotvec(rotvecs.reshape(-1, 3))


def _write_bvh(
    path: Path, names: Iterable[str], tree: tuple[int, ...], positions_m: np.ndarray, rotations: Rotation
) -> None:
    """Write positions (frame, joint, 3) and rotations (frame x joint) relative to the parents in ``tree``; root: -1."""
    order: list[int] = []
    lines = ["HIERARCHY", *_joint_lines(0, tuple(names), tree, positions_m[0], 0, order)]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Gimbal lock")  # any of the equivalent angle triples will do
        angles_deg = rotations.as_euler("ZXY", degrees=True).reshape(positions_m.shape)
    channels = np.concatenate([positions_m, angles_deg], axis=2)[:, order].reshape(len(positions_m), -1)
    lines += ["MOTION", f"Frames: {len(channels)}", f"Frame Time: {1 / FPS:.8f}"]
    lines += [" ".join(f"{value:.7g}" for value in frame) for frame in channels]
    path.write_text("\n".join(lines) + "\n")


def _joint_lines(
    joint: int, names: tuple[str, ...], tree: tuple[int, ...], offsets_m: np.ndarray, depth: int, order: list[int]
) -> list[str]:
    """The hierarchy lines of a joint and its descendants; appends the joints to ``order`` in the order of the lines."""
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
