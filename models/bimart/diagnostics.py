"""How near drawn contact maps come to the recorded ones, beside the mean map of training; and motions to their maps."""

from collections.abc import Sequence

import numpy as np
import torch

from hoidata.batches.dataset import ClipSample, HoiDataset
from hoidata.hands import HandPair
from hoidata.sensors.part_bps import distance_map
from models.bimart.lookups import training_clips
from models.bimart.sampler import BimArt, Path
from models.bimart.scene import FeatureConfig, Recorded, recorded_clip
from models.common.family import Figures, Sources

SAMPLES, CLIPS = 10, 32


def diagnose(model: BimArt, sources: Sources) -> Figures:
    """Millimetres, means over hands that take part, frames and places of at most ``CLIPS`` test clips.

    bimart-contact: error of a drawn map, of the best of ten, and of the mean training map of the object (of all objects
    where it is new). bimart-motion: error of keypoints made for the recorded map; discrepancy of the map that keypoints
    make from the one they were made for.
    """
    features = model.motion.config.features
    every = list(HoiDataset(sources.annotated, "test", crop="start"))
    chosen = every[:: -(-len(every) // CLIPS)]
    means = mean_maps(training_clips(sources.annotated), sources.hands, features)
    rows = [_clip(model, sample, recorded_clip(sample, sources.hands, features), means) for sample in chosen]
    if not rows:
        return {}
    drawn, best, mean, keypoints, apart = (float(column) for column in np.mean(rows, axis=0))
    contact = {"map_error_mm": drawn, f"best_of_{SAMPLES}_mm": best, "mean_training_map_mm": mean}
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


def _clip(
    model: BimArt, sample: ClipSample, clip: Recorded, means: dict[str, np.ndarray]
) -> tuple[float, float, float, float, float]:
    paths = [Path(clip.scene, clip.active_hands, seed) for seed in range(SAMPLES)]
    wanted = clip.contact_m.astype(np.float32)
    known = (clip.present & clip.active_hands[:, None])[..., None] & clip.scene.there
    drawn = model.maps(paths).reshape(SAMPLES, len(clip.scene), 2, -1).transpose(0, 2, 1, 3)
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
