"""The quality measures of one clip and of one object."""

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
from hoidata.surface.contact import deepest_m, hand_in_object_frame

NAN = float("nan")
STILL_M = 0.001  # a smaller step from frame to frame counts as no motion
TIMING_POINTS = 64
Joints = Mapping[Side, np.ndarray]


@dataclass(frozen=True)
class ObjectFacts:
    """Facts of an object that all of its clips need."""

    model: ObjectModel
    surfaces: dict[int, SurfaceFacts]  # by part
    points_m: np.ndarray  # (64, 3) surface samples, object frame
    part: np.ndarray  # (64,) part of each sample
    corners_m: np.ndarray  # (8 * parts, 3) corners of the bounding box of each part
    corner_part: np.ndarray  # (8 * parts,)

    @classmethod
    def of(cls, model: ObjectModel) -> "ObjectFacts":
        surfaces, points = part_facts(model), sample_points(model, TIMING_POINTS)
        boxes = [_box_corners(model.vertices_m[np.unique(model.faces_of(part))]) for part in surfaces]
        corner_part = np.repeat(np.array(list(surfaces), dtype=np.uint8), 8)
        return cls(
            model=model,
            surfaces=surfaces,
            points_m=points.points_m,
            part=points.part,
            corners_m=np.concatenate(boxes),
            corner_part=corner_part,
        )

    @property
    def solid_parts(self) -> list[int]:
        return [part for part, solid in self.model.solids.items() if isinstance(solid, Solid)]


def object_row(facts: ObjectFacts) -> dict[str, Any]:
    """Measure an object's mesh; of several parts, the worst value counts."""
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
    """Measure a clip, except ``beta_distance``, which needs the subject's other clips. NaN: not measurable."""
    tracked: list[Side] = [side for side in SIDES if clip.hands[side].valid.any()]
    joints: Joints = {side: track_joints(clip.hands[side], hands[side]) for side in tracked}
    corners = clip.object.points_in_world(facts.corners_m, facts.corner_part)
    valid = {side: track.valid for side, track in clip.hands.items()}
    return {
        **_shaking(clip, joints, corners, thresholds),
        **_jumps(clip, joints, corners, thresholds),
        **_frozen(clip, joints, corners),
        **_penetration(clip, facts, hands, thresholds),
        **_offset(clip, joints, facts, thresholds),
        "largest_beta": max((float(np.abs(meant_betas(clip.hands[side])).max()) for side in tracked), default=NAN),
        "seam_triangles": facts.model.seam_triangles,
        "gap_share": max(motion.gap_share(flags) for flags in valid.values()),
        "handless_share": float((~(valid["left"] | valid["right"])).mean()),
        **{f"{side}_invalid_share": float((~flags).mean()) for side, flags in valid.items()},
    }


def object_motion(track: ObjectTrack, facts: ObjectFacts) -> ObjectMotion:
    """Return world poses of the object's parts, and its surface points."""
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
    object_acceleration = motion.accelerations_m_s2(corners, np.ones(len(corners), bool))
    shaking = np.array([series > thresholds.shaking_m_s2 for series in (*wrists, *fingers, object_acceleration)]).any(
        axis=0
    )
    return {
        "wrist_acceleration_m_s2": max(map(_median, wrists), default=NAN),
        "finger_acceleration_m_s2": max(map(_median, fingers), default=NAN),
        "object_acceleration_m_s2": _median(object_acceleration),
        "shaking_share": float(shaking.mean()),
    }


def _median(values: np.ndarray) -> float:
    """Median of the finite values; 0, which is within any limit, without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else 0.0


def _jumps(clip: Clip, joints: Joints, corners: np.ndarray, thresholds: Thresholds) -> dict[str, float]:
    rule = thresholds.sudden_m, thresholds.large_m, thresholds.sudden_ratio
    steps = [motion.steps_m(positions, clip.hands[side].valid) for side, positions in joints.items()]
    hand_jump = max((motion.largest_jump(step, *rule) for step in steps), default=motion.Jump(NAN, -1))
    object_jump = motion.largest_jump(motion.steps_m(corners, np.ones(len(corners), bool)), *rule)
    return {
        "hand_jump_m": hand_jump.size_m,
        "hand_jump_frame": hand_jump.frame,
        "object_jump_m": object_jump.size_m,
        "object_jump_frame": object_jump.frame,
    }


def _frozen(clip: Clip, joints: Joints, corners: np.ndarray) -> dict[str, float]:
    always = np.ones(clip.n_frames, bool)
    valid = {side: clip.hands[side].valid for side in joints}
    same = {side: motion.equal_steps(_hand_numbers(clip.hands[side]), valid[side]) for side in joints}
    moves = {side: motion.steps_m(positions, valid[side]) > STILL_M for side, positions in joints.items()}
    object_moves = motion.steps_m(corners, always) > STILL_M
    alone = []  # frames in which one hand is frozen while something else moves
    for side in joints:
        others_move = [flags for other, flags in moves.items() if other != side]
        alone.append(same[side] & np.any([object_moves, *others_move], axis=0))
    objects_same = [motion.equal_steps(_object_numbers(track), always) for track in (clip.object, *clip.other_objects)]
    return {
        "frozen_hand_frames": float(max(map(motion.longest_frozen, alone), default=0)),
        "frozen_all_frames": float(motion.longest_frozen(np.all([*same.values(), *objects_same], axis=0))),
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
    sampled = clip.take(slice(None, None, thresholds.penetration_every))
    index = surface_index(facts.model)
    depth = np.nan_to_num([deepest_m(hand_in_object_frame(sampled, side, hands), index) for side in SIDES]).max(axis=0)
    solid, parts = len(facts.solid_parts), len(facts.surfaces)
    return {
        "penetration_m": float(depth.max()),
        "penetration_share": float((depth > thresholds.too_deep_m).mean()),
        "note": "" if solid == parts else f"penetration measured in the {solid} solid of {parts} parts only",
    }


def _offset(clip: Clip, joints: Joints, facts: ObjectFacts, thresholds: Thresholds) -> dict[str, float]:
    offset = time_offset(
        [(positions.astype(np.float64), clip.hands[side].valid) for side, positions in joints.items()],
        object_motion(clip.object, facts),
    )
    is_reliable = offset.confidence >= thresholds.offset_confidence
    return {
        "time_offset_frames": offset.frames if is_reliable else NAN,
        "time_offset_confidence": offset.confidence,
        "time_offset_samples": offset.samples,
    }


# Betas are coefficients of principal components in standard deviations (MANO, 2017), so large ones are unlikely.


def meant_betas(track: HandTrack) -> np.ndarray:
    """Return (row, 10) betas of the valid frames."""
    return track.betas if len(track.betas) == 1 else track.betas[track.valid]


def distances_to_others(betas: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the distance of each clip's betas from those of the same hand in the other clips, by clip id.

    The distance is the largest difference of a component between the median of the clip and the median of the other
    clips' medians, in standard deviations. NaN with fewer than two other clips: either could be wrong.

    Args:
        betas: by clip id, (row, 10) betas of one side of one subject.
    """
    medians = {key: np.median(values, axis=0) for key, values in betas.items()}
    if len(medians) < 3:
        return dict.fromkeys(medians, float("nan"))
    table = np.array(list(medians.values()))
    others = [np.median(np.delete(table, number, axis=0), axis=0) for number in range(len(table))]
    return {
        key: float(np.abs(median - other).max()) for (key, median), other in zip(medians.items(), others, strict=True)
    }
