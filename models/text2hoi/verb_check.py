"""Compares a generated motion with the training clips of its verb: the criterion of rejection sampling.

A few measures describe how the object moves (``hoidata.actions``). A motion is rejected if other verbs' training clips
move the object more similarly, or if a measure is outside the range of the verb's training clips. It is also rejected
if a joint is faster than in all training clips, or if hands slip more than in the verb's clips. No test clip and no
trained evaluator is involved.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hoidata.actions.action import (
    Actions,
    action_numbers,
    describe_unusual,
    is_visible,
    training_actions,
    usual_limits,
    verb_of,
)
from hoidata.batches.requests import ObjectPoints, Request
from hoidata.clips.clip import FPS, SIDES, Clip, ObjectTrack
from hoidata.clips.slip import joint_slips_cm_s, touched_parts
from hoidata.contact.proximity import ProximityIndex
from hoidata.hands import HandPair, track_joints
from hoidata.store.annotated import AnnotatedStore
from models.common.checkpoints import Checkpoint
from models.common.corpus import Corpus
from models.common.vocabulary import Vocabulary
from models.text2hoi.verb_classifier import verb_classifiers_of

# Names among the results of a diffusion checkpoint.
RECORD = "actions"
FASTEST = "fastest_joint_m_s"
JOINT_SPEED = "joint_m_s"
FASTER = 1.1  # than in any training clip
SLIP = "slip_cm_s"
MOST_SLIP = "most_slip_cm_s"
LEAST_DEVIATION_CM_S = 0.05  # of slip, for recorded hands that never slip


@dataclass(frozen=True)
class VerbCheck:
    """Ranges of the training clips, to which motions are compared."""

    actions: Actions
    threshold_m: float  # distance below which a joint touches
    hands: HandPair
    fastest_m_s: float = float("inf")  # of any joint; infinite if a checkpoint does not state it
    most_slip_cm_s: Mapping[str, float] = field(default_factory=dict)  # of hands on a moving object, by verb

    @classmethod
    def of(cls, trained: Checkpoint, hands: HandPair) -> "VerbCheck | None":
        """From a diffusion checkpoint; None if its network has no verb classifier, or it stores no actions."""
        results = trained.info.get("results", {})
        if RECORD not in results or not verb_classifiers_of(trained.network):
            return None
        return cls.read(results, trained.facts["contact_threshold_m"], hands)

    @classmethod
    def read(cls, kept: Mapping[str, Any], threshold_m: float, hands: HandPair) -> "VerbCheck":
        """From the result of ``usual_motion``."""
        fastest_m_s = kept.get(FASTEST) or float("inf")  # 0: no hand ever moved, which bounds nothing
        return cls(Actions.read(kept[RECORD]), threshold_m, hands, fastest_m_s, kept.get(MOST_SLIP, {}))

    def numbers(self, clip: Clip, points: ObjectPoints) -> dict[str, float]:
        """Measures of a clip: those of its object (``hoidata.actions``), ``JOINT_SPEED`` of the fastest joint, and mean
        ``SLIP`` of touching joints.
        """
        index, touching, speeds = ProximityIndex(points), np.zeros((len(SIDES), clip.n_frames), bool), [0.0]
        slips = [np.zeros(0)]
        for row, side in enumerate(SIDES):
            track = clip.hands[side]
            if track.valid.any():
                joints_m = track_joints(track, self.hands[side])
                near = index.entries(joints_m, track.valid, clip.object, self.threshold_m)
                touching[row, near["frame"]] = True
                speeds.append(fastest_joint(joints_m, track.valid))
                part = points.part[near["point"]]
                touched = touched_parts(clip.n_frames, near["frame"], near["joint"], near["distance_m"], part)
                slips.append(joint_slips_cm_s(clip.object, joints_m, touched))
        own = {JOINT_SPEED: max(speeds), SLIP: _mean(np.concatenate(slips))}
        return action_numbers(clip.object, clip.gravity, touching) | own

    def moved_as(self, numbers: Mapping[str, float]) -> str | None:
        """The verb whose training clips have the most similar object motion; None if gravity is not known."""
        return self.actions.nearest_verb(numbers)

    def unusual(self, asked: str | None, numbers: Mapping[str, float]) -> tuple[str, ...]:
        """Measures outside the range of the requested verb's training clips, in words."""
        found = () if asked is None else self.actions.unusual(asked, numbers)
        above = {name: most for name, most in self._most(asked).items() if numbers[name] > most}
        said = (describe_unusual(name, numbers[name], 0.0, most) for name, most in above.items())
        return (*found, *filter(None, said))

    def seen(self, asked: str | None, numbers: Mapping[str, float]) -> tuple[str, ...]:
        """Those of ``unusual`` that are large enough to see."""
        found = () if asked is None else self.actions.visibly_unusual(asked, numbers)
        above = {name: most for name, most in self._most(asked).items() if is_visible(name, numbers[name], 0.0, most)}
        said = (describe_unusual(name, numbers[name], 0.0, most) for name, most in above.items())
        return (*found, *filter(None, said))

    def beyond(self, asked: str | None, numbers: Mapping[str, float]) -> float:
        """The largest distance of a measure from its range, in widths of the range; 0 if all are inside."""
        found = [] if asked is None else list(self.actions.violations(asked, numbers).values())
        return max(0.0, *found, *(numbers[name] / most - 1 for name, most in self._most(asked).items()))

    def _most(self, asked: str | None) -> dict[str, float]:
        """Upper limits of the hands' measures; they have no lower ones."""
        slip = self.most_slip_cm_s.get(asked or "", float("inf"))
        return {JOINT_SPEED: FASTER * self.fastest_m_s, SLIP: slip}

    def fails(self, asked: str | None, moved_as: str | None) -> bool:
        """Whether a motion has another verb than the requested one; False if either is not known."""
        return not (asked is None or moved_as is None or asked not in self.actions.centroids or moved_as == asked)


def requested_verb(trained: Checkpoint, request: Request) -> str | None:
    """The verb as which a request's sentence is classified; None if not known."""
    read = classified_verb(trained, torch.from_numpy(request.text))
    return None if read is None else read[0]


def classified_verb(trained: Checkpoint, text: Tensor) -> tuple[str, float] | None:
    """The most probable verb of a sentence with features (512,), and its probability; None without a classifier."""
    readings = verb_classifiers_of(trained.network)
    verbs = sorted(filter(None, Vocabulary.read(trained.facts).verbs))
    if not readings or not verbs:
        return None
    probability = readings[0].probabilities(text[None].to(readings[0].mean.device))[0]
    return verbs[int(probability.argmax())], round(float(probability.max()), 3)


def action_results(network: nn.Module, corpus: Corpus) -> Mapping[str, Any]:
    """What a diffusion checkpoint stores about its training clips, if the network has a verb classifier."""
    return usual_motion(corpus.annotated) if verb_classifiers_of(network) else {}


def usual_motion(store: AnnotatedStore) -> dict[str, Any]:
    """Actions of the training clips, the fastest joint, and the usual slip by verb."""
    speeds, slips = [0.0], dict[str, list[dict[str, float]]]()
    for clip_id in store.ids("train"):
        clip = store.clip(clip_id)
        speeds += [fastest_joint(store.joints(clip_id, side), clip.hands[side].valid) for side in SIDES]
        if verb := verb_of(store, clip_id):
            slips.setdefault(verb, []).append({SLIP: _recorded_slip_cm_s(store, clip_id, clip.object)})
    every = [own[SLIP] for rows in slips.values() for own in rows]
    scale = {SLIP: (0.0, max(float(np.std(every)), LEAST_DEVIATION_CM_S))} if every else {}
    most_slip = {verb: limits[SLIP][1] for verb, limits in usual_limits(slips, scale).items()}
    return {RECORD: training_actions(store).record, FASTEST: max(speeds), MOST_SLIP: most_slip}


def _recorded_slip_cm_s(store: AnnotatedStore, clip_id: str, thing: ObjectTrack) -> float:
    """``SLIP`` of a recorded clip, from its stored distances."""
    part, slips = store.points(store.object_key(clip_id)).part, []
    for side in SIDES:
        near = store.distances(clip_id, side)
        touched = touched_parts(thing.n_frames, near.frame, near.joint, near.distance_m, part[near.point])
        slips.append(joint_slips_cm_s(thing, store.joints(clip_id, side), touched))
    return _mean(np.concatenate(slips))


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else 0.0


def fastest_joint(joints_m: np.ndarray, valid: np.ndarray) -> float:
    """Speed in m/s of the fastest joint (F, 21, 3) between two frames that are ``valid`` (F,)."""
    steps = np.linalg.norm(np.diff(joints_m.astype(np.float64), axis=0), axis=2)[valid[1:] & valid[:-1]]
    return float(steps.max(initial=0.0)) * FPS
