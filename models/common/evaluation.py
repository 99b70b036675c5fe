"""Held-out figures of the four models of one dataset, each beside its baselines.

Thresholds are chosen on validation clips; every figure is over the test split, which no training ever opened.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hoidata.batches.dataset import ClipBatch, ClipSample, HoiDataset, collate
from hoidata.files import atomic_file
from hoidata.hands import HandPair
from hoidata.store.annotated import AnnotatedStore, load_annotated
from models.common import metrics
from models.common.checkpoints import FILE_NAME, Checkpoint, empty_reason, load_checkpoint, motion_generator
from models.common.config import build_config
from models.common.features import Hands, object_hinge_rad, object_position_m, object_rotmat
from models.common.sampling import SamplerConfig
from models.common.surface import Surface
from models.text2hoi.contact import ContactModel, normalised_points
from models.text2hoi.diffusion import Condition
from models.text2hoi.length import LengthModel
from models.text2hoi.refiner import RefinerModel, refine

AT_ONCE = 32
TIME_BINS = 50
NEEDED_TO_MEASURE = {"diffusion": {"contact"}, "refiner": {"contact", "diffusion"}}


@dataclass(frozen=True)
class EvaluationConfig:
    """samples: motions per clip, of which the best counts. refined: how many of them are refined and measured.

    frame_stride: every how many frames meshes are measured.
    """

    seed: int = 0
    contact_samples: int = 32
    samples: int = 8
    refined: int = 2
    sampler_steps: int = 20
    guidance: float = 1.0
    frame_stride: int = 3
    field_resolution: int = 48


def evaluate_dataset(
    annotated_root: str | Path,
    checkpoints: str | Path,
    out_json: str | Path,
    params: Mapping[str, Any],
    hands: HandPair | None = None,
    *,
    threads: int = 2,
) -> dict[str, Any]:
    """Evaluate the models in ``checkpoints/<model>`` on the test clips; the figures, also written as JSON.

    Numbers stand under the model's name; a dataset or model that is empty says why under "empty".
    """
    config = build_config(EvaluationConfig, params, "params.yaml: evaluate")
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision("medium")
    figures = _figures(Path(annotated_root), Path(checkpoints), config, hands)
    with atomic_file(out_json) as part:
        part.write_text(json.dumps(figures, indent=2, sort_keys=True, allow_nan=False) + "\n")
    return figures


def _figures(root: Path, checkpoints: Path, config: EvaluationConfig, hands: HandPair | None) -> dict[str, Any]:
    for folder in ("clips", "annotation", "contact"):
        if reason := empty_reason(root / folder):
            return {"empty": reason, "held_out_clips": 0}
    annotated = load_annotated(root, hands)
    test = list(HoiDataset(annotated, "test", crop="start"))
    if not test:
        return {"empty": "no test clips", "held_out_clips": 0}
    found: dict[str, Any] = {"held_out_clips": len(test), "synthetic": any(sample.synthetic for sample in test)}
    loaded: dict[str, Checkpoint] = {}
    for name in ("contact", "length", "diffusion", "refiner"):
        if reason := empty_reason(checkpoints / name):
            found[name] = {"empty": reason}
        elif (checkpoints / name / FILE_NAME).is_file():
            loaded[name] = load_checkpoint(checkpoints / name, name)
    rounds = Evaluation(annotated, test, config, loaded)
    for name in loaded:
        if NEEDED_TO_MEASURE.get(name, set()) <= set(loaded):
            found[name] = {key: round(value, 6) for key, value in getattr(rounds, name)().items()}
    return found


class Evaluation:
    """The four rounds over one dataset's test clips; each gives flat numbers."""

    def __init__(
        self,
        annotated: AnnotatedStore,
        test: list[ClipSample],
        config: EvaluationConfig,
        loaded: Mapping[str, Checkpoint],
    ) -> None:
        self.annotated, self.test, self.config, self.loaded = annotated, test, config, loaded
        self.train = list(HoiDataset(annotated, "train", crop="start"))
        self.held_out = list(HoiDataset(annotated, "validation", crop="start")) or self.train
        self.hands = Hands(annotated.store.hand_pair())

    def contact(self) -> dict[str, float]:
        """F1 of the mean of samples at the checkpoint's threshold, beside mean maps at thresholds chosen alike."""
        checkpoint = self.loaded["contact"]
        network = checkpoint.network
        assert isinstance(network, ContactModel)
        chances = contact_chances(network, self.test, self.config.contact_samples, self.config.seed)
        true = _maps(self.test)
        f1 = metrics.mean_f1(chances, true, checkpoint.contact_threshold)
        baselines = {name: self._baseline_f1(name, true) for name in ("index", "spatial", "object")}
        return {
            "clips": len(self.test),
            "f1": f1,
            "f1_mean_map": max(baselines["index"], baselines["spatial"]),
            "f1_margin": f1 - max(baselines["index"], baselines["spatial"]),
            "f1_mean_map_by_index": baselines["index"],
            "f1_mean_map_by_place": baselines["spatial"],
            "f1_mean_map_of_same_object": baselines["object"],
            "threshold": checkpoint.contact_threshold,
        }

    def _baseline_f1(self, kind: str, true: np.ndarray) -> float:
        threshold = metrics.best_threshold(mean_maps(self.train, self.held_out, kind), _maps(self.held_out))
        return metrics.mean_f1(mean_maps(self.train, self.test, kind), true, threshold)

    def length(self) -> dict[str, float]:
        """Mean absolute error of the expected length, in frames, beside the mean length of the training clips."""
        network = self.loaded["length"].network
        assert isinstance(network, LengthModel)
        batch = collate(self.test, with_entries=False)
        true = batch.lengths.numpy()
        predicted = network.expected_frames(batch.text[:, 0], batch.acts).numpy()
        mean = np.mean([sample.length for sample in self.train])
        error, baseline = float(np.abs(predicted - true).mean()), float(np.abs(mean - true).mean())
        return {
            "clips": len(true),
            "mae_frames": error,
            "mae_mean_length_frames": baseline,
            "mae_ratio": error / max(baseline, 1e-9),
        }

    def diffusion(self) -> dict[str, float]:
        """Joint error of the best of some samples, beside mean poses and samples of another clip's prompt."""
        own = self._best_errors([sample.text[0] for sample in self.test])
        shuffled = self._best_errors(shuffled_prompts(self.test, self.config.seed))
        pose, motion = mean_joints(self.train, 1), mean_joints(self.train, TIME_BINS)
        return {
            "clips": len(self.test),
            "samples": self.config.samples,
            "joint_error_mm": float(np.mean(own)),
            "joint_error_mean_pose_mm": float(np.mean([_against(pose, sample) for sample in self.test])),
            "joint_error_mean_motion_mm": float(np.mean([_against(motion, sample) for sample in self.test])),
            "joint_error_shuffled_prompt_mm": float(np.mean(shuffled)),
        }

    def _best_errors(self, texts: Sequence[np.ndarray]) -> list[float]:
        errors = []
        for start in range(0, len(self.test), AT_ONCE):
            part = self.test[start : start + AT_ONCE]
            batch = collate([sample for sample in part for _ in range(self.config.samples)], with_entries=False)
            text = torch.from_numpy(np.stack(texts[start : start + AT_ONCE])).repeat_interleave(self.config.samples, 0)
            hands, _, _ = self._generate(batch, text)
            joints = self.hands.joints(hands, batch.betas, batch.template_m)
            apart = (joints - batch.joints_m).norm(dim=-1).mean(-1) * batch.present
            each = apart.sum((1, 2)) / batch.present.sum((1, 2)).clamp_min(1) * 1000
            errors += each.reshape(len(part), self.config.samples).amin(1).tolist()
        return errors

    def _generate(self, batch: ClipBatch, text: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Coarse hands and object, and the contact maps they were generated for: one drawn per motion."""
        draws = torch.Generator().manual_seed(self.config.seed)
        contact = self.loaded["contact"]
        assert isinstance(contact.network, ContactModel)
        chance = contact.network.sample(batch.points_m, text, batch.acts, 1, draws)[:, 0]
        touched = (chance >= contact.contact_threshold).float()
        generator = motion_generator(self.loaded["diffusion"])
        condition = Condition.of(batch, generator.network.object_feature(batch.points_m), text, touched)
        sampler = SamplerConfig(steps=self.config.sampler_steps, guidance=self.config.guidance)
        return *generator.sample(condition, sampler, draws), touched

    def refiner(self) -> dict[str, float]:
        """Penetration and distance of contact joints of generated motions, before and after, by the exact mesh.

        Penetration: depth of the deepest vertex, mean over acting hands and frames. Contact joints: those closer than
        the contact stage's threshold in the true clip, frame by frame; their distance in the generated motion.
        """
        network = self.loaded["refiner"].network
        assert isinstance(network, RefinerModel)
        surface = Surface.of(self.hands, self.test, self.config.field_resolution, torch.device("cpu"))
        rows = []
        for start in range(0, len(self.test), AT_ONCE):
            part = self.test[start : start + AT_ONCE]
            batch = collate([sample for sample in part for _ in range(self.config.refined)], with_entries=False)
            hands, objects, touched = self._generate(batch, batch.text[:, 0])
            refined = refine(network, surface.coarse(batch, hands, objects, touched))
            rows += self._surface_rows(batch, hands, refined, objects)
        before, after, true = (np.array([row[kind] for row in rows]) for kind in ("before", "after", "true"))
        return {
            "clips": len(self.test),
            "motions": len(rows),
            "penetration_before_mm": float(before[:, 0].mean()),
            "penetration_after_mm": float(after[:, 0].mean()),
            "penetration_true_mm": float(true[:, 0].mean()),
            "contact_distance_before_mm": float(np.nanmean(before[:, 1])),
            "contact_distance_after_mm": float(np.nanmean(after[:, 1])),
            "contact_distance_true_mm": float(np.nanmean(true[:, 1])),
            "contact_motions": int(np.isfinite(before[:, 1]).sum()),
        }

    def _surface_rows(
        self, batch: ClipBatch, hands: Tensor, refined: Tensor, objects: Tensor
    ) -> list[dict[str, tuple[float, float]]]:
        """Penetration and contact distance of every motion, before and after, and of the clip itself."""
        motions = {"before": (hands, objects), "after": (refined, objects), "true": (batch.hands, batch.object)}
        meshes = {
            name: self.hands.vertices(moved, batch.betas, batch.template_m) for name, (moved, _) in motions.items()
        }
        stride, rows = self.config.frame_stride, []
        for index, sample in enumerate(batch.samples):
            seen = {
                name: HandsAndObject.of(sample, meshes[name][0][index], meshes[name][1][index], motions[name][1][index])
                for name in motions
            }
            touching = seen["true"].joint_distances(stride) < sample.contact_threshold_m
            rows.append(
                {
                    name: (motion.penetration_mm(stride), _mean_mm(motion.joint_distances(stride), touching))
                    for name, motion in seen.items()
                }
            )
        return rows


@dataclass(frozen=True)
class HandsAndObject:
    """One motion for measuring: the acting hands' vertices and joints (side, frame, point, 3) in the object's frame."""

    sample: ClipSample
    vertices_m: np.ndarray
    joints_m: np.ndarray
    hinge_rad: np.ndarray | None
    present: np.ndarray

    @classmethod
    def of(cls, sample: ClipSample, vertices: Tensor, joints: Tensor, objects: Tensor) -> "HandsAndObject":
        """From (2, F, P, 3) of the model frame and object features (F, 10), padding still on."""
        n, objects = sample.length, objects[: sample.length]
        pose = object_rotmat(objects).numpy(), object_position_m(objects).numpy()
        skin, inner = (
            np.stack([metrics.points_in_object_frame(side[:n].numpy(), *pose) for side in points])
            for points in (vertices, joints)
        )
        hinge = object_hinge_rad(objects).numpy() if sample.object_model.is_articulated else None
        return cls(sample, skin, inner, hinge, sample.valid & sample.acts[:, None])

    def penetration_mm(self, stride: int) -> float:
        """Mean over present hands and frames of the depth of the deepest vertex."""
        found = [
            metrics.depths_m(self.sample.object_model, self.vertices_m[side, frames], self._hinge(frames)).max(axis=1)
            for side, frames in self._strided(stride)
        ]
        return float(np.concatenate(found).mean() * 1000)

    def joint_distances(self, stride: int) -> np.ndarray:
        """(side and frame, 21) unsigned distance of the joints to the surface, metres."""
        return np.concatenate(
            [
                metrics.surface_distances_m(self.sample.object_model, self.joints_m[side, frames], self._hinge(frames))
                for side, frames in self._strided(stride)
            ]
        )

    def _strided(self, stride: int) -> list[tuple[int, np.ndarray]]:
        rows = [(side, np.flatnonzero(self.present[side])[::stride]) for side in range(2)]
        return [(side, frames) for side, frames in rows if len(frames)]

    def _hinge(self, frames: np.ndarray) -> np.ndarray | None:
        return None if self.hinge_rad is None else self.hinge_rad[frames]


def _mean_mm(distances_m: np.ndarray, touching: np.ndarray) -> float:
    """Mean distance in millimetres of the joints that touch in the truth; NaN where none does."""
    return float(distances_m[touching].mean() * 1000) if touching.any() else float("nan")


@torch.no_grad()
def contact_chances(network: ContactModel, samples: list[ClipSample], count: int, seed: int) -> np.ndarray:
    """(clip, point) mean of ``count`` sampled maps, for the first sentence of every clip."""
    batch = collate(samples, with_entries=False)
    draws = torch.Generator().manual_seed(seed)
    return network.sample(batch.points_m, batch.text[:, 0], batch.acts, count, draws).mean(1).numpy()


def choose_contact_threshold(network: ContactModel, held_out: list[ClipSample]) -> float:
    """The threshold with the best mean F1 of the mean of 32 samples on held-out clips."""
    return metrics.best_threshold(contact_chances(network, held_out, 32, seed=0), _maps(held_out))


def mean_maps(train: list[ClipSample], clips: list[ClipSample], kind: str) -> np.ndarray:
    """(clip, point) baseline maps from training clips.

    kind "index": mean by point index. "spatial": mean at the nearest points in coordinates normalised to the object.
    "object": mean over the training clips of the same object, of all where there is none.
    """
    train_maps = _maps(train).astype(np.float64)
    if kind == "index":
        return np.repeat(train_maps.mean(axis=0)[None], len(clips), axis=0)
    if kind == "object":
        keys = np.array([sample.object_key for sample in train])
        same = [train_maps[keys == sample.object_key] for sample in clips]
        return np.stack([maps.mean(axis=0) if len(maps) else train_maps.mean(axis=0) for maps in same])
    clouds = {sample.object_key: _normalised(sample) for sample in [*train, *clips]}
    train_clouds = np.stack([clouds[sample.object_key] for sample in train])
    of_object = {
        key: metrics.spatial_mean_map(clouds[key], train_clouds, train_maps)
        for key in {sample.object_key for sample in clips}
    }
    return np.stack([of_object[sample.object_key] for sample in clips])


def mean_joints(train: list[ClipSample], bins: int) -> np.ndarray:
    """(2, bin, 21, 3) mean training joints in the model frame, over equal stretches of each clip's own time."""
    total, count = np.zeros((2, bins, 21, 3)), np.zeros((2, bins, 1, 1))
    for sample in train:
        place = _bin(sample.length, bins)
        for side in range(2):
            frames = sample.valid[side] & sample.acts[side]
            np.add.at(total[side], place[frames], sample.joints_m[side][frames])
            np.add.at(count[side], place[frames], 1.0)
    return total / np.maximum(count, 1)


def shuffled_prompts(test: list[ClipSample], seed: int) -> list[np.ndarray]:
    """For every clip the first sentence's features of another clip: other verb and object if there is one such."""
    draws = np.random.default_rng(seed)
    chosen = []
    for sample in test:
        other = [s for s in test if s.verb != sample.verb and s.object_key != sample.object_key]
        other = other or [s for s in test if s.sentences[0] != sample.sentences[0]] or [sample]
        same_hand = [s for s in other if s.hand_type == sample.hand_type] or other
        chosen.append(same_hand[int(draws.integers(len(same_hand)))].text[0])
    return chosen


def _against(mean: np.ndarray, sample: ClipSample) -> float:
    predicted = mean[:, _bin(sample.length, mean.shape[1])]
    return metrics.joint_error_mm(predicted, sample.joints_m, sample.valid & sample.acts[:, None])


def _bin(length: int, bins: int) -> np.ndarray:
    return np.minimum(np.arange(length) * bins // max(length, 1), bins - 1)


def _maps(samples: list[ClipSample]) -> np.ndarray:
    return np.stack([sample.touched for sample in samples])


def _normalised(sample: ClipSample) -> np.ndarray:
    return normalised_points(torch.from_numpy(sample.points.points_m)[None])[0][0].numpy()
