"""BimArt as a family: hands for the object's motion of a request; recorded wrists are not looked at."""

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
from hoidata.metrics.asked import AskedDistances
from hoidata.refinement import GeneratedHand, RefinementSettings, fit_hands, refine_hands
from hoidata.sensors.part_bps import distance_map
from hoidata.settings import build_config
from hoidata.store.annotated import AnnotatedStore
from models.bimart.learning import CONTACT, MOTION
from models.bimart.network import MotionModel
from models.bimart.sampler import BimArt, Made, Path, preset_of, sampling_of
from models.bimart.scene import FeatureConfig, Recorded, Scene, recorded_clip
from models.common.checkpoints import load_checkpoint
from models.common.family import Family, Figures, LeftOut, Sources, motion_clip, refuse_not_finite

NO_OBJECT_MOTION = "it makes hands for the motion of an object, and none was given"
NO_OTHER = {"other path": "no training clip of its object", "other object": "all training clips are of its object"}
DIAGNOSED_SAMPLES, DIAGNOSED_CLIPS = 10, 32
AT_ONCE = 16  # motions of one length that share a batch
Change = Literal["none", "other path", "other object", "zero map"]


@dataclass(frozen=True)
class FamilyConfig:
    """preset: how the networks are walked, as they were trained where nothing is told; sampling: laid over it.

    refined: hands are refined against the object after they are fitted.
    """

    preset: Literal["ours", "paper"] | None = None
    sampling: Mapping[str, Any] = field(default_factory=dict)
    refined: bool = True
    refinement: RefinementSettings = field(default_factory=RefinementSettings)


@dataclass(frozen=True)
class HandsForPaths:
    """The trained networks of one dataset with their hands. change: what a control is told instead of the truth."""

    model: BimArt
    pair: HandPair
    config: FamilyConfig
    synthetic: bool
    change: Change = "none"
    annotated: AnnotatedStore | None = None

    @classmethod
    def load(cls, sources: Sources, refined: bool = True, change: Change = "none") -> "HandsForPaths":
        config = build_config(FamilyConfig, sources.settings.get("bimart"), "params.yaml: sample.bimart")
        motion = load_checkpoint(sources.checkpoints / MOTION.name, MOTION, sources.device)
        assert isinstance(motion.network, MotionModel)
        preset = config.preset or preset_of(motion.network.config)
        sampling = sampling_of(preset, config.sampling, "params.yaml: sample.bimart.sampling")
        contact = load_checkpoint(sources.checkpoints / CONTACT.name, CONTACT, sources.device)
        model = BimArt.of(contact, motion, sampling, sources.device)
        synthetic = bool(motion.facts["synthetic"])
        config = replace(config, refined=config.refined and refined)
        return cls(model, sources.hands, config, synthetic, change, sources.annotated)

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        return self.sample_asked(requests)[0]

    def sample_asked(self, requests: Sequence[Request]) -> tuple[list[Clip | LeftOut], list[AskedDistances | None]]:
        """Motions, and the contact map each was made for; None where it was made for none.

        Beside motions that were told zeros stands the map that they would have been told: zeros no hand can meet.
        """
        found: dict[int, Made] = {}
        for rows in self._alike(requests):
            found |= zip(rows, self.made([requests[row] for row in rows]), strict=True)
        answers: list[Clip | LeftOut] = [
            self.clip(request, found[row]) if row in found else LeftOut(request.motion_id, self._why_not(request))
            for row, request in enumerate(requests)
        ]
        told = self.change in ("none", "zero map")  # other places are not of this object
        maps = [
            self.asked(request, found[row]) if told and row in found else None for row, request in enumerate(requests)
        ]
        return answers, maps

    def _alike(self, requests: Sequence[Request]) -> list[list[int]]:
        """Rows of requests of one length, at most so many together."""
        rows = [row for row, request in enumerate(requests) if not self._why_not(request)]
        rows.sort(key=lambda row: requests[row].n_frames)
        groups = [list(own) for _, own in groupby(rows, key=lambda row: requests[row].n_frames)]
        return [own[first : first + AT_ONCE] for own in groups for first in range(0, len(own), AT_ONCE)]

    def _why_not(self, request: Request) -> str:
        """Why a request has no answer; "" for one that has."""
        if request.trajectories is None:
            return NO_OBJECT_MOTION
        return NO_OTHER[self.change] if self.change in NO_OTHER and not self._others(request) else ""

    def _others(self, request: Request) -> list[ClipSample]:
        """Training clips whose motion, or whose object, a control takes for the request's."""
        assert self.annotated is not None
        is_same, name = self.change == "other path", request.object.name
        return [clip for clip in training_clips(self.annotated) if (clip.object_model.name == name) == is_same]

    def made(self, requests: Sequence[Request]) -> list[Made]:
        """Maps, keypoints and ways to the object for requests of one length, canonical frame."""
        paths = [Path(self._scene(request), request.active_hands, request.seed) for request in requests]
        if self.change != "zero map":
            return self.model.make(paths)
        drawn = self.model.maps(paths)
        made = self.model.make(paths, torch.zeros(drawn.shape))
        return [replace(one, contact_m=own) for one, own in zip(made, drawn, strict=True)]

    def _scene(self, request: Request) -> Scene:
        """The motion of a request, or what a control takes for it."""
        basis, thing = self.model.motion.config.features.basis, _path(request)
        if self.change in ("none", "zero map"):
            return self._true_scene(request)
        others = self._others(request)
        other = others[request.seed % len(others)]
        if self.change == "other path":  # a shorter motion stays where it ends
            rows = np.minimum(np.arange(request.n_frames), other.length - 1)
            return Scene.of(request.object, other.object[rows], basis)
        return Scene.of(other.object_model, thing, basis)

    def asked(self, request: Request, made: Made) -> AskedDistances:
        """The contact map a motion was made for, at places of its object; not a number for hands that take no part."""
        scene, features = self._scene(request), self.model.motion.config.features
        places = scene.object_from_canonical @ scene.place_m.astype(np.float64)
        known = np.concatenate([scene.there & bool(hand) for hand in request.active_hands])
        distance = np.where(known, made.contact_m, np.nan).reshape(len(places), 2, -1)
        skin = np.arange(N_VERTICES) if features.map_of == "skin" else self.model.motion.keypoint_ids.cpu().numpy()
        return AskedDistances(places.astype(np.float32), distance, skin)

    def generated(self, request: Request, made: Made) -> dict[Side, GeneratedHand]:
        """Keypoints and ways to the object in the world, of the hands that take part."""
        world = world_from_canonical(request, self._true_scene(request))
        # A fit takes a keypoint that is no number for a frame without this hand.
        refuse_not_finite(request, made.keypoints_m[request.active_hands], made.to_object_m[request.active_hands])
        return {
            side: GeneratedHand(
                world @ made.keypoints_m[row].astype(np.float64),
                world.turn(made.to_object_m[row].astype(np.float64)),
                made.active[row],
            )
            for row, side in enumerate(SIDES)
            if request.active_hands[row]
        }

    def clip(self, request: Request, made: Made) -> Clip:
        """The hands fitted to what was made, and refined against the object."""
        hands, clip = self.generated(request, made), clip_without_hands(request, self.synthetic)
        ids = self.model.motion.keypoint_ids.cpu().numpy()
        tracks = fit_hands(self.pair, request.betas, ids, hands, request.template_m)
        if self.config.refined:
            tracks = refine_hands(self.pair, ids, hands, tracks, clip.object, self.config.refinement)
        return replace(clip, hands={**clip.hands, **tracks})

    def _true_scene(self, request: Request) -> Scene:
        return Scene.of(request.object, _path(request), self.model.motion.config.features.basis)


def _path(request: Request) -> np.ndarray:
    assert request.trajectories is not None
    return request.trajectories.object[: request.n_frames]


@lru_cache(maxsize=2)
def training_clips(annotated: AnnotatedStore) -> tuple[ClipSample, ...]:
    """All training clips of a dataset, whole."""
    split = HoiDataset(annotated, "train")
    return tuple(split.whole(own) for own in split.ids)


def world_from_canonical(request: Request, scene: Scene) -> RigidTransform:
    """Of every frame of a request."""
    rotation, offset = request.world_from_model[:3, :3], request.world_from_model[:3, 3]
    body = scene.model_from_canonical
    return RigidTransform(rotation @ body.rotation, body.translation @ rotation.T + offset)


def clip_without_hands(request: Request, synthetic: bool) -> Clip:
    """The object as it is asked for, and hands that nobody has placed yet."""
    nothing = torch.zeros(2, request.n_frames, HAND_FEATURES)
    nothing[..., GLOBAL_ORIENT_6D.start :: 6] = nothing[..., GLOBAL_ORIENT_6D.start + 3 :: 6] = 1
    return motion_clip(request, nothing, torch.from_numpy(_path(request)), synthetic)


def diagnose(sources: Sources) -> Figures:
    """Millimetres, means over hands that take part, frames and places of at most ``DIAGNOSED_CLIPS`` test clips.

    bimart-contact: error of a drawn map, of the best of ten, and of the mean training map of the object (of all objects
    where it is new). bimart-motion: error of keypoints made for the recorded map; discrepancy of the map that keypoints
    make from the one they were made for.
    """
    model = HandsForPaths.load(sources).model
    features = model.motion.config.features
    every = list(HoiDataset(sources.annotated, "test", crop="start"))
    chosen = every[:: -(-len(every) // DIAGNOSED_CLIPS)]
    means = mean_maps(training_clips(sources.annotated), sources.hands, features)
    rows = [_errors_mm(model, sample, recorded_clip(sample, sources.hands, features), means) for sample in chosen]
    if not rows:
        return {}
    drawn, best, mean, keypoints, apart = (float(column) for column in np.mean(rows, axis=0))
    contact = {"map_error_mm": drawn, f"best_of_{DIAGNOSED_SAMPLES}_mm": best, "mean_training_map_mm": mean}
    motion = {"keypoint_error_with_true_map_mm": keypoints, "map_discrepancy_mm": apart}
    return {"bimart-contact": contact, "bimart-motion": motion}


def mean_maps(samples: Sequence[ClipSample], pair: HandPair, features: FeatureConfig) -> dict[str, np.ndarray]:
    """(2, place) mean distances by object, and of all objects under ""; of hands that take part."""
    totals: dict[str, np.ndarray] = {}
    for sample in samples:
        clip = recorded_clip(sample, pair, features)
        known = (clip.present & clip.active_hands[:, None])[..., None]
        own = np.stack(
            ((clip.contact_m * known).sum(axis=1, dtype=np.float64), known.sum(axis=1) + 0 * clip.contact_m[:, 0])
        )
        for name in (sample.object_model.name, ""):
            totals[name] = totals.get(name, 0) + own
    return {name: own[0] / own[1].clip(1) for name, own in totals.items()}


def _errors_mm(
    model: BimArt, sample: ClipSample, clip: Recorded, means: dict[str, np.ndarray]
) -> tuple[float, float, float, float, float]:
    paths = [Path(clip.scene, clip.active_hands, seed) for seed in range(DIAGNOSED_SAMPLES)]
    wanted = clip.contact_m.astype(np.float32)
    known = (clip.present & clip.active_hands[:, None])[..., None] & clip.scene.there
    drawn = model.maps(paths).reshape(DIAGNOSED_SAMPLES, len(clip.scene), 2, -1).transpose(0, 2, 1, 3)
    errors = [1000 * np.abs(own - wanted)[known].mean() for own in drawn]
    mean = means.get(sample.object_model.name, means[""])[:, None]
    maps = torch.from_numpy(
        np.where(clip.active_hands[:, None, None], wanted, 0).transpose(1, 0, 2).reshape(1, len(clip.scene), -1)
    )
    made = model.make(paths[:1], maps)[0]
    own = known.any(axis=2)
    keypoints = 1000 * np.linalg.norm(made.keypoints_m - clip.keypoints_m, axis=-1)[own].mean()
    most = model.motion.config.features.most_m or np.inf
    own_maps = np.stack([np.minimum(distance_map(clip.scene.place_m, hand), most) for hand in made.keypoints_m])
    apart = 1000 * np.abs(own_maps - wanted)[known].mean()
    return float(np.mean(errors)), min(errors), 1000 * np.abs(mean - wanted)[known].mean(), keypoints, apart


def _family(name: str, title: str, refined: bool = True, change: Change = "none") -> Family:
    return Family(
        name,
        title,
        lambda sources: HandsForPaths.load(sources, refined, change),
        networks=(CONTACT, MOTION) if name == "bimart" else (),
        uses=(CONTACT.name, MOTION.name),
        diagnose=diagnose if name == "bimart" else lambda sources: {},
    )


BIMART = _family("bimart", "BimArt: hands for the object's motion")
UNREFINED = _family("bimart-unrefined", "BimArt before refinement", refined=False)
OTHER_PATH = _family("bimart-other-path", "BimArt told another motion of the object", change="other path")
OTHER_OBJECT = _family("bimart-other-object", "BimArt told another object", change="other object")
ZERO_MAP = _family("bimart-zero-map", "BimArt told a contact map of zeros", change="zero map")
