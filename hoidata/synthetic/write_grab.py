"""Writes ground truth in GRAB's format: one npz per sequence at 120 Hz, all members 0-d arrays.

Objects and the table follow the row-vector convention (``x_world = x R + t``), so the stored axis-angle is that of the
transpose. Hands have a personal rest mesh and betas 0; MANO translations are added to the wrist of the rest mesh.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from hoidata.clips.clip import SIDES, HandTrack, Side
from hoidata.hands import HandPair, load_embedded_hands, track_vertices
from hoidata.synthetic.catalogue import ObjectSpec, model_of
from hoidata.synthetic.object_files import gender, write_npz, write_ply
from hoidata.synthetic.shapes import sharp_box
from hoidata.synthetic.truth import TruthSequence

_COMPONENTS, _BODY_VERTICES = 24, 10475
_TOUCH_M = 0.004
_LABEL_FRAMES = 40  # 1/3 s with the same labels
# Ids of GRAB's contact labels: the palm, then the finger segments in MANO's order.
_HAND_ID = {"left": 21, "right": 22}
_FINGER_ID = {"left": 26, "right": 41}
_BODY_PARAMETERS = {
    "transl": 3, "global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3,
    "left_hand_pose": 24, "right_hand_pose": 24, "fullpose": 165, "expression": 10,
}  # fmt: skip
_MESHES = "tools/object_meshes/contact_meshes"
_TABLE_M = (0.9, 0.8, 0.03)


def write_grab_meshes(root: Path, sequences: list[TruthSequence], specs: tuple[ObjectSpec, ...]) -> None:
    """Write object meshes, the table, and the personal hands of each subject, metres."""
    for spec in specs:
        model = model_of(spec)
        write_ply(root / _MESHES / f"{spec.name}.ply", model.vertices_m, model.faces)
    table = sharp_box(_TABLE_M).moved((0, 0, -_TABLE_M[2] / 2))
    write_ply(root / _MESHES / "table.ply", table.vertices_m, table.faces)
    hands = load_embedded_hands()
    people = {truth.subject: truth for truth in sequences}
    for truth in people.values():
        for side in SIDES:
            write_ply(root / _template_path(truth.subject, side), _template(truth.hands[side]), hands[side].faces)


def _template(track: HandTrack) -> np.ndarray:
    if track.template_m is None:
        raise ValueError("a GRAB hand needs its personal rest mesh")
    return track.template_m


def _template_path(subject: str, side: Side) -> str:
    return f"tools/subject_meshes/{gender(subject)}/{subject}_{side[0]}hand.ply"


def write_grab_sequence(root: Path, members: list[TruthSequence], pair: HandPair) -> None:
    """Write grab/<subject>/<object>_<intent>_<n>.npz. A recording of GRAB is one action."""
    (truth,) = members
    body_mesh = f"tools/subject_meshes/{gender(truth.subject)}/{truth.subject}.ply"
    arrays: dict[str, Any] = {
        "gender": gender(truth.subject),
        "sbj_id": truth.subject,
        "obj_name": truth.object_name,
        "motion_intent": truth.intent,
        "framerate": 120.0,
        "n_frames": truth.n_frames,
        "n_comps": _COMPONENTS,
        "body": {"params": _body(truth.n_frames), "vtemp": body_mesh},
    }
    for side in SIDES:
        parameters = _hand_parameters(truth.hands[side], pair, side)
        arrays[f"{side[0]}hand"] = {"params": parameters, "vtemp": _template_path(truth.subject, side)}
    track, zeros = truth.object, np.zeros((truth.n_frames, 3), dtype=np.float32)
    pose = {"transl": track.translation_m.astype(np.float32), "global_orient": (-track.rotvec).astype(np.float32)}
    arrays["object"] = {"params": pose, "object_mesh": f"{_MESHES}/{truth.object_name}.ply"}
    # The table top is at height 0. Stands below objects are not part of the format.
    table_pose = {"transl": zeros, "global_orient": zeros.copy()}
    arrays["table"] = {"params": table_pose, "table_mesh": f"{_MESHES}/table.ply"}
    no_contact = np.zeros((truth.n_frames, _BODY_VERTICES), dtype=np.int8)
    arrays["contact"] = {"object": _object_contact(truth, pair), "body": no_contact}
    write_npz(root / "grab" / f"{truth.source_key}.npz", arrays)


def _body(n_frames: int) -> dict[str, np.ndarray]:
    """Return an unused SMPL-X body in its rest pose."""
    return {name: np.zeros((n_frames, width), dtype=np.float32) for name, width in _BODY_PARAMETERS.items()}


def _hand_parameters(track: HandTrack, pair: HandPair, side: Side) -> dict[str, np.ndarray]:
    rest_wrist = pair[side].rest_joints_m(np.zeros((1, 10)), track.template_m)[0, 0]
    # The components are orthonormal, so the projection onto 24 components is the closest pose.
    projected = track.hand_pose @ pair[side].components[:_COMPONENTS].T
    parameters = {"global_orient": track.global_orient, "hand_pose": projected}
    parameters |= {"transl": track.wrist_m - rest_wrist, "fullpose": track.hand_pose}
    return {name: value.astype(np.float32) for name, value in parameters.items()}


def _object_contact(truth: TruthSequence, pair: HandPair) -> np.ndarray:
    """Return (frame, object vertex) int8 ids of the touching hand segments; 0 outside of the contact.

    While the same hands grasp, they move little relative to the object, so the labels change only every 1/3 s.
    """
    contact = np.zeros((truth.n_frames, len(truth.object.model.vertices_m)), dtype=np.int8)
    for start, stop, sides in truth.contact_intervals():
        for first in range(start, stop, _LABEL_FRAMES):
            last = min(first + _LABEL_FRAMES, stop)
            contact[first:last] = _labels(truth, (first + last) // 2, sides, pair)
    return contact


def _labels(truth: TruthSequence, frame: int, sides: tuple[Side, ...], pair: HandPair) -> np.ndarray:
    """Return (object vertex,) int8 ids in one frame."""
    labels = np.zeros(len(truth.object.model.vertices_m), dtype=np.int8)
    nearest = np.full(len(labels), np.inf)
    one = truth.take(np.array([frame]))
    for side in sides:
        vertices = track_vertices(one.hands[side], pair[side]).astype(np.float64)
        local = (one.object.world_from_object.inverse() @ vertices)[0]
        distance, index = KDTree(local).query(truth.object.model.vertices_m)
        joint = pair[side].skin_weights.argmax(1)[index]
        ids = np.where(joint == 0, _HAND_ID[side], _FINGER_ID[side] + joint - 1)
        # A coarse mesh may have no vertex under the fingers, so the nearest vertex always touches.
        touching = distance <= max(_TOUCH_M, distance.min())
        is_nearest = touching & (distance < nearest)
        labels[is_nearest], nearest[is_nearest] = ids[is_nearest], distance[is_nearest]
    return labels
