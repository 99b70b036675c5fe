"""The controls of physical realism: what a score says when hands are moved or taken away.

``python -m tests.bench.realism``. Embedded GRAB and ARCTIC clips (H2O's do not say where down is) of
HOIDATA_BENCH_CORPORA, HOIDATA_BENCH_CLIPS of each (12 if not given, 0 for all), and with HOIDATA_MANIPNET the real
recordings of HOIDATA_BENCH_SEQUENCES (cyl_med3 if not given): the source hands at 120 Hz, and beside them the clips
whose hands were fitted to them.
"""

import os
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import islice
from pathlib import Path

import numpy as np

from hoidata.adapters.base import RawTree, SequenceKey
from hoidata.adapters.manipnet_source_hands import SourceRecording, read_source_hands
from hoidata.adapters.registry import get_adapter
from hoidata.hands import HandPair, load_embedded_hands
from hoidata.physics.as_released import AsReleased
from hoidata.physics.capsules import Capsules, joined
from hoidata.physics.mano_capsules import THUMB_CAPSULES
from hoidata.physics.realism import Realism, Variant, score, smoothness_m_s2
from hoidata.physics.scene import Scene, clip_scene
from hoidata.physics.standard_units import StandardUnits
from hoidata.schema.clip import SIDES, Clip
from tests.bench.corpus import embedded_root
from tests.bench.harness import show

N_CAPSULES = 19
SOURCE_THUMB = (4, 5, 6)
SHIFTS_MM = (3, 5, 10, 20)
MANO_TOLERANCE_M = 0.002  # the capsules of a MANO-layout hand follow its skin to a few millimetres only


def variants(tolerance_m: float) -> dict[str, Variant]:
    """Columns of the table. tolerance_m: how near a capsule touches, in the SI variants after the first."""
    return {
        "SI": StandardUnits(),
        f"SI, within {1e3 * tolerance_m:g} mm": StandardUnits(tolerance_m=tolerance_m),
        "the same, torque / 5 cm": StandardUnits(tolerance_m=tolerance_m, torque_length_m=0.05),
        "the same, sliding > 10 cm/s": StandardUnits(tolerance_m=tolerance_m, sliding_m_s=0.1),
        "as released": AsReleased(),
        "as released, about origin": AsReleased(reference="origin"),
    }


def main() -> None:
    for name in ("grab", "arctic"):
        scenes = [clip_scene(clip, embedded_hands()) for clip in embedded_clips(name, _clips_wanted())]
        show_controls(f"Embedded {name}, {len(scenes)} clips, lifted frames", scenes, THUMB_CAPSULES, MANO_TOLERANCE_M)
    root = os.environ.get("HOIDATA_MANIPNET")
    if not root:
        print("HOIDATA_MANIPNET is not set: no real recordings")
        return
    for sequence in os.environ.get("HOIDATA_BENCH_SEQUENCES", "cyl_med3").split(","):
        source = read_source_hands(RawTree(Path(root)), sequence)
        scene = source_scene(source)
        show_controls(f"ManipNet {sequence}, source hands, {source.fps:g} Hz", [scene], SOURCE_THUMB, 0.0)
        slow = [every_fourth_frame(scene)]
        show_controls(f"ManipNet {sequence}, source hands, every fourth frame", slow, SOURCE_THUMB, 0.0)
        clips = fitted_clips(Path(root), sequence)
        fitted = [clip_scene(clip, embedded_hands(), scene.table_height_m) for clip in clips]
        show_controls(
            f"ManipNet {sequence}, fitted hands, {len(fitted)} clips, 30 fps", fitted, THUMB_CAPSULES, MANO_TOLERANCE_M
        )
        smooth = {
            side: smoothness_m_s2(source.joints_m[side], source.wrist_rotmats[side], source.fps) for side in SIDES
        }
        print("smoothness, cm/s^2:", ", ".join(f"{side} {100 * value:.1f}" for side, value in smooth.items()))


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


def source_scene(source: SourceRecording) -> Scene:
    """A ManipNet recording with its own hands, y up; the table is found over the whole recording."""
    capsules = joined([source.capsules[side] for side in SIDES])
    return Scene(source.model, source.poses, capsules, source.fps, np.array([0.0, -1.0, 0.0]))


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
