"""Generates motions from a sentence and an object: hand type, length, contact, motion, refinement.

Text2HOI, Sec. 3 and 4.1. A motion is a :class:`Clip` of dataset "generated" in a z-up world; the object's origin is at
zero in the first frame. All random numbers come from one seed: the same seed gives the same bytes.

``visible_faults`` reports what a viewer sees to be wrong, in words. A measure outside the range of the verb's training
clips is reported if the difference is large enough to see (``hoidata.actions.action``). Independent of the verb it
reports hands that never reach the object, are deep inside it or release it in the air, and a motionless object.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, TypedDict, cast

import numpy as np
import torch

from hoidata.actions.action import Actions
from hoidata.annotation.encoders import TextEncoder, load_encoder, refuse_other_encoder
from hoidata.annotation.hand_choice import HandChoice, Method, choose_hand
from hoidata.batches.dataset import MAX_FRAMES
from hoidata.batches.requests import ObjectPoints, Request
from hoidata.clips.clip import FPS, SIDES, Clip, HandType, Side
from hoidata.errors import BadInput
from hoidata.files import sha256_file
from hoidata.hands import HandPair, load_embedded_hands
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import POINT_COUNT, SampledPoints, sample_points
from hoidata.objects.surface_index import SurfaceIndex, surface_index
from hoidata.surface.contact import HandInObjectFrame, deepest_m, hand_in_object_frame
from models.common.checkpoints import FILE_NAME, Checkpoint
from models.common.vocabulary import Vocabulary
from models.text2hoi.length import SHORTEST_FRAMES
from models.text2hoi.sampler import Answer, SamplingConfig, Text2Hoi
from models.text2hoi.sentences import unseen_words
from models.text2hoi.verb_check import VerbCheck, classified_verb
from models.text2hoi.wording import understood_words


class Evidence(TypedDict):
    """Plain values about a generated motion, for files and pages."""

    text: str
    read_as: tuple[str, float] | None  # the verb that the diffusion network reads in the text, and its probability
    seed: int
    number: int  # of the sample, from 0
    frames: int
    hand: dict[str, Any]  # a ``HandChoice``
    refined_by: str  # "network" or "contact_refinement"
    draws: int  # candidates sampled until this one was accepted
    touched_points: int  # in the contact map
    contact_threshold_m: float
    moved_as: str | None  # the verb whose training clips have the most similar object motion
    unusual: list[str]  # measures outside the range of the verb's training clips, in words
    faults: list[str]  # what a viewer sees to be wrong, in words
    unseen: list[str]  # what of the text was not in training, in words
    trained_on: dict[str, int]  # training clips by dataset
    synthetic: bool  # whether the training clips are generated
    checkpoints: dict[str, str]  # SHA-256 of each network that was used


@dataclass(frozen=True)
class GeneratedMotion:
    """A motion for a sentence, and how it came about."""

    clip: Clip  # hands that are not requested are invalid
    coarse: Clip  # before refinement
    contact: np.ndarray  # (N,) bool, the contact map that was the condition
    points: SampledPoints  # the N points of the contact map
    evidence: Evidence


@dataclass(frozen=True)
class MotionOptions:
    """A user's options; None leaves the choice to the sentence or to the length network."""

    seed: int = 0
    samples: int = 1  # number of motions; motion k does not depend on this number
    hand: HandType | None = None
    frames: int | None = None  # 8 to 150 at 30 fps
    # How the hand is chosen. "rules": by rules, then by text similarity if it is clear, then by its frequency in
    # training. "similarity": by text similarity, as in the paper.
    hand_by: Method = "rules"


@dataclass(frozen=True)
class Generator:
    """The trained networks of one dataset with their hand model and text encoder."""

    model: Text2Hoi
    hands: HandPair
    encoder: TextEncoder
    vocabulary: Vocabulary
    checkpoints: dict[str, str]
    points: int = POINT_COUNT

    @classmethod
    def load(
        cls,
        checkpoints: str | Path,
        hands: HandPair | None = None,
        encoder: TextEncoder | None = None,
        *,
        sampling: SamplingConfig | None = None,
        points: int = POINT_COUNT,
        device: str = "cpu",
    ) -> "Generator":
        """Load ``checkpoints/<network>`` with the hand model and text encoder of their training.

        Args:
            hands: the embedded hand model if None.
            encoder: the encoder that the networks name if None; CLIP must be given, with its file.
            points: sampled on an object, as many as in training.

        Raises:
            BadInput: a network is missing, or was trained with another hand model or encoder.
        """
        hands = hands or load_embedded_hands()
        model = Text2Hoi.load(checkpoints, hands, sampling, device)
        encoder = encoder or load_encoder(str(model.facts["encoder"]["name"]))
        for checkpoint in model.trained.values():
            _refuse_others(checkpoint, hands, encoder, Path(checkpoints))
        digests = {name: sha256_file(Path(checkpoints) / name / FILE_NAME) for name in model.trained}
        return cls(model, hands, encoder, Vocabulary.read(model.trained["contact"].facts), digests, points)

    def generate(
        self,
        text: str,
        object: ObjectModel,
        wish: MotionOptions = MotionOptions(),
        object_words: str | None = None,
    ) -> list[GeneratedMotion]:
        """Motions for an English sentence on ``object`` (metres, z up).

        Raises BadInput if the text is not an English sentence, and for a length outside of 8 to 150 frames.
        """
        wording = understood_words(text, self.vocabulary, lambda: self.encoder, force=True)
        verb, noun = wording.verb, wording.noun
        choice = self._hand(text, wish)
        assert choice.hand is not None  # a prior decides last
        points, features = sample_points(object, self.points), self.encoder.encode([wording.text])[0]
        first = Request(
            motion_id=f"generated/{object.name}",
            object=object,
            points=ObjectPoints(points.points_m, points.normals, points.part),
            text=features,
            active_hands=np.array([choice.hand in (side, "both") for side in SIDES]),
            n_frames=0,
            clip_id=text,
            object_words=object_words or object.name,
        )
        requests = [self._request(first, text, wish, number) for number in range(wish.samples)]
        evidence = {
            "text": text,
            "read_as": classified_verb(self.model.trained["diffusion"], torch.from_numpy(features)),
            "seed": wish.seed,
            "hand": asdict(choice),
            "unseen": unseen_words(self.vocabulary, text, verb, object_words or noun, choice.hand, self.encoder),
            "trained_on": self.model.facts["datasets"],
            "synthetic": bool(self.model.facts["synthetic"]),
            "contact_threshold_m": self.model.facts["contact_threshold_m"],
            "checkpoints": self._used(wish),
            "refined_by": self.model.refined_by,
        }
        # One by one: the last bits of a matrix product depend on how many rows it has.
        answers = [self.model.answers([request])[0] for request in requests]
        pairs = zip(requests, answers, strict=True)
        return [self._generated(request, answer, points, evidence) for request, answer in pairs]

    def _used(self, wish: MotionOptions) -> dict[str, str]:
        """SHA-256 of the networks that are used; a requested length needs no length network."""
        used = (*self.model.used, *(("length",) if wish.frames is None else ()))
        return {name: digest for name, digest in self.checkpoints.items() if name in used}

    def _hand(self, text: str, wish: MotionOptions) -> HandChoice:
        """The requested hand; otherwise the hand chosen from the sentence, or else by its frequency in training."""
        if wish.hand:
            return HandChoice(wish.hand, "rule", 1.0, "requested by the user")
        counts = self.model.trained["contact"].facts["hand_types"]
        total = max(sum(counts.values()), 1)
        prior = {hand: count / total for hand, count in counts.items()}
        return choose_hand(text, self.encoder, prior, wish.hand_by)

    def _request(self, first: Request, text: str, wish: MotionOptions, number: int) -> Request:
        """The request of sample ``number``; its seed depends on sentence, object and number."""
        motion_id = first.motion_id if number == 0 else f"{first.motion_id}~{number}"
        seed_text = f"{wish.seed} {number} {first.object.name} {text}"
        seed = int.from_bytes(sha256(seed_text.encode(errors="backslashreplace")).digest()[:7])
        request = replace(first, motion_id=motion_id, seed=seed, number=number)
        n_frames = self._length(request) if wish.frames is None else wish.frames
        if not SHORTEST_FRAMES <= n_frames <= MAX_FRAMES:
            seconds = f"{SHORTEST_FRAMES / FPS:.2f} to {MAX_FRAMES / FPS:g} s"
            expected = f"{SHORTEST_FRAMES} to {MAX_FRAMES} frames ({seconds})"
            raise BadInput("length", expected, f"{n_frames} frames", "give another length")
        return replace(request, n_frames=n_frames)

    def _length(self, request: Request) -> int:
        text, active_hands = (torch.from_numpy(values)[None] for values in (request.text, request.active_hands))
        return self.model.sample_lengths(text, active_hands, torch.Generator().manual_seed(request.seed))[0]

    def _generated(
        self, request: Request, answer: Answer, points: SampledPoints, evidence: dict[str, Any]
    ) -> GeneratedMotion:
        motion = answer.motion
        facts = {
            "number": request.number,
            "frames": request.n_frames,
            "touched_points": int(motion.contact_map.sum()),
            "draws": answer.attempts,
            "moved_as": answer.moved_as,
            "unusual": list(answer.unusual),
            "faults": list(self._faults(request, answer.clip, evidence["read_as"])),
        }
        coarse = self.model.clips([request], [motion], refined=False)[0]
        return GeneratedMotion(
            clip=answer.clip,
            coarse=coarse,
            contact=motion.contact_map.numpy() > 0,
            points=points,
            evidence=cast(Evidence, evidence | facts),
        )

    def _faults(self, request: Request, clip: Clip, read_as: tuple[str, float] | None) -> tuple[str, ...]:
        check = VerbCheck.of(self.model.trained["diffusion"], self.hands)
        return visible_faults(clip, request.points, self.hands, check, read_as[0] if read_as else None)


def _refuse_others(checkpoint: Checkpoint, hands: HandPair, encoder: TextEncoder, source: Path) -> None:
    """Raise BadInput if a network was trained with another hand model or text encoder."""
    facts = checkpoint.facts
    if facts["hand_digest"] != hands.digest:
        remedy = "pass the hand the models were trained with, or train with this one"
        expected = f"hand {facts['hand']} {facts['hand_digest'][:12]}"
        raise BadInput(source, expected, f"{hands.name} {hands.digest[:12]}", remedy)
    refuse_other_encoder(source, facts["encoder"], encoder.identity)


GAP_M = 0.01  # between skin and surface: a larger gap is visible
DEEP_M = 0.02  # a finger's thickness
FLOATING_M = 0.02  # above the start: the object is in the air
MIN_FRAMES = 3  # a tenth of a second; a shorter fault is not visible
STILL = {
    "path_m": 0.01,
    "tilt_deg": 5.0,
    "turn_deg": 5.0,
    "hinge_max_deg": 5.0,
}  # an object that moves less does not move
MOVES = {"path_m": 0.05, "hinge_max_deg": 10.0}  # of the mean training clip of a verb that moves its object


def visible_faults(
    clip: Clip, points: ObjectPoints, hands: HandPair, check: VerbCheck | None, verb: str | None
) -> tuple[str, ...]:
    """Visible faults of a motion, each in words.

    Args:
        points: sampled on the object.
        check: ranges of the training clips; None if the networks have none.
        verb: the requested verb; None if not known.
    """
    index = surface_index(clip.object.model)
    active: list[Side] = [side for side in SIDES if clip.hands[side].valid.any()]
    placed: dict[Side, HandInObjectFrame] = {side: hand_in_object_frame(clip, side, hands) for side in active}
    gaps: dict[Side, np.ndarray] = {side: _gap_m(hand, index) for side, hand in placed.items()}
    faults = [*_contact_faults(clip, gaps), *_depth_faults(placed, index)]
    if check is not None:
        numbers = check.numbers(clip, points)
        moved_as, visible = check.moved_as(numbers), check.seen(verb, numbers)
        if verb is not None and _is_still(numbers) and _moves_its_object(check.actions, verb):
            faults.append("the object does not move")
        elif visible:
            other = f", more like {moved_as!r}" if check.fails(verb, moved_as) else ""
            expected = f"{verb!r} in training" if verb else "the motions of training"
            faults.append(f"unlike {expected}{other}: {', '.join(visible)}")
    return tuple(faults)


def _gap_m(hand: HandInObjectFrame, index: SurfaceIndex) -> np.ndarray:
    """(frame,) metres from the skin to the surface, infinite without the hand."""
    return hand.expand_to_clip(index.distance_m(hand.vertices_m, hand.hinge_rad).min(axis=1), np.inf)


def _contact_faults(clip: Clip, gap_m: Mapping[Side, np.ndarray]) -> list[str]:
    distances = {side: float(gap.min()) for side, gap in gap_m.items() if gap.min() > GAP_M}
    faults = [f"the {side} hand never touches the object ({gap * 100:.1f} cm away)" for side, gap in distances.items()]
    if len(distances) < len(gap_m) and clip.gravity is not None:
        height = -(clip.object.translation_m.astype(np.float64) @ np.asarray(clip.gravity, np.float64))
        lifted = height - height[0] > FLOATING_M
        alone = int((lifted & (np.min([*gap_m.values()], axis=0) > GAP_M)).sum())
        faults += [f"the object is in the air and no hand touches it in {alone} frames"] * (alone >= MIN_FRAMES)
    return faults


def _depth_faults(placed: Mapping[Side, HandInObjectFrame], index: SurfaceIndex) -> list[str]:
    if not index.is_solid:
        return []
    faults = []
    for side, hand in placed.items():
        depth = deepest_m(hand, index)
        if (frames := int((depth > DEEP_M).sum())) >= MIN_FRAMES:
            deepest = float(np.nanmax(depth)) * 100
            faults.append(f"the {side} hand is up to {deepest:.1f} cm inside the object in {frames} frames")
    return faults


def _is_still(numbers: Mapping[str, float]) -> bool:
    return all(numbers[name] < threshold for name, threshold in STILL.items())


def _moves_its_object(actions: Actions, verb: str) -> bool:
    """Whether the mean training clip of a verb moves its object."""
    if verb not in actions.centroids:
        return False
    measures: dict[str, Any] = {
        name: float(value) * deviation + mean
        for value, (name, (mean, deviation)) in zip(actions.centroids[verb], actions.scale.items(), strict=True)
    }
    return any(measures.get(name, 0.0) > threshold for name, threshold in MOVES.items())
