"""Generates motions from a sentence and an object: hand type, length, contact, motion, refinement.

Text2HOI, Sec. 3 and 4.1. A motion is a :class:`Clip` of dataset "generated" in a z-up world; the object's origin is at
zero in the first frame. All random numbers come from one seed: the same seed gives the same bytes. Networks see an
object with the axis up that is up in training; users get it in the frame of their mesh.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from hoidata.annotation.encoders import TextEncoder, load_encoder
from hoidata.annotation.hand_choice import HandChoice, Method
from hoidata.annotation.prompts import unseen_words
from hoidata.annotation.vocabulary import Vocabulary
from hoidata.annotation.wording import understood_words
from hoidata.batches.dataset import MAX_FRAMES
from hoidata.batches.requests import ObjectPoints, Request, Sentence
from hoidata.clips.clip import FPS, SIDES, Clip, HandType
from hoidata.errors import BadInput
from hoidata.files import sha256_file
from hoidata.hands import HandPair, load_embedded_hands
from hoidata.metrics.verdict import UNKNOWN_UP, Check, requested_verb, verdict
from hoidata.object_paths.mesh_frame import Z, closed_as_stored, training_from_z_up, turned, turned_back, within_limits
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import POINT_COUNT, SampledPoints, sample_points
from models.common.checkpoints import FILE_NAME, refuse_other_inputs
from models.common.family import motion_clip
from models.common.repeatable import seed_of
from models.text2hoi.diffusion_training import verb_ranges
from models.text2hoi.length import SHORTEST_FRAMES
from models.text2hoi.sampler import Answer, SamplingConfig, Text2Hoi


class Evidence(TypedDict):
    """Plain values about a generated motion, for files and pages."""

    text: str
    verb: str | None  # of the sentence, by the grammar; None if training had none such
    seed: int
    number: int  # of the sample, from 0
    frames: int
    hand: dict[str, Any]  # a ``HandChoice``
    refine: str  # as in ``SamplingConfig``
    attempts: int  # candidates sampled until this one was accepted
    touched_points: int  # in the contact map
    contact_threshold_m: float
    moved_as: str | None  # the verb whose training clips have the most similar object motion
    unusual: list[str]  # measures outside the range of the verb's training clips, in words
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
    verdict: tuple[Check, ...]  # what a viewer sees


@dataclass(frozen=True)
class MotionOptions:
    """A user's options; None leaves the choice to the sentence or to the length network."""

    seed: int = 0
    samples: int = 1  # number of motions; motion k does not depend on this number
    hand: HandType | None = None
    frames: int | None = None  # 8 to 150 at 30 fps
    # How the hand is chosen. "rules": by rules, then by text similarity if it is clear, then by its frequency in
    # training. "similarity": by text similarity, as in the paper. None: "similarity" for networks of preset `paper`.
    hand_by: Method | None = None


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

        Raises BadInput: a network is missing, or was trained with another hand model or encoder.
        """
        hands = hands or load_embedded_hands()
        model = Text2Hoi.load(checkpoints, hands, sampling, device)
        encoder = encoder or load_encoder(str(model.facts["encoder"]["name"]))
        for checkpoint in model.trained.values():
            refuse_other_inputs(checkpoint, hands, encoder, Path(checkpoints))
        digests = {name: sha256_file(Path(checkpoints) / name / FILE_NAME) for name in model.trained}
        return cls(model, hands, encoder, Vocabulary.read(model.trained["contact"].facts), digests, points)

    @property
    def object_ups(self) -> dict[str, list[float]]:
        """Direction (3,) of each training object that is up in its first frames, object frame."""
        return self.model.trained["diffusion"].info["results"]["object_ups"]

    def generate(
        self,
        text: str,
        object: ObjectModel,
        options: MotionOptions = MotionOptions(),
        object_words: str | None = None,
        up: Sequence[float] | None = Z,
        joint_limits: tuple[float, float] | None = None,
    ) -> list[GeneratedMotion]:
        """Motions for an English sentence on ``object`` (metres).

        Args:
            up: (3,) what is up for an object that is none of the dataset's, in its frame; None for one of the
                dataset's. The networks see other objects with the axis up that is up in most training clips.
            joint_limits: lowest and highest joint position, radians or metres, at which a motion is cut.

        Raises BadInput: the text is not an English sentence, or the length is not within 8 to 150 frames.
        """
        wording = understood_words(text, self.vocabulary, lambda: self.encoder, force=True)
        hand, cloud = self._hand(text, options), sample_points(object, self.points)
        to_training = training_from_z_up(self.object_ups)
        rotation = np.eye(3, dtype=np.float32) if up is None else to_training @ training_from_z_up({"": up}).T
        first = Request(
            motion_id=f"generated/{object.name}",
            object=turned(object, rotation),
            points=ObjectPoints(cloud.points_m @ rotation.T, cloud.normals @ rotation.T, cloud.part),
            text=self.encoder.encode([wording.text])[0],
            sentence=Sentence(wording.text, wording.verb, wording.noun),
            active_hands=np.array([hand.hand in (side, "both") for side in SIDES]),
            n_frames=0,
            clip_id=text,
            object_words=object_words or object.name,
        )
        motions = []
        for number in range(options.samples):
            request = self._numbered(first, options.seed, number)
            request = replace(request, n_frames=self._length(request, options))
            # One by one: the last bits of a matrix product depend on how many rows it has.
            answer = self.model.answers([request])[0]
            evidence = self._evidence(request, answer, hand, options, object_words or wording.noun)
            clip, coarse = answer.clip, motion_clip(request, answer.coarse, answer.object, evidence["synthetic"])
            if up is not None:
                closed = [closed_as_stored(turned_back(one, object, rotation), self.hands) for one in (clip, coarse)]
                clip, coarse = (within_limits(one, joint_limits, self.hands) for one in closed)
            checks = self._verdict(clip, wording.verb, cloud, self.object_ups.get(object.name) if up is None else up)
            motions.append(GeneratedMotion(clip, coarse, answer.touched.numpy(), cloud, evidence, checks))
        return motions

    def _verdict(self, clip: Clip, verb: str | None, cloud: SampledPoints, up: Any) -> tuple[Check, ...]:
        points = ObjectPoints(cloud.points_m, cloud.normals, cloud.part)
        ranges = verb_ranges(self.model.trained["diffusion"], self.hands)
        requested = requested_verb(verb, self.vocabulary.verbs, ranges, clip, points)
        return verdict(clip, self.hands, UNKNOWN_UP if up is None else np.asarray(up), requested)

    def _hand(self, text: str, options: MotionOptions) -> HandChoice:
        """The requested hand; otherwise the hand chosen from the sentence, or else by its frequency in training."""
        if options.hand:
            return HandChoice(options.hand, "rule", 1.0, "requested by the user")
        return self.model.choose_hand(text, self.encoder, options.hand_by)

    def _numbered(self, first: Request, seed: int, number: int) -> Request:
        """The request of sample ``number``; its seed depends on sentence, object and number."""
        motion_id = first.motion_id if number == 0 else f"{first.motion_id}~{number}"
        request_seed = seed_of(f"{seed} {number} {first.object.name} {first.clip_id}")
        return replace(first, motion_id=motion_id, seed=request_seed, number=number)

    def _length(self, request: Request, options: MotionOptions) -> int:
        """The requested number of frames, or a sampled one."""
        n_frames = self.model.sample_length(request) if options.frames is None else options.frames
        if not SHORTEST_FRAMES <= n_frames <= MAX_FRAMES:
            seconds = f"{SHORTEST_FRAMES / FPS:.2f} to {MAX_FRAMES / FPS:g} s"
            expected = f"{SHORTEST_FRAMES} to {MAX_FRAMES} frames ({seconds})"
            raise BadInput("length", expected, f"{n_frames} frames", "give another length")
        return n_frames

    def _evidence(
        self, request: Request, answer: Answer, hand: HandChoice, options: MotionOptions, noun: str | None
    ) -> Evidence:
        model, sentence = self.model, request.sentence
        assert sentence is not None
        assert hand.hand is not None  # a prior decides last
        verb, check = sentence.verb, verb_ranges(model.trained["diffusion"], self.hands)
        numbers = {} if check is None else check.numbers(answer.clip, request.points)
        needs_length = options.frames is None
        return {
            "text": request.clip_id,
            "verb": verb if verb in self.vocabulary.verbs else None,
            "seed": options.seed,
            "number": request.number,
            "frames": request.n_frames,
            "hand": asdict(hand),
            "refine": model.config.refine,
            "attempts": answer.attempts,
            "touched_points": int(answer.touched.sum()),
            "contact_threshold_m": model.facts["contact_threshold_m"],
            "moved_as": check.actions.nearest_verb(numbers) if check else None,
            "unusual": list(check.actions.unusual(verb or "", numbers)) if check else [],
            "unseen": unseen_words(self.vocabulary, request.clip_id, verb, noun, hand.hand, self.encoder),
            "trained_on": model.facts["datasets"],
            "synthetic": bool(model.facts["synthetic"]),
            "checkpoints": {name: self.checkpoints[name] for name in model.trained if name != "length" or needs_length},
        }
