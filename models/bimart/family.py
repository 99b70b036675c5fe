"""The BimArt family: both hands for a given object motion; recorded wrists are ignored."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import groupby
from typing import Any, Literal

import numpy as np
import torch

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.clips.features import GLOBAL_ORIENT_6D, HAND_FEATURES
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import HandPair
from hoidata.hands.model import N_VERTICES
from hoidata.metrics.target_contact import TargetDistances
from hoidata.refinement import GeneratedKeypoints, fit_hands, refine_as_released, refine_hands
from hoidata.sensors.part_bps import BasisSettings, distance_map
from hoidata.settings import build_config
from hoidata.store.annotated import AnnotatedStore
from models.bimart.network import MotionModel
from models.bimart.sampler import BimArt, SampledMotion, SamplingTask, preset_of, sampling_of
from models.bimart.scene import FeatureConfig, RecordedClip, Scene, recorded_clip
from models.bimart.training import CONTACT, MOTION
from models.common.checkpoints import load_checkpoint
from models.common.family import Family, Figures, ReportsContact, Skipped, Sources, motion_clip, refuse_not_finite

NO_OBJECT_MOTION = "this method needs the motion of an object, and the request has none"
NO_OTHER = {"other path": "no training clip of its object", "other object": "all training clips are of its object"}
MAX_ACTIVE_M = 0.2  # a hand farther than this from the object is not active in a frame
DIAGNOSED_SAMPLES, DIAGNOSED_CLIPS = 10, 32
MAX_BATCH_SIZE = 16  # motions of one length that share a batch
Change = Literal["none", "other path", "other object", "zero map"]
Preset = Literal["ours", "paper"]
Shape = Literal["bounded", "fitted", "given"]
Refinement = Literal["ours", "paper", "none"]  # "paper": Eqs. 9 to 12 (``hoidata.refinement.released``)


@dataclass(frozen=True)
class FamilyConfig:
    """The section ``sample.bimart`` of params.yaml."""

    preset: Preset | None = None  # of sampling and refinement; None: the preset of the trained networks
    sampling: Mapping[str, Any] = field(default_factory=dict)  # changes to the preset, see ``SamplingConfig``
    refinement: Refinement | None = None  # of the fitted hands against the object; None: that of the preset
    # Fitted to the generated keypoints (Eq. 8), bounded or not, or that of the request; None: fitted for preset paper,
    # bounded for ours.
    shape: Shape | None = None


@dataclass(frozen=True)
class BimArtSampler(ReportsContact):
    """The trained networks of one dataset with their hand model, as a sampler of clips."""

    model: BimArt
    pair: HandPair
    synthetic: bool  # whether the networks were trained on generated clips
    refinement: Refinement = "ours"
    shape: Shape = "bounded"
    change: Change = "none"  # the condition that a negative control replaces
    annotated: AnnotatedStore | None = None  # the dataset, for negative controls

    @classmethod
    def load(cls, sources: Sources, refinement: Refinement | None = None, change: Change = "none") -> "BimArtSampler":
        """Load both checkpoints and the settings ``sample.bimart``."""
        config = build_config(FamilyConfig, sources.settings.get("bimart"), "params.yaml: sample.bimart")
        motion = load_checkpoint(sources.checkpoints / MOTION.name, MOTION, sources.device)
        assert isinstance(motion.network, MotionModel)
        preset: Preset = config.preset or preset_of(motion.network.config)
        sampling = sampling_of(preset, config.sampling, "params.yaml: sample.bimart.sampling")
        contact = load_checkpoint(sources.checkpoints / CONTACT.name, CONTACT, sources.device)
        model, synthetic = BimArt.of(contact, motion, sampling, sources.device), bool(motion.facts["synthetic"])
        refinement = refinement or config.refinement or preset
        shape = config.shape or ("fitted" if preset == "paper" else "bounded")
        return cls(model, sources.hands, synthetic, refinement, shape, change, sources.annotated)

    def sample_with_targets(
        self, requests: Sequence[Request]
    ) -> tuple[list[Clip | Skipped], list[TargetDistances | None]]:
        """Sample a clip per request, and its target contact map: None for a motion of another path or object.

        A motion conditioned on the map of zeros is compared with the map that it would have had: no hand can touch all
        object points.
        """
        motions: dict[int, SampledMotion] = {}  # by number of the request
        for batch in self._batches(requests):
            motions |= zip(batch, self.sample_motions([requests[number] for number in batch]), strict=True)
        answers, targets = list[Clip | Skipped](), list[TargetDistances | None]()
        has_target = self.change in ("none", "zero map")
        for number, request in enumerate(requests):
            motion = motions.get(number)
            answers.append(self.clip(request, motion) if motion else Skipped(request.motion_id, self._why_not(request)))
            targets.append(self.contact_target(request, motion) if motion and has_target else None)
        return answers, targets

    def _batches(self, requests: Sequence[Request]) -> list[list[int]]:
        """Numbers of the requests that can be answered, in batches of one length."""
        numbers = [number for number, request in enumerate(requests) if not self._why_not(request)]
        numbers.sort(key=lambda number: requests[number].n_frames)
        groups = [list(group) for _, group in groupby(numbers, key=lambda number: requests[number].n_frames)]
        return [
            group[first : first + MAX_BATCH_SIZE] for group in groups for first in range(0, len(group), MAX_BATCH_SIZE)
        ]

    def _why_not(self, request: Request) -> str:
        """The reason why a request is skipped; "" if it is not."""
        if request.trajectories is None:
            return NO_OBJECT_MOTION
        return NO_OTHER[self.change] if self.change in NO_OTHER and not self._others(request) else ""

    def _others(self, request: Request) -> list[ClipSample]:
        """Training clips whose motion or object a negative control uses instead of the request's."""
        assert self.annotated is not None
        is_same, name = self.change == "other path", request.object.name
        return [clip for clip in training_clips(self.annotated) if (clip.object_model.name == name) == is_same]

    def sample_motions(self, requests: Sequence[Request]) -> list[SampledMotion]:
        """Sample contact maps, keypoints and vectors to the object for requests of one length, canonical frame."""
        tasks = [SamplingTask(self._scene(request), request.active_hands, request.seed) for request in requests]
        if self.change != "zero map":
            return self.model.sample_motions(tasks)
        maps = self.model.sample_maps(tasks)
        motions = self.model.sample_motions(tasks, torch.zeros(maps.shape))
        return [replace(motion, contact_m=contact_m) for motion, contact_m in zip(motions, maps, strict=True)]

    def _scene(self, request: Request) -> Scene:
        """The request's scene, or the scene that a negative control uses instead."""
        basis = self.model.motion.config.features.basis
        if self.change in ("none", "zero map"):
            return requested_scene(request, basis)
        others = self._others(request)
        other = others[request.seed % len(others)]
        if self.change == "other path":
            # The last frame of a shorter motion is repeated.
            rows = np.minimum(np.arange(request.n_frames), other.length - 1)
            return Scene.of(request.object, other.object[rows], basis)
        return Scene.of(other.object_model, requested_motion(request), basis)

    def contact_target(self, request: Request, motion: SampledMotion) -> TargetDistances:
        """The target contact map of a motion, object frame; NaN for inactive hands."""
        scene, features = self._scene(request), self.model.motion.config.features
        points_m = scene.object_from_canonical @ scene.object_point_m.astype(np.float64)
        mask = np.concatenate([scene.point_exists & bool(is_active) for is_active in request.active_hands])
        distance_m = np.where(mask, motion.contact_m, np.nan).reshape(len(points_m), 2, -1)
        keypoint_ids = self.model.motion.keypoint_ids.cpu().numpy()
        hand_vertices = np.arange(N_VERTICES) if features.contact_map_target == "skin" else keypoint_ids
        return TargetDistances(points_m.astype(np.float32), distance_m, hand_vertices)

    def clip(self, request: Request, motion: SampledMotion) -> Clip:
        """Fit hands to the sampled keypoints, and refine them against the object."""
        world = world_from_canonical(request, requested_scene(request, self.model.motion.config.features.basis))
        hands = keypoints_in_world(request, world, motion.keypoints_m, motion.to_object_m)
        clip = clip_without_hands(request, self.synthetic)
        ids = self.model.motion.keypoint_ids.cpu().numpy()
        betas = request.betas if self.shape == "given" else None
        tracks = fit_hands(self.pair, betas, ids, hands, request.template_m, self.shape == "bounded")
        if self.refinement != "none":
            refine = refine_hands if self.refinement == "ours" else refine_as_released
            tracks = refine(self.pair, ids, hands, tracks, clip.object)
        return replace(clip, hands={**clip.hands, **tracks})


def requested_motion(request: Request) -> np.ndarray:
    """(frame, 10) the object's motion of a request that has one, model frame."""
    assert request.trajectories is not None
    return request.trajectories.object[: request.n_frames]


def requested_scene(request: Request, basis: BasisSettings) -> Scene:
    """The object's motion of a request that has one, with its basis point set."""
    return Scene.of(request.object, requested_motion(request), basis)


@lru_cache(maxsize=2)
def training_clips(annotated: AnnotatedStore) -> tuple[ClipSample, ...]:
    """All training clips of a dataset, uncropped."""
    split = HoiDataset(annotated, "train")
    return tuple(split.whole(clip_id) for clip_id in split.ids)


def world_from_canonical(request: Request, scene: Scene) -> RigidTransform:
    """(frame,) transforms from the object's canonical frame to the request's world."""
    rotation, offset = request.world_from_model[:3, :3], request.world_from_model[:3, 3]
    body = scene.model_from_canonical
    return RigidTransform(rotation @ body.rotation, body.translation @ rotation.T + offset)


def keypoints_in_world(
    request: Request, world: RigidTransform, keypoints_m: np.ndarray, to_object_m: np.ndarray
) -> dict[Side, GeneratedKeypoints]:
    """Keypoints and vectors to the object (side, frame, keypoint, 3) of active hands, canonical frame, in the world.

    A hand farther than ``MAX_ACTIVE_M`` from the object is not active in a frame.
    """
    # The fit reads a NaN keypoint as a frame without this hand, so non-finite values must be refused here.
    refuse_not_finite(request, keypoints_m[request.active_hands], to_object_m[request.active_hands])
    near = np.linalg.norm(to_object_m, axis=-1).min(axis=-1) < MAX_ACTIVE_M
    return {
        side: GeneratedKeypoints(
            world @ keypoints_m[side_index].astype(np.float64),
            world.turn(to_object_m[side_index].astype(np.float64)),
            near[side_index],
        )
        for side_index, side in enumerate(SIDES)
        if request.active_hands[side_index]
    }


def clip_without_hands(request: Request, synthetic: bool) -> Clip:
    """The request's object motion, with hands that no method has placed yet."""
    hands = torch.zeros(2, request.n_frames, HAND_FEATURES)
    # Identity rotations.
    hands[..., GLOBAL_ORIENT_6D.start :: 6] = hands[..., GLOBAL_ORIENT_6D.start + 3 :: 6] = 1
    return motion_clip(request, hands, torch.from_numpy(requested_motion(request)), synthetic)


def diagnose(sources: Sources) -> Figures:
    """Errors by network on at most ``DIAGNOSED_CLIPS`` test clips: mm, means over active hands, frames and points.

    bimart-contact: of a sampled contact map, of the best of ten, and of the object's mean training map; a new object
    has the mean map of all objects. bimart-motion: of the keypoints sampled for the recorded map, and the difference
    between their contact map and that map.
    """
    model = BimArtSampler.load(sources).model
    features = model.motion.config.features
    test_clips = sources.clips("test")
    chosen = test_clips[:: -(-len(test_clips) // DIAGNOSED_CLIPS)]
    means = mean_maps(training_clips(sources.annotated), sources.hands, features)
    errors = [_errors_mm(model, sample, recorded_clip(sample, sources.hands, features), means) for sample in chosen]
    if not errors:
        return {}
    sampled, best, mean, keypoints, difference = (float(column) for column in np.mean(errors, axis=0))
    contact = {"map_error_mm": sampled, f"best_of_{DIAGNOSED_SAMPLES}_mm": best, "mean_training_map_mm": mean}
    motion = {"keypoint_error_with_true_map_mm": keypoints, "map_discrepancy_mm": difference}
    return {"bimart-contact": contact, "bimart-motion": motion}


def mean_maps(samples: Sequence[ClipSample], pair: HandPair, features: FeatureConfig) -> dict[str, np.ndarray]:
    """Mean contact maps (2, N) of active hands in metres, by object; under "" that of all objects."""
    totals: dict[str, np.ndarray] = {}
    for sample in samples:
        clip = recorded_clip(sample, pair, features)
        mask = (clip.present & clip.active_hands[:, None])[..., None]
        total_m = (clip.contact_m * mask).sum(axis=1, dtype=np.float64)
        sum_and_count = np.stack((total_m, np.broadcast_to(mask.sum(axis=1), total_m.shape)))
        for name in (sample.object_model.name, ""):
            totals[name] = totals.get(name, 0) + sum_and_count
    return {name: total[0] / total[1].clip(1) for name, total in totals.items()}


def _errors_mm(
    model: BimArt, sample: ClipSample, clip: RecordedClip, means: dict[str, np.ndarray]
) -> tuple[float, float, float, float, float]:
    """Errors of a sampled map, of the best of ten, of the mean map, of keypoints, and of the keypoints' map."""
    tasks = [SamplingTask(clip.scene, clip.active_hands, seed) for seed in range(DIAGNOSED_SAMPLES)]
    recorded = clip.contact_m.astype(np.float32)
    mask = (clip.present & clip.active_hands[:, None])[..., None] & clip.scene.point_exists
    maps = model.sample_maps(tasks).reshape(DIAGNOSED_SAMPLES, len(clip.scene), 2, -1).transpose(0, 2, 1, 3)
    map_errors = [1000 * np.abs(one_map - recorded)[mask].mean() for one_map in maps]
    mean = means.get(sample.object_model.name, means[""])[:, None]
    contact_m = np.where(clip.active_hands[:, None, None], recorded, 0).transpose(1, 0, 2).reshape(len(clip.scene), -1)
    motion = model.sample_motions(tasks[:1], torch.from_numpy(contact_m)[None])[0]
    has_hand = mask.any(axis=2)
    keypoints = 1000 * np.linalg.norm(motion.keypoints_m - clip.keypoints_m, axis=-1)[has_hand].mean()
    max_m = model.motion.config.features.max_distance_m or np.inf
    keypoint_maps = np.stack([distance_map(clip.scene.object_point_m, hand) for hand in motion.keypoints_m])
    difference = 1000 * np.abs(np.minimum(keypoint_maps, max_m) - recorded)[mask].mean()
    mean_error = 1000 * np.abs(mean - recorded)[mask].mean()
    return float(np.mean(map_errors)), min(map_errors), mean_error, keypoints, difference


def _family(name: str, title: str, refinement: Refinement | None = None, change: Change = "none") -> Family:
    return Family(
        name,
        title,
        lambda sources: BimArtSampler.load(sources, refinement, change),
        networks=(CONTACT, MOTION) if name == "bimart" else (),
        uses=(CONTACT.name, MOTION.name),
        diagnose=diagnose if name == "bimart" else lambda sources: {},
    )


BIMART = _family("bimart", "BimArt: hands for the object's motion")
UNREFINED = _family("bimart-unrefined", "BimArt before refinement", refinement="none")
OTHER_PATH = _family("bimart-other-path", "BimArt conditioned on another motion of the object", change="other path")
OTHER_OBJECT = _family("bimart-other-object", "BimArt conditioned on another object", change="other object")
ZERO_MAP = _family("bimart-zero-map", "BimArt conditioned on a contact map of zeros", change="zero map")
