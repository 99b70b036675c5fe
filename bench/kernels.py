"""Distance maps, joints and farthest points beside the plain way of each, in one run.

``python -m bench.kernels``. One thread. A turn of a variant is a batch of clips, as a corpus comes; variants take
turns, and figures are medians of the processor's time. Building an index is shown apart, and so is compiling: the first
call of a process that finds nothing compiled, less its second. Errors are against float64 brute force.
"""

import contextlib
import importlib.util
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh

from bench.harness import Times, medians, show
from hoidata.clips import HandTrack, ObjectTrack
from hoidata.contact.proximity import CONTACT_THRESHOLD_M, ProximityIndex
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import HandKinematics, HandModel, load_embedded_hands, track_joints, track_rotmats
from hoidata.objects.farthest import farthest_points
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.objects.sampling import SampledPoints, sample_points
from tests.builders.mano import write_mano_pickle

RUNS, CLIPS, FRAMES, JOINTS = 7, 40, 150, 21


@dataclass(frozen=True)
class Scene:
    """One object and the motion of it and of one hand's joints in several clips; the hand is near in most frames."""

    points: SampledPoints
    clips: list[tuple[np.ndarray, ObjectTrack]]


def scene(articulated: bool) -> Scene:
    """A torus of 4,000 vertices, 14 cm wide, whose right half a hinge turns; joints scattered about it."""
    torus = trimesh.creation.torus(0.05, 0.02, major_sections=80, minor_sections=50)
    part = ((torus.vertices[:, 0] > 0) & articulated).astype(np.uint8)
    hinge = Hinge(np.array([0.0, 0.0, -1.0]), np.zeros(3)) if articulated else None
    model = ObjectModel("torus", torus.vertices, torus.faces, part, hinge)
    return Scene(sample_points(model), [moving(model, seed) for seed in range(CLIPS)])


def moving(model: ObjectModel, seed: int) -> tuple[np.ndarray, ObjectTrack]:
    random = np.random.default_rng(seed)
    rotvec, translation_m = random.normal(size=(2, FRAMES, 3)).astype(np.float32)
    angle = np.linspace(0, 1.2, FRAMES, dtype=np.float32) if model.is_articulated else None
    around = random.normal(0, 0.03, (FRAMES, 1, 3)) + random.normal(0, 0.04, (FRAMES, JOINTS, 3))
    joints = np.einsum("fij,fkj->fki", rotvec_to_rotmat(rotvec.astype(np.float64)), around) + translation_m[:, None]
    return joints.astype(np.float32), ObjectTrack(model, rotvec, translation_m, angle)


def dense_in_world(points: SampledPoints, joints: np.ndarray, track: ObjectTrack) -> np.ndarray:
    """The plain way: all points to the world, all distances by torch.cdist, those below the threshold; float32."""
    local = torch.as_tensor(points.points_m)[None]
    if track.hinge_rad is not None and track.model.hinge is not None:
        # As the field does it: the whole mesh is articulated frame by frame, then its sampled points are picked.
        hinge, vertices = track.model.hinge, torch.as_tensor(track.model.vertices_m, dtype=torch.float32)
        turn = torch.as_tensor(rotvec_to_rotmat((hinge.axis * track.hinge_rad[:, None]).astype(np.float32)))
        origin, moves = torch.as_tensor(hinge.origin_m, dtype=torch.float32), torch.as_tensor(track.model.part) == 1
        turned = (vertices - origin) @ turn.transpose(1, 2) + origin
        mesh = torch.where(moves[None, :, None], turned, vertices[None])
        corner = points.barycentric.argmax(axis=1)
        local = mesh[:, torch.as_tensor(track.model.faces[points.face, corner])]
    rotation = torch.as_tensor(rotvec_to_rotmat(track.rotvec))
    world = torch.einsum("fij,fpj->fpi", rotation, local.expand(len(joints), -1, -1))
    world = world + torch.as_tensor(track.translation_m)[:, None]
    distance = torch.cdist(world, torch.as_tensor(joints))
    frame, point, joint = torch.where(distance < CONTACT_THRESHOLD_M)
    return np.stack([frame.numpy(), point.numpy(), joint.numpy(), distance[frame, point, joint].numpy()])


def brute_force(points: SampledPoints, joints: np.ndarray, track: ObjectTrack) -> np.ndarray:
    """(frame, point, joint) float64 distances in the world."""
    hinge_rad = None if track.hinge_rad is None else track.hinge_rad.astype(np.float64)
    local = articulate(points.points_m.astype(np.float64), points.part, track.model.hinge, hinge_rad)
    rotation = rotvec_to_rotmat(track.rotvec.astype(np.float64))
    local = np.broadcast_to(local, (len(joints), *local.shape[-2:]))
    world = np.einsum("fij,fpj->fpi", rotation, local) + track.translation_m[:, None].astype(np.float64)
    return np.linalg.norm(world[:, :, None] - joints[:, None].astype(np.float64), axis=3)


def distance_rows(articulated: bool, compiled_s: float) -> list[list[str]]:
    made = scene(articulated)
    index, valid = ProximityIndex(made.points), np.ones(FRAMES, bool)
    variants: dict[str, Callable[[], object]] = {
        "torch.cdist in the world, dense": lambda: [dense_in_world(made.points, *clip) for clip in made.clips],
        "cell grid, sparse": lambda: [index.entries(joints, valid, track) for joints, track in made.clips],
    }
    times = medians(variants, RUNS)
    build = medians(
        {"": lambda: ProximityIndex(made.points).entries(*made.clips[0][:1], ~valid, made.clips[0][1])}, RUNS
    )
    joints, track = made.clips[0]
    truth, found = brute_force(made.points, joints, track), index.entries(joints, valid, track)
    plain = dense_in_world(made.points, joints, track)
    errors = [
        entry_errors(truth, plain[:3].astype(int), plain[3]),
        entry_errors(truth, np.stack([found[name] for name in ("frame", "point", "joint")]), found["distance_m"]),
    ]
    name = "articulated" if articulated else "rigid"
    notes = ["", f"index {build[''].processor * 1e3:.1f} ms, compiling {compiled_s:.1f} s"]
    return rows_of(f"distance map, {name}: ", times, CLIPS, errors, notes)


def entry_errors(truth: np.ndarray, places: np.ndarray, distances: np.ndarray) -> str:
    """Entries missing and in excess more than 1 um off the threshold, and the largest error of a distance."""
    listed = np.zeros(truth.shape, bool)
    listed[tuple(places)] = True
    clear = np.abs(truth - CONTACT_THRESHOLD_M) > 1e-6
    missing = ((truth < CONTACT_THRESHOLD_M) & ~listed & clear).sum()
    extra = ((truth >= CONTACT_THRESHOLD_M) & listed & clear).sum()
    error_m = np.abs(truth[tuple(places)] - distances).max()
    return f"{missing} / {extra} of {listed.sum():,}; {error_m * 1e6:.3f} um"


def joints_rows() -> list[list[str]]:
    model, tracks = load_embedded_hands().right, [random_track(seed) for seed in range(CLIPS)]
    layer, inputs = HandKinematics(model), [torch_inputs(track) for track in tracks]
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        forwards: dict[str, Callable[[], list[np.ndarray]]] = {}
        if importlib.util.find_spec("smplx"):
            forwards["smplx, all vertices, a batch per clip"] = smplx_forward(model, tracks, Path(folder))
        forwards["own layer in torch, all vertices, float32"] = lambda: [layer(*own)[1].numpy() for own in inputs]
        forwards["own layer in torch, joints and tips, float64"] = lambda: [track_joints(own, model) for own in tracks]
        times = medians(forwards, RUNS)
        truth = HandKinematics(model, torch.float64)(*torch_inputs(tracks[0], torch.float64))[1].numpy()
        errors = [f"{np.abs(run()[0] - truth[:, : run()[0].shape[1]]).max() * 1e6:.3f} um" for run in forwards.values()]
    return rows_of("joints: ", times, CLIPS, errors, [""] * len(forwards))


def random_track(seed: int) -> HandTrack:
    random = np.random.default_rng(seed)
    wrist_m, orient = random.normal(0, 0.5, (2, FRAMES, 3)).astype(np.float32)
    pose, betas = (
        random.normal(0, 0.4, (FRAMES, 45)).astype(np.float32),
        random.normal(0, 1, (1, 10)).astype(np.float32),
    )
    return HandTrack(wrist_m, orient, pose, betas, np.ones(FRAMES, bool))


def torch_inputs(track: HandTrack, dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    return [torch.as_tensor(array).to(dtype) for array in (track.wrist_m, track_rotmats(track), track.betas)]


def smplx_forward(model: HandModel, tracks: list[HandTrack], folder: Path) -> Callable[[], list[np.ndarray]]:
    """smplx's MANO layer over a file of the same hand; its 16 joints (tips are a matter of indexing its vertices)."""
    import smplx

    write_mano_pickle(model, folder / "MANO_RIGHT.pkl")
    with contextlib.redirect_stdout(io.StringIO()):
        layer = smplx.MANO(str(folder), is_rhand=True, use_pca=False, flat_hand_mean=True, batch_size=FRAMES)
    inputs = []
    for track in tracks:
        betas = np.repeat(track.betas, FRAMES, axis=0)
        transl = (track.wrist_m - model.wrist_offset_m(betas)).astype(np.float32)
        arrays = {"betas": betas, "global_orient": track.global_orient, "hand_pose": track.hand_pose, "transl": transl}
        inputs.append({name: torch.as_tensor(array) for name, array in arrays.items()})
    return lambda: [layer(**own).joints[:, :16].numpy() for own in inputs]


def farthest_rows(n_points: int, loops: int, compiled_s: float) -> list[list[str]]:
    points = np.random.default_rng(0).normal(size=(n_points, 3))
    points = (0.05 * points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
    variants: dict[str, Callable[[], object]] = {
        "torch loop": lambda: torch_farthest(torch.as_tensor(points), 1024),
        "compiled": lambda: [farthest_points(points, 1024) for _ in range(loops)],
    }
    times = medians(variants, RUNS)
    times["compiled"] = Times(*(value / loops for value in times["compiled"]))
    same = (torch_farthest(torch.as_tensor(points), 1024).numpy() == farthest_points(points, 1024)).sum()
    notes = ["", f"compiling {compiled_s:.1f} s"]
    return rows_of(f"1,024 farthest of {n_points:,}: ", times, 1, ["", f"{same} of 1,024 indices equal"], notes)


def torch_farthest(points: torch.Tensor, count: int) -> torch.Tensor:
    """The loop of PointNet++'s ports, for one cloud, from point 0."""
    chosen = torch.zeros(count, dtype=torch.long)
    nearest = torch.full((len(points),), torch.inf)
    for step in range(1, count):
        square = ((points - points[chosen[step - 1]]) ** 2).sum(-1)
        nearest = torch.where(square < nearest, square, nearest)
        chosen[step] = nearest.max(-1)[1]
    return chosen


def compiling_s() -> dict[str, float]:
    """Seconds of compiling by operation, in a process of its own with an empty cache."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        command = [sys.executable, "-m", "bench.kernels", "--first-calls"]
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def first_calls_s() -> dict[str, float]:
    """Of each operation, the first call less the second, in seconds of the processor."""
    points = np.random.default_rng(0).normal(size=(4000, 3)).astype(np.float32)
    farthest = first_less_second_s(lambda: farthest_points(points, 1024))  # first: sampling a scene needs it, too
    made = scene(True)
    index, valid = ProximityIndex(made.points), np.ones(FRAMES, bool)
    return {
        "farthest": farthest,
        "distance": first_less_second_s(lambda: index.entries(made.clips[0][0], valid, made.clips[0][1])),
    }


def first_less_second_s(work: Callable[[], object]) -> float:
    times = []
    for _ in range(2):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return times[0] - times[1]


def rows_of(title: str, times: Mapping[str, Times], size: int, errors: list[str], notes: list[str]) -> list[list[str]]:
    base = next(iter(times.values()))
    return [
        [
            title + name,
            f"{own.processor / size * 1e3:.3f} / {own.median / size * 1e3:.3f}",
            f"{base.processor / own.processor:.1f}",
            error,
            note,
        ]
        for (name, own), error, note in zip(times.items(), errors, notes, strict=True)
    ]


def main() -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    first = compiling_s()
    rows = [*distance_rows(False, first["distance"]), *distance_rows(True, first["distance"])]
    rows += joints_rows()
    rows += [*farthest_rows(4000, 10, first["farthest"]), *farthest_rows(30000, 3, first["farthest"])]
    torch.set_num_threads(threads)
    columns = ["", "ms processor / clock", "x", "missing / extra; largest error", "apart"]
    show(f"Kernels: {FRAMES} frames, one hand, medians of {RUNS} turns of {CLIPS} clips", columns, rows)


if __name__ == "__main__":
    if sys.argv[1:] == ["--first-calls"]:
        print(json.dumps(first_calls_s()))
    else:
        main()
