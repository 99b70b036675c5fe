"""Writes ground truth in ARCTIC's format: hands and objects as npy, objects in millimetres, labels of Text2HOI.

Finger poses are relative to the mean pose of the hand model. MANO translations are added to the wrist of the rest mesh.
In parts.json 0 is the top, the part that moves, and 1 the bottom.
"""

import json
from itertools import product
from pathlib import Path

import numpy as np

from hoidata.clips.clip import SIDES, HandTrack, Side
from hoidata.hands import HandPair
from hoidata.synthetic.catalogue import ObjectSpec, model_of
from hoidata.synthetic.generate import GAP_FRAMES
from hoidata.synthetic.object_files import gender, obj_text, write_npy, write_text
from hoidata.synthetic.truth import TruthSequence

MM_PER_M = 1000.0
_SPLIT_OF = {"s05": "val", "s10": "test"}


def write_arctic_meta(root: Path, sequences: list[TruthSequence], specs: tuple[ObjectSpec, ...]) -> None:
    """Write meta/ and splits_json/: object templates in mm, parts, key points, subjects, protocols."""
    meta = {}
    for spec in specs:
        model = model_of(spec)
        folder = root / "meta" / "object_vtemplates" / spec.name
        vertices = model.vertices_m * MM_PER_M
        write_text(folder / "mesh.obj", obj_text(vertices, model.faces))
        write_text(folder / "parts.json", json.dumps((1 - model.part.astype(int)).tolist()))
        parameters = {}
        for name, part in (("top", 1), ("bottom", 0)):
            part_vertices = vertices[model.part == part]
            points = part_vertices[np.linspace(0, len(part_vertices) - 1, 300).astype(int)]
            write_text(folder / f"{name}_keypoints_300.json", json.dumps({"keypoints": points.tolist()}))
            parameters |= _part_parameters(name, part_vertices)
        write_text(folder / "object_params.json", json.dumps(parameters))
        diameter = np.linalg.norm(model.vertices_m.max(0) - model.vertices_m.min(0))
        meta[spec.name] = {"diameter": float(diameter)}
    write_text(root / "meta" / "object_meta.json", json.dumps(meta))
    write_text(root / "meta" / "misc.json", json.dumps(_misc(sequences)))
    _write_protocols(root, sequences)


def _part_parameters(name: str, vertices: np.ndarray) -> dict[str, list]:
    low, high = vertices.min(0), vertices.max(0)
    points = vertices[np.linspace(0, len(vertices) - 1, 16).astype(int)].tolist()
    box = list(product(*zip(low.tolist(), high.tolist(), strict=True)))
    return {f"mocap_{name}": points[:4], f"bbox_{name}": box, f"keypoints_{name}": points}


def _misc(sequences: list[TruthSequence]) -> dict[str, dict]:
    cameras = np.tile(np.eye(4), (8, 1, 1)).tolist()
    intrinsics = np.tile(np.diag([1000.0, 1000.0, 1.0]), (8, 1, 1)).tolist()
    sizes = [[2800, 2000]] * 9
    return {
        subject: {
            "gender": gender(subject), "world2cam": cameras, "intris_mat": intrinsics,
            "image_size": sizes, "ioi_offset": 0,
        }
        for subject in sorted({truth.subject for truth in sequences})
    }  # fmt: skip


def _write_protocols(root: Path, sequences: list[TruthSequence]) -> None:
    splits: dict[str, list[str]] = {"train": [], "val": [], "test": []}
    for key in sorted({truth.source_key for truth in sequences}):
        splits[_SPLIT_OF.get(key.split("/")[0], "train")].append(key)
    for name in ("protocol_p1", "protocol_p2"):
        write_text(root / "splits_json" / f"{name}.json", json.dumps(splits))


def write_arctic_sequence(root: Path, members: list[TruthSequence], pair: HandPair) -> None:
    """Write raw_seqs/<key>.{mano,object}.npy and description/<key>/description.txt of one raw sequence."""
    key = members[0].source_key
    n_frames = members[-1].raw_start + members[-1].n_frames + GAP_FRAMES
    action_frames = np.concatenate([np.arange(truth.raw_start, truth.raw_start + truth.n_frames) for truth in members])
    source = action_frames[np.abs(action_frames[:, None] - np.arange(n_frames)).argmin(0)]
    # Frames between actions repeat the nearest one that belongs to an action.
    order = np.searchsorted(action_frames, source)
    hands = {side: _hand(members, side, pair, order) for side in reversed(SIDES)}
    write_npy(root / "raw_seqs" / f"{key}.mano.npy", hands)
    write_npy(root / "raw_seqs" / f"{key}.object.npy", _object(members)[order])
    lines = [
        f"{truth.raw_start + truth.clip[0] + 1}-{truth.raw_start + truth.clip[1]} {truth.verb}, {truth.hand_type} "
        f"{'hands' if truth.hand_type == 'both' else 'hand'}"
        for truth in members
    ]
    write_text(root / "description" / key / "description.txt", "\n".join(lines) + "\n")


def _hand(members: list[TruthSequence], side: Side, pair: HandPair, order: np.ndarray) -> dict[str, np.ndarray]:
    tracks: list[HandTrack] = [truth.hands[side] for truth in members]
    betas = tracks[0].betas
    rest_wrist = pair[side].rest_joints_m(betas)[0, 0]

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(track, name) for track in tracks])[order]

    return {
        "rot": joined("global_orient").astype(np.float32),
        "pose": (joined("hand_pose") - pair[side].mean_pose).astype(np.float32),
        "trans": (joined("wrist_m") - rest_wrist).astype(np.float32),
        "shape": betas[0].astype(np.float32),
        "fitting_err": np.zeros(len(order), dtype=np.float32),
    }


def _object(members: list[TruthSequence]) -> np.ndarray:
    """Return (frame, 7) float32: hinge angle, rotation, translation in mm."""
    rows = []
    for truth in members:
        track = truth.object
        if track.hinge_rad is None:
            raise ValueError(f"{track.model.name}: every ARCTIC object has a hinge")
        rows.append(np.column_stack([track.hinge_rad, track.rotvec, MM_PER_M * track.translation_m]))
    return np.concatenate(rows).astype(np.float32)
