"""Distance maps, joints and farthest points compared with straightforward implementations.

``python -m bench kernels``. One thread. A run of a variant is a batch of clips. Variants alternate, and times are
medians of processor time. The first call, which compiles without numba's cache, has a separate column. Errors are
differences to float64 brute force.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
import trimesh

from bench.harness import Times, medians, show
from hoidata.clips import HandTrack, ObjectTrack
from hoidata.contact.proximity import CONTACT_THRESHOLD_M, ProximityIndex
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.hands import HandKinematics, load_embedded_hands, track_joints, track_rotmats
from hoidata.objects.model import Hinge, ObjectModel, articulate
from hoidata.objects.sampling import SampledPoints, farthest_points, sample_points

RUNS, CLIPS, FRAMES, JOINTS = 7, 40, 150, 21


@dataclass(frozen=True)
class Scene:
    """An object with its motion and one hand's joints in several clips; the hand is near in most frames."""

    points: SampledPoints
    clips: list[tuple[np.ndarray, ObjectTrack]]


def scene(articulated: bool) -> Scene:
    """A torus of 4,000 vertices, 14 cm wide, whose right half moves on a hinge; joints are scattered around it."""
    torus = trimesh.creation.torus(0.05, 0.02, major_sections=80, minor_sections=50)
    part = ((torus.vertices[:, 0] > 0) & articulated).astype(np.uint8)
    hinge = Hinge(np.array([0.0, 0.0, -1.0]), np.zeros(3)) if articulated else None
    model = ObjectModel(name="torus", vertices_m=torus.vertices, faces=torus.faces, part=part, hinge=hinge)
    return Scene(sample_points(model), [moving(model, seed) for seed in range(CLIPS)])


def moving(model: ObjectModel, seed: int) -> tuple[np.ndarray, ObjectTrack]:
    random = np.random.default_rng(seed)
    rotvec, translation_m = random.normal(size=(2, FRAMES, 3)).astype(np.float32)
    angle = np.linspace(0, 1.2, FRAMES, dtype=np.float32) if model.is_articulated else None
    around = random.normal(0, 0.03, (FRAMES, 1, 3)) + random.normal(0, 0.04, (FRAMES, JOINTS, 3))
    joints = np.einsum("fij,fkj->fki", rotvec_to_rotmat(rotvec.astype(np.float64)), around) + translation_m[:, None]
    return joints.astype(np.float32), ObjectTrack(model, rotvec, translation_m, angle)


def dense_in_world(points: SampledPoints, joints: np.ndarray, track: ObjectTrack) -> np.ndarray:
    """The baseline: all points in the world, all distances by torch.cdist, those below the threshold; float32."""
    local = torch.as_tensor(points.points_m)[None]
    if track.hinge_rad is not None and track.model.hinge is not None:
        # As in published code: the whole mesh is articulated frame by frame, then its sampled points are picked.
        hinge, vertices = track.model.hinge, torch.as_tensor(track.model.vertices_m, dtype=torch.float32)
        rotmats = torch.as_tensor(rotvec_to_rotmat((hinge.axis * track.hinge_rad[:, None]).astype(np.float32)))
        origin, moves = torch.as_tensor(hinge.origin_m, dtype=torch.float32), torch.as_tensor(track.model.part) == 1
        rotated = (vertices - origin) @ rotmats.transpose(1, 2) + origin
        mesh = torch.where(moves[None, :, None], rotated, vertices[None])
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


def distance_rows(articulated: bool) -> list[list[str]]:
    batch = scene(articulated)
    index, valid = ProximityIndex(batch.points), np.ones(FRAMES, bool)
    variants: dict[str, Callable[[], object]] = {
        "torch.cdist in the world, dense": lambda: [dense_in_world(batch.points, *clip) for clip in batch.clips],
        "cell grid, sparse": lambda: [index.entries(joints, valid, track) for joints, track in batch.clips],
    }
    times = medians(variants, RUNS)
    joints, track = batch.clips[0]
    truth, entries = brute_force(batch.points, joints, track), index.entries(joints, valid, track)
    plain = dense_in_world(batch.points, joints, track)
    errors = [
        entry_errors(truth, plain[:3].astype(int), plain[3]),
        entry_errors(truth, np.stack([entries[name] for name in ("frame", "point", "joint")]), entries["distance_m"]),
    ]
    name = "articulated" if articulated else "rigid"
    return rows_of(f"distance map, {name}: ", times, CLIPS, errors)


def entry_errors(truth: np.ndarray, indices: np.ndarray, distances: np.ndarray) -> str:
    """Entries missing and in excess more than 1 um off the threshold, and the largest error of a distance."""
    listed = np.zeros(truth.shape, bool)
    listed[tuple(indices)] = True
    clear = np.abs(truth - CONTACT_THRESHOLD_M) > 1e-6
    missing = ((truth < CONTACT_THRESHOLD_M) & ~listed & clear).sum()
    extra = ((truth >= CONTACT_THRESHOLD_M) & listed & clear).sum()
    error_m = np.abs(truth[tuple(indices)] - distances).max()
    return f"{missing} / {extra} of {listed.sum():,}; {error_m * 1e6:.3f} um"


def joints_rows() -> list[list[str]]:
    model, tracks = load_embedded_hands().right, [random_track(seed) for seed in range(CLIPS)]
    layer, inputs = HandKinematics(model), [torch_inputs(track) for track in tracks]
    forwards: dict[str, Callable[[], list[np.ndarray]]] = {
        "all vertices in torch, float32": lambda: [layer(*item)[1].numpy() for item in inputs],
        "joints and tips in torch, float64": lambda: [track_joints(item, model) for item in tracks],
    }
    with torch.no_grad():
        times = medians(forwards, RUNS)
        truth = HandKinematics(model, torch.float64)(*torch_inputs(tracks[0], torch.float64))[1].numpy()
        errors = [f"{np.abs(run()[0] - truth[:, : run()[0].shape[1]]).max() * 1e6:.3f} um" for run in forwards.values()]
    return rows_of("joints: ", times, CLIPS, errors)


def random_track(seed: int) -> HandTrack:
    random = np.random.default_rng(seed)
    wrist_m, orient = random.normal(0, 0.5, (2, FRAMES, 3)).astype(np.float32)
    pose, betas = (
        random.normal(0, 0.4, (FRAMES, 45)).astype(np.float32),
        random.normal(0, 1, (1, 10)).astype(np.float32),
    )
    return HandTrack(wrist_m=wrist_m, global_orient=orient, hand_pose=pose, betas=betas, valid=np.ones(FRAMES, bool))


def torch_inputs(track: HandTrack, dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    return [torch.as_tensor(array).to(dtype) for array in (track.wrist_m, track_rotmats(track), track.betas)]


def farthest_rows(n_points: int) -> list[list[str]]:
    points = np.random.default_rng(0).normal(size=(n_points, 3))
    points = (0.05 * points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
    variants: dict[str, Callable[[], np.ndarray]] = {
        "torch loop": lambda: torch_farthest(torch.as_tensor(points), 1024).numpy(),
        "compiled": lambda: farthest_points(points, 1024),
    }
    plain, compiled = (work() for work in variants.values())
    errors = ["", f"{(plain == compiled).sum()} of 1,024 indices equal"]
    return rows_of(f"1,024 farthest of {n_points:,}: ", medians(variants, RUNS), 1, errors)


def torch_farthest(points: torch.Tensor, count: int) -> torch.Tensor:
    """The loop of PointNet++'s ports, for one cloud, from point 0."""
    chosen = torch.zeros(count, dtype=torch.long)
    nearest = torch.full((len(points),), torch.inf)
    for step in range(1, count):
        square = ((points - points[chosen[step - 1]]) ** 2).sum(-1)
        nearest = torch.where(square < nearest, square, nearest)
        chosen[step] = nearest.max(-1)[1]
    return chosen


def rows_of(title: str, times: Mapping[str, Times], size: int, errors: list[str]) -> list[list[str]]:
    """Rows of the table; the first variant is the baseline. size: clips per run."""
    base = next(iter(times.values()))
    return [
        [
            title + name,
            f"{timing.processor / size * 1e3:.3f} / {timing.median / size * 1e3:.3f}",
            f"{base.processor / timing.processor:.1f}",
            error,
            f"{timing.first:.2f} s",
        ]
        for (name, timing), error in zip(times.items(), errors, strict=True)
    ]


def main() -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    rows = [*distance_rows(False), *distance_rows(True), *joints_rows(), *farthest_rows(4000), *farthest_rows(30000)]
    torch.set_num_threads(threads)
    columns = ["", "ms processor / clock", "x", "missing / extra; largest error", "first call"]
    show(f"Kernels: {FRAMES} frames, one hand, medians of {RUNS} runs of {CLIPS} clips", columns, rows)
