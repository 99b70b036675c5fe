"""USD: per clip a stage with animated meshes of hands and objects, in metres, y up.

``/world`` rotates the clip's world so that gravity is -y. A hand is a mesh with points per frame, which include pose
correctives and personal shape, and its 21 joints are a point prim. An object is a mesh below a transform per frame; its
moving part has a second transform, of its joint.
"""

from collections.abc import Iterable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from hoidata.clips.clip import FPS, SIDES, ObjectTrack, Side
from hoidata.errors import MissingResource
from hoidata.hands import track_vertices
from pipelines.exports.motion import ExportedClip, hinge_of
from pipelines.pages import glb


def write(folder: Path, clips: Iterable[ExportedClip]) -> None:
    """Write <clip>.usdc. Raises MissingResource without usd-core."""
    for item in clips:
        _write_stage(folder / f"{item.file_name}.usdc", item)


@cache
def _usd(module: str) -> Any:
    """Import a module of usd-core as Any, since its type stubs are empty."""
    try:
        return import_module(f"pxr.{module}")
    except ImportError as error:
        raise MissingResource("USD needs usd-core: pip install 'hoidata[export]'") from error


def _write_stage(path: Path, item: ExportedClip) -> None:
    stage: Any = _usd("Usd").Stage.CreateInMemory()
    _usd("UsdGeom").SetStageUpAxis(stage, _usd("UsdGeom").Tokens.y)
    _usd("UsdGeom").SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(FPS)
    stage.SetFramesPerSecond(FPS)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(item.clip.n_frames - 1)
    world = _transform(stage, "/world", np.zeros((1, 3)), glb.upright_rotation(item.clip.gravity).as_rotvec()[None])
    stage.SetDefaultPrim(world)
    world.SetCustomDataByKey("clip", item.clip.clip_id)
    world.SetCustomDataByKey("facts", orjson.dumps(item.motion_facts).decode())
    _add_object(stage, "/world/object", item.clip.object)
    for number, track in enumerate(item.clip.other_objects):
        _add_object(stage, f"/world/other_object_{number}", track)
    for side in SIDES:
        if item.clip.hands[side].valid.any():
            _add_hand(stage, item, side)
    stage.Export(str(path))


def _add_hand(stage: Any, item: ExportedClip, side: Side) -> None:
    track = item.clip.hands[side]
    vertices = track_vertices(track, item.hands[side])
    mesh = _mesh(stage, f"/world/{side}_hand", vertices[0], np.asarray(item.hands[side].faces), glb.HAND_COLOURS[side])
    joints = _usd("UsdGeom").Points.Define(stage, f"/world/{side}_joints")
    joints.CreateWidthsAttr([0.004] * 21)
    for frame in range(track.n_frames):
        mesh.GetPointsAttr().Set(_points(vertices[frame]), frame)
        joints.GetPointsAttr().Set(_points(item.joints[side][frame]), frame)
    tokens = _usd("UsdGeom").Tokens
    for prim in (mesh, joints):
        visibility = prim.CreateVisibilityAttr()
        for frame in np.flatnonzero(np.diff(track.valid, prepend=~track.valid[:1])):
            visibility.Set(tokens.inherited if track.valid[frame] else tokens.invisible, int(frame))


def _add_object(stage: Any, path: str, track: ObjectTrack) -> None:
    model = track.model
    _transform(stage, path, track.translation_m, track.rotvec)
    _mesh(stage, f"{path}/base", *model.part_mesh(0), glb.OBJECT_COLOUR)
    if model.hinge is None:
        return
    _transform(stage, f"{path}/moving_part", *model.hinge.node_motion(hinge_of(track)))
    vertices_m, faces = model.part_mesh(1)
    _mesh(stage, f"{path}/moving_part/mesh", vertices_m - model.hinge.origin_m, faces, glb.MOVING_PART_COLOUR)


def _mesh(stage: Any, path: str, vertices_m: np.ndarray, faces: np.ndarray, colour: tuple) -> Any:
    mesh = _usd("UsdGeom").Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(_usd("UsdGeom").Tokens.none)
    mesh.CreatePointsAttr(_points(vertices_m))
    mesh.CreateFaceVertexCountsAttr(_usd("Vt").IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(_usd("Vt").IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).ravel()))
    mesh.CreateDisplayColorAttr([colour])
    return mesh


def _points(points_m: np.ndarray) -> Any:
    return _usd("Vt").Vec3fArray.FromNumpy(np.ascontiguousarray(points_m, np.float32))


def _transform(stage: Any, path: str, translation_m: np.ndarray, rotvec: np.ndarray) -> Any:
    """Add a transform with (frame, 3) translations and axis-angles; a single frame gives a static transform."""
    xform = _usd("UsdGeom").Xform.Define(stage, path)
    double = _usd("UsdGeom").XformOp.PrecisionDouble
    translate, orient = xform.AddTranslateOp(double), xform.AddOrientOp(double)
    quaternions = glb.continuous_quaternions(rotvec).tolist()
    for frame, (position, (x, y, z, w)) in enumerate(zip(translation_m.tolist(), quaternions, strict=True)):
        time = _usd("Usd").TimeCode.Default() if len(translation_m) == 1 else _usd("Usd").TimeCode(frame)
        translate.Set(_usd("Gf").Vec3d(*position), time)
        orient.Set(_usd("Gf").Quatd(w, x, y, z), time)
    return xform.GetPrim()
