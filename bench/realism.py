"""The controls of physical realism: what a score says when hands are moved or taken away.

``python -m bench.realism``. Embedded GRAB and ARCTIC clips (H2O's do not say where down is) of
HOIDATA_BENCH_CORPORA, HOIDATA_BENCH_CLIPS of each (12 if not given, 0 for all), and with HOIDATA_MANIPNET the real
recordings of HOIDATA_BENCH_SEQUENCES (cyl_med3 if not given): the source hands at 120 Hz, and beside them the clips
whose hands were fitted to them.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from itertools import islice
from pathlib import Path

import numpy as np

from bench.corpus import embedded_root
from bench.harness import show
from bench.manipnet_hands import HandMotion, read_source_hands
from hoidata.clips.clip import Clip
from hoidata.datasets.base import RawTree, SequenceKey
from hoidata.datasets.registry import get_adapter
from hoidata.hands import HandPair, load_embedded_hands, track_joints
from hoidata.physics.as_released import AsReleased
from hoidata.physics.capsules import Capsules, ObjectPoses, joined
from hoidata.physics.contact_forces import GRAVITY_M_S2
from hoidata.physics.mano_capsules import THUMB_CAPSULES, world_rotmats
from hoidata.physics.realism import Realism, Variant, has_acceleration, score, smoothness_m_s2
from hoidata.physics.scene import Scene, clip_scene
from hoidata.physics.standard_units import StandardUnits

N_CAPSULES = 19
SOURCE_THUMB = (4, 5, 6)
SHIFTS_MM = (3, 5, 10, 20)
MANO_TOLERANCE_M = 0.002  # the capsules of a MANO-layout hand follow its skin to a few millimetres only


def variants(tolerance_m: float) -> dict[str, Variant]:
    """Columns of the table. tolerance_m: how near a capsule touches, in the SI variants after the first."""
    return {
        "SI": StandardUnits(),
        f"SI, within {1e3 * tolerance_m:g} mm": StandardUnits(tolerance_m=tolerance_m),
        "as released": AsReleased(),
        "as released, about origin": AsReleased(reference="origin"),
    }


def main() -> None:
    for name in ("grab", "arctic"):
        clips = embedded_clips(name, _clips_wanted())
        scenes = [clip_scene(clip, embedded_hands()) for clip in clips]
        title = f"Embedded {name}, {len(scenes)} clips"
        show_controls(f"{title}, lifted frames", scenes, THUMB_CAPSULES, MANO_TOLERANCE_M)
        show_known_answers(title, scenes)
        show_smoothness(clips, scenes)
    root = os.environ.get("HOIDATA_MANIPNET")
    if not root:
        print("HOIDATA_MANIPNET is not set: no real recordings")
        return
    for sequence in os.environ.get("HOIDATA_BENCH_SEQUENCES", "cyl_med3").split(","):
        source = read_source_hands(RawTree(Path(root)), sequence)
        scene, title = source.scene, f"ManipNet {sequence}"
        show_controls(f"{title}, source hands, {source.fps:g} Hz, lifted frames", [scene], SOURCE_THUMB, 0.0)
        show_known_answers(title, [scene])
        smooth = smoothness(source.motions, scene.fps)
        print("smoothness, cm/s^2:", ", ".join(f"{side} {100 * value:.1f}" for side, value in smooth.items()))
        slow = [every_fourth_frame(scene)]
        show_controls(f"{title}, source hands, every fourth frame", slow, SOURCE_THUMB, 0.0)
        clips = fitted_clips(Path(root), sequence)
        fitted = [clip_scene(clip, embedded_hands(), scene.table_height_m) for clip in clips]
        show_controls(f"{title}, fitted hands, {len(fitted)} clips, 30 fps", fitted, THUMB_CAPSULES, MANO_TOLERANCE_M)
        show_smoothness(clips, fitted)


def show_controls(title: str, scenes: Sequence[Scene], thumb: Sequence[int], tolerance_m: float) -> None:
    """One row per control, one column per variant: the share of scored frames that pass."""
    columns, rows = variants(tolerance_m), []
    for name, control in controls(thumb).items():
        changed = [scene.with_capsules(control(scene)) for scene in scenes]
        results = {variant: [score(scene, how) for scene in changed] for variant, how in columns.items()}
        one = results["SI"]
        depth = _mean([result.colliding_m for result in one], [len(result.frames) for result in one])
        rows.append([name, *(_share(result) for result in results.values()), _count(one), f"{1e3 * depth:.1f}"])
    show(title, ["control", *columns, "scored", "depth mm"], rows)


def show_known_answers(title: str, scenes: Sequence[Scene]) -> None:
    """Without any hand: nothing holds an object, nothing needs to hold one that falls, a table holds one that lies."""
    answers = {
        "held in the air": ("0 %", [score(without_hands(scene), StandardUnits(), scene.held) for scene in scenes]),
        "falling freely": ("100 %", [score(falling(scene), StandardUnits()) for scene in scenes]),
        "lying on a table, hands alone": ("0 %", [_lying_score(scene, None) for scene in scenes]),
        "lying on a table, with it": ("100 %", [_lying_score(scene, scene.table_height_m) for scene in scenes]),
    }
    rows = [[name, expected, _share(results)] for name, (expected, results) in answers.items()]
    show(f"{title}: no hands, SI", ["object", "must be", "passes"], rows)


def without_hands(scene: Scene) -> Scene:
    return scene.with_capsules(scene.capsules.taken(slice(None), slice(0, 0)))


def falling(scene: Scene, frames: int = 30) -> Scene:
    """The object dropped from 10 m with the turn of the first frame."""
    time = np.arange(frames)[:, None] / scene.fps
    drop = -10 * scene.gravity + 0.5 * GRAVITY_M_S2 * time**2 * scene.gravity
    return _alone(scene, np.zeros(frames, dtype=int), drop, table_m=0.0)


def lying(scene: Scene, frames: int = 5) -> Scene:
    """The object kept still as in the frame in which it is nearest to the table's height, set down on it."""
    frame = int(np.abs(scene.lowest_m - scene.table_height_m).argmin())
    down = (scene.lowest_m[frame] - scene.table_height_m) * scene.gravity
    return _alone(scene, np.full(frames, frame), down, scene.table_height_m)


def _alone(scene: Scene, frames: np.ndarray, shift_m: np.ndarray, table_m: float) -> Scene:
    poses = scene.poses.taken(frames)
    poses = ObjectPoses(poses.rotmats, poses.translation_m + shift_m, poses.hinge_rad)
    none = scene.capsules.taken(frames, slice(0, 0))
    return Scene(scene.model, poses, none, scene.fps, scene.gravity, table_m)


def _lying_score(scene: Scene, table_m: float | None) -> Realism:
    still = lying(scene)
    return score(still, StandardUnits(table_m=table_m), np.ones(still.n_frames, dtype=bool))


def show_smoothness(clips: Sequence[Clip], scenes: Sequence[Scene]) -> None:
    """Mean over the clips, of each hand."""
    found = [smoothness(clip_motions(clip), scene.fps) for clip, scene in zip(clips, scenes, strict=True)]
    sides = sorted({side for one in found for side in one})
    means = {side: np.mean([one[side] for one in found if side in one]) for side in sides}
    print("smoothness, cm/s^2:", ", ".join(f"{side} {100 * value:.1f}" for side, value in means.items()))


def smoothness(motions: Mapping[str, HandMotion], fps: float) -> dict[str, float]:
    """By hand, of those that are there in three frames in a row, m/s^2."""
    return {
        side: smoothness_m_s2(motion.joints_m, motion.wrist_rotmats, fps)
        for side, motion in motions.items()
        if has_acceleration(motion.joints_m, fps)
    }


def clip_motions(clip: Clip) -> dict[str, HandMotion]:
    """Both hands of a clip: its 16 joints and 5 tips."""
    motions = {}
    for side, track in clip.hands.items():
        joints = track_joints(track, embedded_hands()[side]).astype(np.float64)
        joints = np.where(track.valid[:, None, None], joints, np.nan)
        motions[side] = HandMotion(joints, world_rotmats(track)[:, 0])
    return motions


def controls(thumb: Sequence[int]) -> dict[str, Callable[[Scene], Capsules]]:
    """What is done to the hands of a scene. thumb: the thumb's capsules, numbered within one hand."""
    both = np.arange(2 * N_CAPSULES)
    result: dict[str, Callable[[Scene], Capsules]] = {"clean": lambda scene: scene.capsules}
    for millimetres in SHIFTS_MM:
        result[f"hands {millimetres} mm away"] = lambda scene, way=millimetres / 1e3: moved_away(scene, way)
    kept = {
        "right hand removed": both < N_CAPSULES,
        "left hand removed": both >= N_CAPSULES,
        "thumbs removed": ~np.isin(both % N_CAPSULES, thumb),
        "no hands": both < 0,
    }
    for name, keep in kept.items():
        result[name] = lambda scene, keep=keep: scene.capsules.taken(slice(None), keep)
    return result


def moved_away(scene: Scene, way_m: float) -> Capsules:
    """Both hands moved straight away from the object's centre of mass."""
    hands = []
    for first in (0, N_CAPSULES):
        own = scene.capsules.taken(slice(None), slice(first, first + N_CAPSULES))
        direction = (own.start_m + own.end_m).mean(axis=1) / 2 - scene.motion.centre_m
        hands.append(own.moved(way_m * direction / np.linalg.norm(direction, axis=1, keepdims=True)))
    return joined(hands)


def every_fourth_frame(scene: Scene) -> Scene:
    """The same motion at the rate of the clips; the table stays."""
    few = slice(None, None, 4)
    return Scene(
        scene.model,
        scene.poses.taken(few),
        scene.capsules.taken(few),
        scene.fps / 4,
        scene.gravity,
        scene.table_height_m,
    )


def fitted_clips(root: Path, sequence: str) -> list[Clip]:
    """The adapter's clips of one ManipNet sequence, with fitted MANO-layout hands."""
    key = SequenceKey("manipnet", "manipnet", sequence)
    results = get_adapter("manipnet").load(RawTree(root), key, embedded_hands())
    return [item for item in results if isinstance(item, Clip)]


def embedded_clips(name: str, wanted: int) -> list[Clip]:
    """The first clips of evenly spread sequences of an embedded corpus; 0 for all clips."""
    root, adapter = embedded_root() / name, get_adapter(name)
    keys = adapter.sequences(root)
    keys = keys[:: max(1, len(keys) // wanted)] if wanted else keys
    loaded = (adapter.load(RawTree(root), key, embedded_hands()) for key in keys)
    clips = (item for items in loaded for item in items if isinstance(item, Clip))
    return list(islice(clips, wanted or None))


@lru_cache(maxsize=1)
def embedded_hands() -> HandPair:
    return load_embedded_hands()


def _clips_wanted() -> int:
    return int(os.environ.get("HOIDATA_BENCH_CLIPS", "12"))


def _share(results: list[Realism]) -> str:
    passed = np.concatenate([result.passed for result in results])
    return f"{passed.mean():.1%}" if len(passed) else "-"


def _count(results: list[Realism]) -> str:
    return str(sum(len(result.frames) for result in results))


def _mean(values: list[float], weights: list[int]) -> float:
    kept = np.isfinite(values)
    return float(np.average(np.array(values)[kept], weights=np.array(weights)[kept])) if kept.any() else float("nan")


if __name__ == "__main__":
    main()
