"""Hands for any object motion, without a recording: several samples, before and after refinement, with measures.

path = keyframed_path(model, read_keyframes("keys.csv"))
sampler = load_family("bimart").load(Sources(...))
motions = hands_for(sampler, path.track, HandSamplingOptions(seed=1, samples=2))
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import KDTree

from hoidata.batches.requests import ObjectPoints, Request, Trajectories
from hoidata.clips.clip import FPS, SIDES, Clip, HandType, ObjectTrack, Side
from hoidata.clips.features import object_features, upright
from hoidata.errors import BadInput
from hoidata.hands import track_vertices
from hoidata.objects.model import articulate
from hoidata.objects.sampling import SampledPoints, sample_points
from hoidata.objects.surface_index import surface_index
from hoidata.sensors.part_bps import distance_map
from models.bimart.family import BimArtSampler
from models.bimart.sampler import SampledMotion
from models.common.repeatable import seed_of

MIN_FRAMES = 8
TOUCH_M = 0.005
DOWN = (0.0, 0.0, -1.0)


@dataclass(frozen=True, eq=False)
class HandSamplingOptions:
    """Options of ``hands_for``."""

    seed: int = 0  # of all random numbers
    samples: int = 1  # a sample does not depend on how many are requested
    hand: HandType = "both"  # the active hands
    words: str = ""  # the object's name in the clip
    gravity: np.ndarray = field(default_factory=lambda: np.array(DOWN))  # (3,) unit vector in the object's world
    betas: np.ndarray = field(default_factory=lambda: np.zeros((2, 10), np.float32))  # (2, 10) shapes, left and right
    template_m: np.ndarray | None = None  # (2, 778, 3) personal rest meshes


@dataclass(frozen=True)
class ContactMeasures:
    """Contact and smoothness measures of a motion."""

    touching: dict[Side, np.ndarray]  # by active hand: (frame,) bool, some vertex within 5 mm of the surface
    deepest_m: np.ndarray | None  # (frame,) largest penetration depth; None for an object without an inside
    acceleration_m_s2: float  # mean over vertices and frames


@dataclass(frozen=True, eq=False)
class SampledHands:
    """One sampled motion, before and after refinement."""

    clip: Clip
    before: Clip  # without refinement
    points: SampledPoints
    reached_m: np.ndarray  # (2, frame, point) distance from each point to the nearest vertex of each hand
    target_m: np.ndarray  # (2, frame, point) float16 target distance of the contact map; inf for an inactive hand
    standing: ContactMeasures
    unrefined_measures: ContactMeasures  # of ``before``
    seed: int
    number: int


def hands_for(
    sampler: BimArtSampler, object_track: ObjectTrack, options: HandSamplingOptions = HandSamplingOptions()
) -> list[SampledHands]:
    """Sample motions of both hands, or one, for an object motion. Raises BadInput for less than 8 frames."""
    if object_track.n_frames < MIN_FRAMES:
        got = f"{object_track.n_frames}"
        raise BadInput("object motion", f"{MIN_FRAMES} frames or more", got, "give a longer motion")
    points = sample_points(object_track.model)
    requests = [_request(object_track, options, points, number) for number in range(options.samples)]
    # One by one: the last bits of a matrix product depend on its number of rows.
    return [_sample_motion(sampler, object_track, request, points) for request in requests]


def contact_measures(clip: Clip, sampler: BimArtSampler) -> ContactMeasures:
    """Measure a clip with exact distances to the object's surface."""
    object_track, index = clip.object, surface_index(clip.object.model)
    touching, depths_m, accelerations = {}, [], []
    object_from_world = object_track.world_from_object.inverse()
    for side in SIDES:
        track = clip.hands[side]
        if not track.valid.any():
            continue
        vertices_m = track_vertices(track, sampler.pair[side]).astype(np.float64)
        vertices_object_m = object_from_world @ vertices_m
        touching[side] = index.within(vertices_object_m, object_track.hinge_rad, TOUCH_M).any(axis=1) & track.valid
        if index.is_solid:
            depths_m.append(index.depth_m(vertices_object_m, object_track.hinge_rad).max(axis=1))
        accelerations.append(np.linalg.norm(np.diff(vertices_m, 2, axis=0), axis=-1).mean() * FPS**2)
    deepest_m = np.max(depths_m, axis=0) if depths_m else None
    return ContactMeasures(touching, deepest_m, float(np.mean(accelerations)))


def _request(object_track: ObjectTrack, options: HandSamplingOptions, points: SampledPoints, number: int) -> Request:
    model_from_world, origin = upright(options.gravity), np.asarray(object_track.translation_m[0], np.float64)
    world_from_model = np.eye(4)
    world_from_model[:3, :3], world_from_model[:3, 3] = model_from_world.T, origin
    no_wrists = np.zeros((2, object_track.n_frames, 9), np.float32), np.zeros((2, object_track.n_frames), bool)
    return Request(
        motion_id=f"hands/{object_track.model.name}" + (f"~{number}" if number else ""),
        object=object_track.model,
        points=ObjectPoints(points.points_m, points.normals, points.part),
        text=np.zeros(512, np.float32),
        active_hands=np.array([options.hand in (side, "both") for side in SIDES]),
        n_frames=object_track.n_frames,
        seed=seed_of(f"{options.seed} {number} {object_track.model.name}"),
        number=number,
        object_words=options.words or object_track.model.name,
        betas=options.betas,
        template_m=options.template_m,
        world_from_model=world_from_model,
        trajectories=Trajectories(*no_wrists, object_features(object_track, model_from_world, origin)),
    )


def _sample_motion(
    sampler: BimArtSampler, object_track: ObjectTrack, request: Request, points: SampledPoints
) -> SampledHands:
    motion = sampler.sample_motions([request])[0]
    samplers = sampler, replace(sampler, refinement="none")
    # Features are float32: the clips get the given track instead of the one read from features.
    refined_clip, unrefined_clip = (replace(one.clip(request, motion), object=object_track) for one in samplers)
    points_world_m = object_track.points_in_world(points.points_m, points.part)
    distance_m = np.full((2, object_track.n_frames, len(points.points_m)), np.inf, np.float32)
    for side_index, side in enumerate(SIDES):
        if (track := refined_clip.hands[side]).valid.any():
            distance_m[side_index] = distance_map(points_world_m, track_vertices(track, sampler.pair[side]))
    return SampledHands(
        clip=refined_clip,
        before=unrefined_clip,
        points=points,
        reached_m=distance_m,
        target_m=_target_distances(sampler, request, motion, points, object_track),
        standing=contact_measures(refined_clip, sampler),
        unrefined_measures=contact_measures(unrefined_clip, sampler),
        seed=request.seed,
        number=request.number,
    )


def _target_distances(
    sampler: BimArtSampler, request: Request, motion: SampledMotion, points: SampledPoints, object_track: ObjectTrack
) -> np.ndarray:
    """(2, frame, point) float16 target distance of the contact map's object point nearest to each sampled point."""
    target = sampler.contact_target(request, motion)
    points_m = articulate(points.points_m, points.part, object_track.model.hinge, object_track.hinge_rad)
    distance_m = np.full((2, object_track.n_frames, points_m.shape[1]), np.inf, np.float16)
    for frame, frame_points_m in enumerate(np.broadcast_to(points_m, (object_track.n_frames, *points_m.shape[1:]))):
        for side in np.flatnonzero(request.active_hands):
            has_target = np.isfinite(target.distance_m[frame, side])
            nearest = KDTree(target.place_m[frame, has_target]).query(frame_points_m)[1]
            distance_m[side, frame] = target.distance_m[frame, side, has_target][nearest]
    return distance_m
