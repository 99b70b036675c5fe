"""All sensors of a hand-frame beside a per-frame loop over trimesh and one over libigl; whole recordings at 60 Hz.

``python -m bench.sensors``. One thread, libigl's own included. Hand-frames of the real recordings with
HOIDATA_MANIPNET; without, an embedded hand that wanders about generated objects. trimesh finds nearest triangles with
``rtree``; without that package its columns stay empty. The loops ask about the same closed mesh, and their answers are
compared with libigl's, signed by its winding numbers: all rays (libigl's in float32), distances and normals, and the
cells whose middle the object comes nearer than half an edge (nobody else tests boxes). The loops that are timed take
the faster signs, which err on these meshes: libigl's pseudonormals where triangles are slivers (a cell 3 cm from mug1
is said to be in it), trimesh's parity of a ray where parts of teapot2 overlap. Times are medians of the processor's
time, of batches and of calls of one hand-frame.
"""

import os
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

os.environ["IGL_NUM_THREADS"] = "1"  # read once, when libigl first shares out work

import igl
import numpy as np
import trimesh

from bench.harness import show
from hoidata.clips.clip import SIDES
from hoidata.clips.recording import HandRecording
from hoidata.datasets.base import RawTree, SequenceKey
from hoidata.datasets.manipnet.adapter import read_hand_recording
from hoidata.geometry.rotations import rotvec_to_rotmat
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import load_embedded_hands
from hoidata.hands.tracked_hand import HandState, TrackedHand
from hoidata.objects.model import ObjectModel
from hoidata.objects.surface_index import SurfaceIndex
from hoidata.sensors import OURS, Sensed, sense
from hoidata.sensors.mano_hand import mano_hand
from hoidata.sensors.settings import CELLS
from models.manipnet.control import recording_control
from models.manipnet.features import FeatureSettings, object_from_wrist

RUNS, FRAMES, SLOW_FRAMES, RATE = 5, 120, 6, 60
RECORDINGS = ("cube_med2", "cyl_med3", "cup1", "mug1", "teapot2")
TIMES = len(OURS.times_s)


class Asked(NamedTuple):
    """Hand-frames at one object: poses of a hand in its wrist's frame, object_from_wrist (frame, time)."""

    model: ObjectModel
    hand: TrackedHand
    state: HandState
    wrist: RigidTransform

    def taken(self, frames: np.ndarray | slice) -> "Asked":
        return self._replace(state=self.state.taken(frames), wrist=self.wrist[frames])


class Mesh(NamedTuple):
    """What the loops ask: the closed surface, outward."""

    vertices_m: np.ndarray
    faces: np.ndarray
    trimesh: trimesh.Trimesh


Loop = Callable[[Mesh, np.ndarray], tuple[np.ndarray, np.ndarray]]
Rays = Callable[[Mesh, np.ndarray, np.ndarray], list[np.ndarray]]


def main() -> None:
    root = os.environ.get("HOIDATA_MANIPNET")
    recordings = [read(Path(root), name) for name in RECORDINGS] if root else []
    asked = [at_object(recording) for recording in recordings] or generated()
    start = time.perf_counter()
    sense_all(asked[0].taken(slice(0, 2)), SurfaceIndex(asked[0].model))
    print(f"first call, compiling or reading what was compiled: {time.perf_counter() - start:.1f} s")
    heads = [
        "triangles",
        "index ms",
        "us a frame, batch",
        "one call",
        "p99",
        "trimesh us",
        "x",
        "libigl us",
        "x",
        "differ",
    ]
    rows = [row(one) for one in asked]
    what = f"{CELLS**3} cells, {asked[0].hand.n_sensors} x {TIMES} rays, {asked[0].hand.n_points} x {TIMES} distances"
    show(f"A hand-frame: {what}, normals", ["object", *heads], rows)
    if not find_spec("rtree"):
        print("rtree is not installed: no trimesh loop (pip install rtree)")
    if root:
        whole(recordings)
    else:
        print("HOIDATA_MANIPNET is not set: no real recordings")


def read(root: Path, name: str) -> HandRecording:
    return read_hand_recording(RawTree(root), SequenceKey("manipnet", "manipnet", name))


def at_object(recording: HandRecording) -> Asked:
    """The right hand in evenly spaced usable frames in which a fingertip is within 5 cm of the object."""
    hand, index = recording.tracked_hand("right"), SurfaceIndex(recording.object.model)
    frames = np.flatnonzero(recording.usable)[::10]
    seen, _ = object_from_wrist(recording_control(recording), "right", recording.time_s[frames], FeatureSettings())
    state = recording.state("right", frames)
    near = np.flatnonzero(index.within(seen[:, 0] @ state.tip_m, None, 0.05).any(axis=1))
    kept = near[np.linspace(0, len(near) - 1, FRAMES).astype(int)]
    return Asked(recording.object.model, hand, state.taken(kept), seen[kept])


def generated() -> list[Asked]:
    """A box of 12 triangles, tori of 4,000 and 22,832."""
    shapes = {"box": trimesh.creation.box((0.08, 0.06, 0.1))}
    for sections in ((50, 40), (118, 97)):
        torus = trimesh.creation.torus(0.05, 0.02, major_sections=sections[0], minor_sections=sections[1])
        shapes[f"torus {len(torus.faces)}"] = torus
    return [wandering(name, mesh) for name, mesh in shapes.items()]


def wandering(name: str, mesh: trimesh.Trimesh) -> Asked:
    random, hand = np.random.default_rng(0), mano_hand(load_embedded_hands(), "right")
    poses = rotvec_to_rotmat(random.normal(0, 0.2, (FRAMES, hand.n_joints - 1, 3)))
    turn = rotvec_to_rotmat(np.cumsum(random.normal(0, 0.05, (FRAMES + TIMES, 3)), axis=0))
    way = np.cumsum(random.normal(0, 0.003, (FRAMES + TIMES, 3)), axis=0)
    at = np.arange(FRAMES)[:, None] + np.arange(TIMES)
    middle = hand.wrist_from_canonical @ np.array([0.1, 0.0, -0.05])
    wrist = RigidTransform(turn[at], (way - way.mean(axis=0))[at] - turn[at] @ middle)
    part = np.zeros(len(mesh.vertices), np.uint8)
    return Asked(ObjectModel(name, np.array(mesh.vertices), np.array(mesh.faces), part), hand, hand.state(poses), wrist)


def sense_all(asked: Asked, index: SurfaceIndex) -> Sensed:
    return sense(asked.hand, asked.state, asked.wrist, None, index)


def row(asked: Asked) -> list[str]:
    start = time.process_time()
    index = SurfaceIndex(asked.model).prepare()
    built = time.process_time() - start
    n_frames, batches, single = len(asked.state.joint_m), [], []
    for _ in range(RUNS):
        start = time.process_time()
        sense_all(asked, index)
        batches.append((time.process_time() - start) / n_frames)
    for frame in range(n_frames):
        one = asked.taken(slice(frame, frame + 1))
        start = time.process_time()
        sense_all(one, index)
        single.append(time.process_time() - start)
    batch = float(np.median(batches))
    surface = next(iter(index.filled.values()))
    vertices, faces = surface.tree.vertices_m, surface.tree.corner
    mesh = Mesh(vertices, faces, trimesh.Trimesh(vertices, faces, process=False))
    few = asked.taken(np.linspace(0, n_frames - 1, SLOW_FRAMES).astype(int))
    truth, cells = sense_all(few, index), []
    for loop, rays in LOOPS:
        if loop is nearest_by_trimesh and not find_spec("rtree"):
            cells += ["-", "-"]
            continue
        times = slow_loop(few, mesh, loop, rays)[0]
        cells += [f"{1e6 * times:,.0f}", f"{times / batch:,.0f}"]
    answers = slow_loop(few, mesh, nearest_by_winding, rays_by_libigl)[1]
    differ = max(np.abs(a - b).max() for a, b in zip(answers, compared(truth), strict=True))
    figures = [f"{1e6 * batch:.0f}", f"{1e6 * np.median(single):.0f}", f"{1e6 * np.percentile(single, 99):.0f}"]
    return [
        asked.model.name,
        f"{len(asked.model.faces):,}",
        f"{1e3 * built:.0f}",
        *figures,
        *cells,
        f"{1e9 * differ:.2f} nm",
    ]


def slow_loop(asked: Asked, mesh: Mesh, loop: Loop, rays: Rays) -> tuple[float, list[np.ndarray]]:
    """Median seconds of a hand-frame, and its answers: occupancy, proximity and distances of all frames."""
    times, answers = [], []
    for frame in range(len(asked.state.joint_m)):
        start = time.process_time()
        answers.append(slow_frame(asked.taken(slice(frame, frame + 1)), mesh, loop, rays))
        times.append(time.process_time() - start)
    return float(np.median(times)), [np.stack(column) for column in zip(*answers, strict=True)]


def slow_frame(
    asked: Asked, mesh: Mesh, loop: Loop, rays: Rays
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The sensors of one frame the plain way: occupancy, proximity, distances, normals."""
    hand, state, wrist = asked.hand, asked.state, asked.wrist
    turn = state.joint_rotmats[:, hand.middle_knuckle] @ hand.wrist_from_canonical
    middle = state.joint_m[:, hand.middle_knuckle] + hand.wrist_from_canonical @ np.array(OURS.ambient_offset_m)
    steps = np.stack(np.meshgrid(*[np.arange(CELLS) - 4.5] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * OURS.cell_m
    cells = (wrist[:, 0] @ (RigidTransform(turn, middle) @ steps))[0]
    way = np.maximum(loop(mesh, cells)[0], 0.0)
    occupancy = np.where(way <= OURS.cell_m / 2, 1 - way / OURS.cell_m, 0.0)
    points = (wrist @ state.point_m[:, None]).reshape(-1, 3)
    distance, closest = loop(mesh, points)
    now = slice(0, hand.n_points)
    gradient = (points - closest)[now] / distance[now, None]
    gradient = wrist[:, 0].inverse().turn(gradient[None])[0] @ hand.wrist_from_canonical
    start = (wrist @ state.sensor_m[:, None]).reshape(-1, 3)
    ahead = wrist.turn(state.sensor_normal[:, None]).reshape(-1, 3)
    depth = loop(mesh, start)[0]
    touching = depth < OURS.touching_m
    back = np.where(touching, OURS.behind_m, 0.0)
    reach = np.where(touching, OURS.behind_m + 2 * OURS.touching_m, OURS.reach_m)
    met = first_entered(mesh, rays(mesh, start - back[:, None] * ahead, ahead), ahead, reach)
    missed = np.where(touching, np.where(depth < 0, -OURS.behind_m, 0.0), OURS.reach_m)
    proximity = np.where(np.isfinite(met), met - back, missed)
    return occupancy, proximity, np.minimum(distance, OURS.reach_m), gradient


def first_entered(mesh: Mesh, hits: list[np.ndarray], ahead: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """(ray,) way to the first triangle that faces the ray; hits: per ray rows of (triangle, way)."""
    met = np.full(len(reach), np.inf)
    for ray, found in enumerate(hits):
        if len(found):
            facing = mesh.trimesh.face_normals[found[:, 0].astype(int)] @ ahead[ray] < 0
            ways = found[facing & (found[:, 1] <= reach[ray]), 1]
            met[ray] = ways.min(initial=np.inf)
    return met


def compared(truth: Sensed) -> list[np.ndarray]:
    """Ours in the form of ``slow_frame``: only cells that the object comes within half an edge of count."""
    ambient = np.where(truth.ambient >= 0.5, truth.ambient, 0.0)
    flat = len(ambient), -1
    return [ambient, truth.proximity_m.reshape(flat), truth.distance_m.reshape(flat), truth.normal]


def nearest_by_trimesh(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance and nearest place."""
    closest, distance = trimesh.proximity.closest_point(mesh.trimesh, points)[:2]
    return np.where(mesh.trimesh.contains(points), -distance, distance), np.asarray(closest)


def rays_by_trimesh(mesh: Mesh, start: np.ndarray, ahead: np.ndarray) -> list[np.ndarray]:
    found = mesh.trimesh.ray.intersects_id(start, ahead, return_locations=True)
    triangle, ray, place = np.asarray(found[0]), np.asarray(found[1]), np.asarray(found[-1]).reshape(-1, 3)
    way = np.linalg.norm(place - start[ray], axis=1)
    return [np.stack([triangle[ray == one], way[ray == one]], axis=1) for one in range(len(start))]


def nearest_by_libigl(
    mesh: Mesh,
    points: np.ndarray,
    sign: igl.SignedDistanceType = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
) -> tuple[np.ndarray, np.ndarray]:
    distance, _, closest = igl.signed_distance(points, mesh.vertices_m, mesh.faces, sign)[:3]
    return np.asarray(distance), np.asarray(closest)


def nearest_by_winding(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slow, and right wherever the surface is closed."""
    return nearest_by_libigl(mesh, points, igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_WINDING_NUMBER)


def rays_by_libigl(mesh: Mesh, start: np.ndarray, ahead: np.ndarray) -> list[np.ndarray]:
    # In millimetres: it leaves out triangles of less than 1e-6 square units, seen along the ray.
    rays, vertices = zip(1e3 * start, ahead, strict=True), 1e3 * mesh.vertices_m
    found = (igl.ray_mesh_intersect(*ray, vertices, mesh.faces) for ray in rays)
    return [np.array([(hit[0], hit[1] / 1e3) for hit in hits or []]).reshape(-1, 2) for hits in found]


LOOPS: tuple[tuple[Loop, Rays], ...] = ((nearest_by_trimesh, rays_by_trimesh), (nearest_by_libigl, rays_by_libigl))


def whole(recordings: list[HandRecording]) -> None:
    """Every second frame (of 120 Hz) of all recordings, both hands: poses, transforms and sensors."""
    rows, total = [], np.zeros(2)
    for recording in recordings:
        start = np.array([time.perf_counter(), time.process_time()])
        frames = np.arange(0, recording.n_frames, round(recording.fps / RATE))
        control, index = recording_control(recording), SurfaceIndex(recording.object.model)
        for side in SIDES:
            hand, state = recording.tracked_hand(side), recording.state(side, frames)
            seen, _ = object_from_wrist(control, side, recording.time_s[frames], FeatureSettings())
            sense(hand, state, seen, None, index)
        took = np.array([time.perf_counter(), time.process_time()]) - start
        total += took
        rows.append([recording.sequence, f"{2 * len(frames):,}", f"{took[0]:.1f}", f"{took[1]:.1f}"])
    rows.append(["all", "", f"{total[0]:.1f}", f"{total[1]:.1f}"])
    show("Whole recordings at 60 Hz, both hands", ["recording", "hand-frames", "s", "s of processor"], rows)


if __name__ == "__main__":
    main()
