"""Hands for one motion of an object, without a recording: several samples, before and after refinement, and how the
contact stands.

    path = keyframed_path(model, read_keyframes("keys.csv"))
    sampler = load_family("bimart").load(Sources(...))
    motions = hands_for(sampler, path.track, MotionWish(seed=1, samples=2))
"""

from dataclasses import dataclass, field, replace
from hashlib import sha256

import numpy as np
from scipy.spatial import KDTree

from hoidata.batches.requests import ObjectPoints, Request, Trajectories
from hoidata.clips.clip import SIDES, Clip, HandType, ObjectTrack, Side
from hoidata.clips.features import object_features, upright
from hoidata.errors import BadInput
from hoidata.hands import track_vertices
from hoidata.objects.sampling import SampledPoints, sample_points
from hoidata.objects.surface_index import surface_index
from hoidata.sensors.part_bps import distance_map
from models.bimart.family import HandsForPaths
from models.bimart.sampler import Made
from models.bimart.scene import Scene

LEAST_FRAMES = 8
TOUCH_M = 0.005
DOWN = (0.0, 0.0, -1.0)


@dataclass(frozen=True, eq=False)
class MotionWish:
    """seed: of everything that is drawn; samples: each is the same in whatever number it is asked for.

    hand: which take part. words: for the object. gravity: (3,) where things fall in the object's world. betas: (2, 10)
    shapes of left and right; template_m: (2, 778, 3) personal rest meshes, or None.
    """

    seed: int = 0
    samples: int = 1
    hand: HandType = "both"
    words: str = ""
    gravity: np.ndarray = field(default_factory=lambda: np.array(DOWN))
    betas: np.ndarray = field(default_factory=lambda: np.zeros((2, 10), np.float32))
    template_m: np.ndarray | None = None


@dataclass(frozen=True)
class Standing:
    """How a motion stands to the object. touching: per active hand (frame,) a vertex within 5 mm of the surface.

    deepest_m: (frame,) of any vertex; None for an object without an inside. acceleration_m_s2: mean over vertices.
    """

    touching: dict[Side, np.ndarray]
    deepest_m: np.ndarray | None
    acceleration_m_s2: float


@dataclass(frozen=True, eq=False)
class MadeHands:
    """clip: the motion; before: the hands before refinement. Distances are of ``points`` to the nearest vertex of each
    hand: reached_m (2, frame, point); asked_m (2, point) least over all frames, as the contact model asked for it,
    infinite where it did not look.
    """

    clip: Clip
    before: Clip
    points: SampledPoints
    reached_m: np.ndarray
    asked_m: np.ndarray
    standing: Standing
    standing_before: Standing
    seed: int
    number: int


def hands_for(sampler: HandsForPaths, thing: ObjectTrack, wish: MotionWish = MotionWish()) -> list[MadeHands]:
    """Motions of both (or one) hand for a motion of an object. Raises BadInput for one of less than 8 frames."""
    if thing.n_frames < LEAST_FRAMES:
        raise BadInput("object motion", f"{LEAST_FRAMES} frames or more", f"{thing.n_frames}", "give a longer motion")
    points = sample_points(thing.model)
    # One by one: the last bits of a matrix product depend on how many rows it has.
    return [_made(sampler, thing, _request(thing, wish, points, number), points) for number in range(wish.samples)]


def standing_of(clip: Clip, sampler: HandsForPaths) -> Standing:
    """See :class:`Standing`; exact distances."""
    thing, index, touching, depths, seconds = clip.object, surface_index(clip.object.model), {}, [], []
    object_from_world = thing.world_from_object.inverse()
    for side in SIDES:
        track = clip.hands[side]
        if not track.valid.any():
            continue
        skin = track_vertices(track, sampler.pair[side]).astype(np.float64)
        seen = object_from_world @ skin
        touching[side] = index.within(seen, thing.hinge_rad, TOUCH_M).any(axis=1) & track.valid
        if index.is_solid:
            depths.append(index.depth_m(seen, thing.hinge_rad).max(axis=1))
        seconds.append(np.linalg.norm(np.diff(skin, 2, axis=0), axis=-1).mean() * 900)
    deepest = np.max(depths, axis=0) if depths else None
    return Standing(touching, deepest, float(np.mean(seconds)))


def _request(thing: ObjectTrack, wish: MotionWish, points: SampledPoints, number: int) -> Request:
    drawn_from = f"{wish.seed} {number} {thing.model.name}"
    turn, origin = upright(wish.gravity), np.asarray(thing.translation_m[0], np.float64)
    world_from_model = np.eye(4)
    world_from_model[:3, :3], world_from_model[:3, 3] = turn.T, origin
    nothing = np.zeros((2, thing.n_frames, 9), np.float32), np.zeros((2, thing.n_frames), bool)
    return Request(
        motion_id=f"hands/{thing.model.name}" + (f"~{number}" if number else ""),
        object=thing.model,
        points=ObjectPoints(points.points_m, points.normals, points.part),
        text=np.zeros(512, np.float32),
        active_hands=np.array([wish.hand in (side, "both") for side in SIDES]),
        n_frames=thing.n_frames,
        seed=int.from_bytes(sha256(drawn_from.encode()).digest()[:7]),
        number=number,
        object_words=wish.words or thing.model.name,
        betas=wish.betas,
        template_m=wish.template_m,
        world_from_model=world_from_model,
        trajectories=Trajectories(*nothing, object_features(thing, turn, origin)),
    )


def _made(sampler: HandsForPaths, thing: ObjectTrack, request: Request, points: SampledPoints) -> MadeHands:
    made = sampler.made([request])[0]
    unrefined = replace(sampler, config=replace(sampler.config, refined=False))
    # The object stays exactly as it was given: features are float32.
    clip, before = (replace(own.clip(request, made), object=thing) for own in (sampler, unrefined))
    here = thing.points_in_world(points.points_m, points.part)
    reached = np.full((2, thing.n_frames, len(points.points_m)), np.inf, np.float32)
    for row, side in enumerate(SIDES):
        if clip.hands[side].valid.any():
            reached[row] = distance_map(here, track_vertices(clip.hands[side], sampler.pair[side]))
    asked = _asked(sampler, request, made, here)
    after, unrefined = standing_of(clip, sampler), standing_of(before, sampler)
    return MadeHands(clip, before, points, reached, asked, after, unrefined, request.seed, request.number)


def _asked(sampler: HandsForPaths, request: Request, made: Made, points_m: np.ndarray) -> np.ndarray:
    """(2, point) the least distance the contact map asks for at the places nearest to each point.

    points_m: (frame, point, 3) world.
    """
    assert request.trajectories is not None
    scene = Scene.of(request.object, request.trajectories.object, sampler.model.motion.config.features.basis)
    rotation, offset = request.world_from_model[:3, :3], request.world_from_model[:3, 3]
    places = (scene.model_from_canonical @ scene.place_m.astype(np.float64)) @ rotation.T + offset
    asked = np.full((2, points_m.shape[1]), np.inf, np.float32)
    maps = made.contact_m.reshape(len(places), 2, -1)
    for frame, own in enumerate(points_m):
        nearest = KDTree(own).query(places[frame, scene.there])[1]
        for row in np.flatnonzero(request.active_hands):
            np.minimum.at(asked[row], nearest, maps[frame, row, scene.there])
    return asked
