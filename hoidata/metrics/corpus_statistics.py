"""Statistics of the recorded motion of a corpus, and how far two corpora are apart.

They show what generated corpora lack: fingers that move during contact, slip, regrasps, noise.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from scipy.stats import ks_2samp

from hoidata.actions.action import object_middle_m
from hoidata.clips.clip import FPS, SIDES, Clip, Side
from hoidata.clips.slip import joint_slips_cm_s, touched_parts
from hoidata.geometry.intervals import bridged, runs
from hoidata.geometry.rotations import rotation_angle, rotvec_to_rotmat
from hoidata.store.annotated import AnnotatedStore

LOST_FRAMES = FPS // 3  # a contact that is lost for at most this long continues
HINGE_MOVES_RAD_S = np.deg2rad(6)
OBJECT_MOVES_CM_S = 2.0

# Name, unit, meaning. One value per clip, except that a clip has a grasp duration per contact of a hand.
STATISTICS = {
    "finger speed": ("deg/s", "mean rotation speed of the 15 finger joints of a hand in contact"),
    "slip": ("cm/s", "mean speed of touching joints on the moving part that they touch"),
    "hand jitter": ("m/s³", "mean jerk of the 21 joints"),
    "object jitter": ("m/s³", "mean jerk of the middle of the object"),
    "touched points": ("fraction", "object points within the contact threshold, mean over frames with contact"),
    "frames with contact": ("fraction", "frames in which a joint is within the contact threshold"),
    "both hands": ("fraction", "frames with contact in which both hands touch"),
    "grasp duration": ("s", "length of each contact of a hand"),
    "regrasps": ("per 10 s", "contacts of a hand after its first"),
    "wrist speed": ("cm/s", "mean over frames and hands"),
    "object speed": ("cm/s", "mean over frames in which the object moves faster than 2 cm/s"),
    "object tilt": ("deg", "largest angle of the object's first up axis with the vertical"),
    "hinge speed": ("deg/s", "mean over frames in which the hinge moves faster than 6 deg/s"),
    "hands on both parts": ("fraction", "frames with a moving hinge in which the hands touch different parts"),
}


class Comparison(NamedTuple):
    """One statistic of two corpora."""

    name: str
    unit: str
    values: np.ndarray  # (value,) of the first corpus
    reference: np.ndarray  # (value,) of the second
    ratio: float  # of the means; NaN if one is missing or the reference's is 0
    distance: float  # Kolmogorov-Smirnov, 0 (equal) to 1 (disjoint); NaN if one is missing


def compare_corpora(statistics: Mapping[str, np.ndarray], reference: Mapping[str, np.ndarray]) -> list[Comparison]:
    """Every statistic of two corpora next to each other; see :func:`corpus_statistics`."""
    rows = []
    for name, (unit, _) in STATISTICS.items():
        values, others = statistics[name], reference[name]
        is_known = len(values) > 0 and len(others) > 0
        ratio = float(values.mean() / others.mean()) if is_known and others.mean() else float("nan")
        distance = float(np.asarray(ks_2samp(values, others))[0]) if is_known else float("nan")
        rows.append(Comparison(name, unit, values=values, reference=others, ratio=ratio, distance=distance))
    return rows


def corpus_statistics(annotated: AnnotatedStore, most_clips: int = 400) -> dict[str, np.ndarray]:
    """The values (value,) of every statistic over at most ``most_clips`` evenly chosen clips with contact."""
    clip_ids = annotated.ids()
    chosen = np.unique(np.linspace(0, len(clip_ids) - 1, min(most_clips, len(clip_ids))).round().astype(int))
    collected: dict[str, list[float]] = {name: [] for name in STATISTICS}
    for number in chosen:
        for name, value in clip_statistics(annotated, clip_ids[number]):
            collected[name].append(value)
    return {name: np.array(values) for name, values in collected.items()}


def clip_statistics(annotated: AnnotatedStore, clip_id: str) -> Iterator[tuple[str, float]]:
    """Name and value of the statistics of one clip; those that are undefined in it are missing."""
    clip = annotated.clip(clip_id)
    parts = annotated.points(annotated.object_key(clip_id)).part
    joints_m: dict[Side, np.ndarray] = {side: annotated.joints(clip_id, side).astype(np.float64) for side in SIDES}
    entries = {side: annotated.distances(clip_id, side) for side in SIDES}
    touched: dict[Side, np.ndarray] = {}
    for side in SIDES:
        item = entries[side]
        touched[side] = touched_parts(clip.n_frames, item.frame, item.joint, item.distance_m, parts[item.point])
    touching: dict[Side, np.ndarray] = {side: np.any(touched[side] >= 0, axis=1) for side in SIDES}
    points = np.concatenate([item.frame * np.int64(len(parts)) + item.point for item in entries.values()])
    yield from _contact(clip, touching, len(np.unique(points)) / len(parts))
    yield from _hands(clip, joints_m, touching, touched)
    yield from _object(clip, touched)


def _contact(clip: Clip, touching: Mapping[Side, np.ndarray], touched_points: float) -> Iterator[tuple[str, float]]:
    """touched_points: touched fractions of the object's points, summed over the frames."""
    either, both = touching["left"] | touching["right"], touching["left"] & touching["right"]
    if not either.any():
        return
    yield "touched points", touched_points / float(either.sum())
    yield "frames with contact", float(either.mean())
    yield "both hands", float(both.sum() / either.sum())
    contacts = {side: runs(bridged(flags, LOST_FRAMES)) for side, flags in touching.items()}
    for of_hand in contacts.values():
        yield from (("grasp duration", (contact.stop - contact.start) / FPS) for contact in of_hand)
    regrasps = sum(max(len(of_hand) - 1, 0) for of_hand in contacts.values())
    yield "regrasps", 10 * FPS * regrasps / clip.n_frames


def _hands(
    clip: Clip,
    joints_m: Mapping[Side, np.ndarray],
    touching: Mapping[Side, np.ndarray],
    touched: Mapping[Side, np.ndarray],
) -> Iterator[tuple[str, float]]:
    seen = {side: np.where(clip.hands[side].valid[:, None, None], joints_m[side], np.nan) for side in SIDES}
    speeds = [_finger_speed_deg_s(clip, side)[touching[side][1:] & touching[side][:-1]] for side in SIDES]
    slips = [joint_slips_cm_s(clip.object, joints_m[side], touched[side]) for side in SIDES]
    jerks = [np.linalg.norm(np.diff(seen[side], n=3, axis=0), axis=-1).mean(axis=-1) * FPS**3 for side in SIDES]
    wrists = [100 * FPS * np.linalg.norm(np.diff(seen[side][:, 0], axis=0), axis=-1) for side in SIDES]
    yield from _means({"finger speed": speeds, "slip": slips, "hand jitter": jerks, "wrist speed": wrists})


def _finger_speed_deg_s(clip: Clip, side: Side) -> np.ndarray:
    """(frame - 1,) mean rotation speed of the finger joints between frames; NaN if the hand is not tracked in both."""
    hand = clip.hands[side]
    rotation = rotvec_to_rotmat(hand.hand_pose.reshape(clip.n_frames, 15, 3).astype(np.float64))
    step_rad = rotation_angle(rotation[:-1].transpose(0, 1, 3, 2) @ rotation[1:]).mean(axis=1)
    return np.where(hand.valid[1:] & hand.valid[:-1], np.degrees(step_rad) * FPS, np.nan)


def _object(clip: Clip, touched: Mapping[Side, np.ndarray]) -> Iterator[tuple[str, float]]:
    middle_m = object_middle_m(clip.object).astype(np.float64)
    speed = 100 * FPS * np.linalg.norm(np.diff(middle_m, axis=0), axis=-1)
    jerk = np.linalg.norm(np.diff(middle_m, n=3, axis=0), axis=-1) * FPS**3
    yield from _means({"object jitter": [jerk], "object speed": [speed[speed > OBJECT_MOVES_CM_S]]})
    if clip.gravity is not None:
        rotation = clip.object.world_from_object.rotation
        up = -np.asarray(clip.gravity, np.float64)
        up_in_object = rotation[0].T @ up
        yield "object tilt", float(np.degrees(np.arccos(np.clip(rotation @ up_in_object @ up, -1, 1)).max()))
    if (angle_rad := clip.object.joint_angle_rad) is not None:
        hinge_rad_s = np.abs(np.diff(angle_rad.astype(np.float64))) * FPS
        moves = hinge_rad_s > HINGE_MOVES_RAD_S
        if moves.any():
            yield "hinge speed", float(np.degrees(hinge_rad_s[moves].mean()))
            on = {side: [(touched[side][:-1] == part).any(axis=1) for part in (0, 1)] for side in SIDES}
            apart = (on["left"][0] & on["right"][1]) | (on["left"][1] & on["right"][0])
            yield "hands on both parts", float(apart[moves].mean())


def _means(groups: Mapping[str, list[np.ndarray]]) -> Iterator[tuple[str, float]]:
    """The mean of the finite values of each group that has some."""
    for name, arrays in groups.items():
        values = np.concatenate(arrays)
        if np.isfinite(values).any():
            yield name, float(values[np.isfinite(values)].mean())
