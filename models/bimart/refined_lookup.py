"""The rival that has everything but the networks: hands of the nearest training window, refined as ours are."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hoidata.batches.dataset import ClipSample
from hoidata.batches.requests import Request
from hoidata.clips.clip import SIDES, Clip, Side
from hoidata.hands import HandPair
from hoidata.refinement import GeneratedHand, fit_hands, refine_hands
from hoidata.sensors.keypoints import hand_keypoints
from models.bimart.family import clip_without_hands, world_from_canonical
from models.bimart.lookups import BASIS, NO_WINDOW, NearestWindow, hands_of, training_clips
from models.bimart.sampler import IDLE_M
from models.bimart.scene import FeatureConfig, Recorded, Scene, recorded_clip
from models.common.family import Family, LeftOut, Sources

FEATURES = FeatureConfig(BASIS, keypoints=64)


@dataclass(frozen=True)
class RefinedWindow:
    """samples: training clips by the hands that take part, in the order of ``nearest.clips``."""

    nearest: NearestWindow
    pair: HandPair
    samples: dict[tuple[bool, bool], list[ClipSample]]
    known: dict[str, Recorded] = field(default_factory=dict)

    @classmethod
    def load(cls, sources: Sources) -> "RefinedWindow":
        samples: dict[tuple[bool, bool], list[ClipSample]] = {}
        for sample in training_clips(sources.annotated):
            if sample.is_tracked:
                samples.setdefault(hands_of(sample), []).append(sample)
        return cls(NearestWindow.load(sources), sources.hands, samples)

    def sample(self, requests: Sequence[Request]) -> list[Clip | LeftOut]:
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> Clip | LeftOut:
        if request.trajectories is None or hands_of(request) not in self.samples:
            return LeftOut(request.motion_id, NO_WINDOW)
        hands, ids = self._hands(request), hand_keypoints(self.pair.right, FEATURES.keypoints)
        clip = clip_without_hands(request, self.nearest.synthetic)
        tracks = fit_hands(self.pair, request.betas, ids, hands, request.template_m)
        tracks = refine_hands(self.pair, ids, hands, tracks, clip.object)
        return replace(clip, hands={**clip.hands, **tracks})

    def _hands(self, request: Request) -> dict[Side, GeneratedHand]:
        """Keypoints of the windows, each as far from the object as it was recorded, world frame."""
        assert request.trajectories is not None
        scene = Scene.of(request.object, request.trajectories.object[: request.n_frames], BASIS)
        windows = [(self._recorded(request, number), frames) for number, frames in self.nearest.windows(request, scene)]
        keypoints = np.concatenate([clip.keypoints_m[:, frames] for clip, frames in windows], axis=1)
        ways = np.concatenate([clip.to_object_m[:, frames] for clip, frames in windows], axis=1)
        near = np.linalg.norm(ways, axis=-1).min(axis=-1) < IDLE_M
        world = world_from_canonical(request, scene)
        return {
            side: GeneratedHand(
                world @ keypoints[row].astype(np.float64), world.turn(ways[row].astype(np.float64)), near[row]
            )
            for row, side in enumerate(SIDES)
            if request.active_hands[row]
        }

    def _recorded(self, request: Request, number: int) -> Recorded:
        sample = self.samples[hands_of(request)][number]
        if sample.clip_id not in self.known:
            self.known[sample.clip_id] = recorded_clip(sample, self.pair, FEATURES)
        return self.known[sample.clip_id]


NEAREST_REFINED = Family("nearest-window-refined", "nearest training window, refined", RefinedWindow.load)
