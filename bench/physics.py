"""Physical realism: non-negative least squares beside a loop over SciPy's, and the cost of one scored frame.

``python -m bench.physics`` with OMP_NUM_THREADS=1. The systems are contacts all round a
ball of 5 cm, a third of them on one side only, so that about two in three frames are feasible.
"""

import numpy as np
from scipy.optimize import nnls

from bench.harness import Times, medians, show
from bench.realism import embedded_clips, embedded_hands
from hoidata.physics.capsules import capsule_contacts
from hoidata.physics.contact_forces import RESIDUAL_LIMIT, wrench_columns
from hoidata.physics.nnls import wrench_residuals
from hoidata.physics.scene import Scene, clip_scene
from hoidata.physics.standard_units import StandardUnits

RUNS = 7
FRAMES = 1000


def main() -> None:
    rows = [_nnls_row(contacts) for contacts in (5, 20, 40, 100)]
    heads = ["SciPy loop", "ours", "times", "with first call", "largest difference", "feasible", "decisions changed"]
    show(f"Non-negative least squares, {FRAMES} frames of 6 rows, processor ms", ["columns", *heads], rows)
    rows = [_scene_row(clip_scene(clip, embedded_hands())) for clip in embedded_clips("grab", 2)]
    heads = ["frames", "capsule contacts", "forces", "forces with SciPy"]
    show("One clip with two hands of 19 capsules, processor us per frame", ["object", *heads], rows)


def systems(frames: int, contacts: int, seed: int = 0) -> tuple[list[np.ndarray], np.ndarray]:
    """Columns (6, 4 x contact) of each frame and wrenches (frame, 6) in N and N m."""
    rng = np.random.default_rng(seed)
    columns, wrenches = [], np.empty((frames, 6))
    for frame in range(frames):
        points = rng.normal(size=(contacts, 3))
        points *= 0.05 / np.linalg.norm(points, axis=1, keepdims=True)
        normals = points / 0.05 + rng.normal(size=points.shape) * 0.3
        normals = np.abs(normals) if frame % 3 == 0 else normals
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        columns.append(wrench_columns(points, normals, np.zeros(3)))
        force = [0, 0, 9.81] + rng.normal(size=3) * 3
        wrenches[frame] = np.concatenate([force, rng.normal(size=3) * 0.1])
    return columns, wrenches


def _nnls_row(contacts: int) -> list[str]:
    columns, wrenches = systems(FRAMES, contacts)
    together = np.concatenate(columns, axis=1)
    offsets = np.arange(FRAMES + 1) * 4 * contacts
    results: dict[str, np.ndarray] = {}

    def ours() -> None:
        results["ours"] = np.linalg.norm(wrench_residuals(together, offsets, wrenches), axis=1)

    def scipy_loop() -> None:
        results["SciPy"] = _scipy(columns, wrenches)

    times = medians({"SciPy": scipy_loop, "ours": ours}, RUNS)
    difference = np.abs(results["ours"] - results["SciPy"]).max()
    feasible = {name: residual < RESIDUAL_LIMIT for name, residual in results.items()}
    return [
        f"6 x {4 * contacts}",
        *(f"{times[name].processor * 1e3:.2f}" for name in ("SciPy", "ours")),
        f"{times['SciPy'].processor / times['ours'].processor:.1f}",
        f"{times['ours'].first * 1e3:.0f} ms",
        f"{difference:.0e}",
        f"{feasible['SciPy'].mean():.0%}",
        str(int((feasible["ours"] != feasible["SciPy"]).sum())),
    ]


def _scipy(columns: list[np.ndarray], wrenches: np.ndarray) -> np.ndarray:
    return np.array([nnls(one, wrench, maxiter=300)[1] for one, wrench in zip(columns, wrenches, strict=True)])


def _scene_row(scene: Scene) -> list[str]:
    variant, found = StandardUnits(), capsule_contacts(scene.model, scene.poses, scene.capsules)
    centre = scene.motion.centre_m
    own = [found.frame == frame for frame in range(scene.n_frames)]
    columns = [wrench_columns(found.point_m[o], found.normal[o], centre[i]) for i, o in enumerate(own) if o.any()]
    wrenches = scene.wrench[[o.any() for o in own]]
    times = medians(
        {
            "contacts": lambda: capsule_contacts(scene.model, scene.poses, scene.capsules),
            "ours": lambda: variant.residuals(scene, found),
            "SciPy": lambda: _scipy(columns, wrenches),
        },
        RUNS,
    )
    return [scene.model.name, str(scene.n_frames), *(_per_frame(one, scene) for one in times.values())]


def _per_frame(times: Times, scene: Scene) -> str:
    return f"{times.processor / scene.n_frames * 1e6:.1f}"


if __name__ == "__main__":
    main()
