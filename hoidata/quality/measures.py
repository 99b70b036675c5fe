"""All measures of one clip and of one object."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hoidata.clips.clip import SIDES, Clip, HandTrack, ObjectTrack, Side
from hoidata.hands import HandPair, track_joints
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import sample_points
from hoidata.objects.solid import Solid
from hoidata.objects.surface_index import surface_index
from hoidata.quality import motion
from hoidata.quality.meshes import SurfaceFacts, part_facts
from hoidata.quality.thresholds import Thresholds
from hoidata.quality.timing import ObjectMotion, time_offset
from hoidata.surface.contact import deepest_m, placed_hand

NAN = float("nan")
STILL_M = 0.001
Joints = Mapping[Side, np.ndarray]
TIMING_POINTS = 64


@dataclass(frozen=True)
class ObjectFacts:
    """What the clips of one object share. points_m: (64, 3) spread over its surface; part: (64,) of each.

    corners_m, corner_part: the 8 corners of each part's bounding box. surfaces: of each part.
    """

    model: ObjectModel
    surfaces: dict[int, SurfaceFacts]
    points_m: np.ndarray
    part: np.ndarray
    corners_m: np.ndarray
    corner_part: np.ndarray

    @classmethod
    def of(cls, model: ObjectModel) -> "ObjectFacts":
        surfaces, points = part_facts(model), sample_points(model, TIMING_POINTS)
        boxes = [_box_corners(model.vertices_m[np.unique(model.faces_of(part))]) for part in surfaces]
        corner_part = np.repeat(np.array(list(surfaces), dtype=np.uint8), 8)
        return cls(model, surfaces, points.points_m, points.part, np.concatenate(boxes), corner_part)

    @property
    def solid_parts(self) -> list[int]:
        return [part for part, solid in self.model.solids.items() if isinstance(solid, Solid)]


def object_row(facts: ObjectFacts) -> dict[str, Any]:
    """The measures of an object's mesh, the worst of its parts, and what it is."""
    surfaces = facts.surfaces.values()
    return {
        "parts": len(facts.surfaces),
        "faces": len(facts.model.faces),
        "seam_triangles": facts.model.seam_triangles,
        "watertight": all(surface.open_edge_share == 0 for surface in surfaces),
        "solid": len(facts.solid_parts) == len(facts.surfaces),
        "volume_m3": sum(surface.volume_m3 for surface in surfaces),
        "open_edge_share": max(surface.open_edge_share for surface in surfaces),
        "unfilled_share": max(surface.unfilled_share for surface in surfaces),
        "shells": float(max(surface.shells for surface in surfaces)),
        "degenerate_share": max(surface.degenerate_share for surface in surfaces),
        "size_m": float(np.ptp(facts.model.vertices_m, axis=0).max()),
    }


def clip_row(clip: Clip, facts: ObjectFacts, hands: HandPair, thresholds: Thresholds) -> dict[str, Any]:
    """Every measure of a clip but ``beta_distance``, which needs the subject's other clips; NaN where there is none."""
    seen: list[Side] = [side for side in SIDES if clip.hands[side].valid.any()]
    joints: Joints = {side: track_joints(clip.hands[side], hands[side]) for side in seen}
    corners = clip.object.points_in_world(facts.corners_m, facts.corner_part)
    valid = {side: track.valid for side, track in clip.hands.items()}
    return {
        **_shaking(clip, joints, corners, thresholds),
        **_jumps(clip, joints, corners, thresholds),
        **_frozen(clip, joints, corners),
        **_penetration(clip, facts, hands, thresholds),
        **_offset(clip, joints, facts, thresholds),
        "largest_beta": max((largest_beta(meant_betas(clip.hands[side])) for side in seen), default=NAN),
        "seam_triangles": facts.model.seam_triangles,
        "gap_share": max(motion.gap_share(flags) for flags in valid.values()),
        "handless_share": float((~(valid["left"] | valid["right"])).mean()),
        **{f"{side}_invalid_share": float((~flags).mean()) for side, flags in valid.items()},
    }


def object_motion(track: ObjectTrack, facts: ObjectFacts) -> ObjectMotion:
    """World poses of the object's parts, and its points."""
    poses, motions = track.world_from_object, [track.world_from_object]
    if track.model.is_articulated:
        motions.append(poses @ track.model.object_from_part(1, track.hinge_rad))
    rotmats, positions = (np.stack([getattr(pose, name) for pose in motions]) for name in ("rotation", "translation"))
    return ObjectMotion(track.points_in_world(facts.points_m, facts.part), facts.part, rotmats, positions)


def _box_corners(vertices_m: np.ndarray) -> np.ndarray:
    low, high = vertices_m.min(axis=0), vertices_m.max(axis=0)
    return np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, 8).T


def _shaking(clip: Clip, joints: Joints, corners: np.ndarray, thresholds: Thresholds) -> dict[str, float]:
    wrists, fingers = [], []
    for side, positions in joints.items():
        valid = clip.hands[side].valid
        wrists.append(motion.accelerations_m_s2(positions[:, :1], valid))
        fingers.append(motion.accelerations_m_s2(positions[:, 1:] - positions[:, :1], valid))
    thing = motion.accelerations_m_s2(corners, np.ones(len(corners), bool))
    shaking = np.array([series > thresholds.shaking_m_s2 for series in (*wrists, *fingers, thing)]).any(axis=0)
    return {
        "wrist_acceleration_m_s2": max(map(_median, wrists), default=NAN),
        "finger_acceleration_m_s2": max(map(_median, fingers), default=NAN),
        "object_acceleration_m_s2": _median(thing),
        "shaking_share": float(shaking.mean()),
    }


def _median(values: np.ndarray) -> float:
    """Of the finite values; 0, which no limit is below, without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else 0.0


def _jumps(clip: Clip, joints: Joints, corners: np.ndarray, thresholds: Thresholds) -> dict[str, float]:
    rule = thresholds.sudden_m, thresholds.large_m, thresholds.sudden_ratio
    steps = [motion.steps_m(positions, clip.hands[side].valid) for side, positions in joints.items()]
    hand = max((motion.largest_jump(step, *rule) for step in steps), default=motion.Jump(NAN, -1))
    thing = motion.largest_jump(motion.steps_m(corners, np.ones(len(corners), bool)), *rule)
    return {
        "hand_jump_m": hand.size_m,
        "hand_jump_frame": hand.frame,
        "object_jump_m": thing.size_m,
        "object_jump_frame": thing.frame,
    }


def _frozen(clip: Clip, joints: Joints, corners: np.ndarray) -> dict[str, float]:
    always = np.ones(clip.n_frames, bool)
    valid = {side: clip.hands[side].valid for side in joints}
    same = {side: motion.equal_steps(_hand_numbers(clip.hands[side]), valid[side]) for side in joints}
    moves = {side: motion.steps_m(positions, valid[side]) > STILL_M for side, positions in joints.items()}
    thing_moves = motion.steps_m(corners, always) > STILL_M
    alone = []
    for side in joints:
        others_move = [flags for other, flags in moves.items() if other != side]
        alone.append(same[side] & np.any([thing_moves, *others_move], axis=0))
    things = [motion.equal_steps(_object_numbers(track), always) for track in (clip.object, *clip.other_objects)]
    return {
        "frozen_hand_frames": float(max(map(motion.longest_frozen, alone), default=0)),
        "frozen_all_frames": float(motion.longest_frozen(np.all([*same.values(), *things], axis=0))),
    }


def _hand_numbers(track: HandTrack) -> np.ndarray:
    return np.concatenate([track.wrist_m, track.global_orient, track.hand_pose], axis=1)


def _object_numbers(track: ObjectTrack) -> np.ndarray:
    hinge = np.zeros(track.n_frames) if track.hinge_rad is None else track.hinge_rad
    return np.column_stack([track.rotvec, track.translation_m, hinge])


def _penetration(clip: Clip, facts: ObjectFacts, hands: HandPair, thresholds: Thresholds) -> dict[str, Any]:
    if not facts.solid_parts:
        note = f"penetration not measured: the mesh of {facts.model.name} is not solid"
        return {"penetration_m": NAN, "penetration_share": NAN, "note": note}
    looked_at = clip.take(slice(None, None, thresholds.penetration_every))
    index = surface_index(facts.model)
    depth = np.nan_to_num([deepest_m(placed_hand(looked_at, side, hands), index) for side in SIDES]).max(axis=0)
    solid, parts = len(facts.solid_parts), len(facts.surfaces)
    return {
        "penetration_m": float(depth.max()),
        "penetration_share": float((depth > thresholds.too_deep_m).mean()),
        "note": "" if solid == parts else f"penetration measured in the {solid} solid of {parts} parts only",
    }


def _offset(clip: Clip, joints: Joints, facts: ObjectFacts, thresholds: Thresholds) -> dict[str, float]:
    found = time_offset(
        [(positions.astype(np.float64), clip.hands[side].valid) for side, positions in joints.items()],
        object_motion(clip.object, facts),
    )
    sure = found.confidence >= thresholds.offset_confidence
    return {
        "time_offset_frames": found.frames if sure else NAN,
        "time_offset_confidence": found.confidence,
        "time_offset_samples": found.samples,
    }


# Hand shapes that are unlikely: betas are coefficients of principal components in standard deviations (MANO, 2017).


def meant_betas(track: HandTrack) -> np.ndarray:
    """(row, 10) betas of the frames in which the hand is valid; what stands in the others means nothing."""
    return track.betas if len(track.betas) == 1 else track.betas[track.valid]


def largest_beta(betas: np.ndarray) -> float:
    """Largest ``|beta|`` of (row, 10), standard deviations. Zero for a personal template, which replaces the shape."""
    return float(np.abs(betas).max())


def distances_to_others(betas: Mapping[str, np.ndarray]) -> dict[str, float]:
    """How far each clip's betas lie from the same hand's in the other clips, by clip id.

    betas: (row, 10) of one side of one subject in each clip. The distance is the largest difference of a component
    between the clip's median row and the median of all other clips' median rows, standard deviations; NaN with fewer
    than two others, where nobody can say which of them is wrong.
    """
    rows = {key: np.median(values, axis=0) for key, values in betas.items()}
    if len(rows) < 3:
        return dict.fromkeys(rows, float("nan"))
    table = np.array(list(rows.values()))
    others = [np.median(np.delete(table, number, axis=0), axis=0) for number in range(len(table))]
    return {key: float(np.abs(row - other).max()) for (key, row), other in zip(rows.items(), others, strict=True)}
