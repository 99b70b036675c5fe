"""A sentence and an object become a motion: hand type, length, contact, motion, refinement.

Text2HOI Sec. 3 and 4.1. The motion is a :class:`Clip` of dataset "generated" in a z-up world, the object's origin at
zero in the first frame. Everything is drawn from one seed: the same seed gives the same bytes.
"""

from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hoidata.annotation.encoders import TextEncoder, load_encoder, refuse_other_encoder
from hoidata.annotation.hand_choice import HandChoice, Method, choose_hand
from hoidata.batches.dataset import MAX_FRAMES
from hoidata.batches.requests import ObjectPoints, Request
from hoidata.clips.clip import FPS, SIDES, Clip, HandType
from hoidata.errors import BadInput
from hoidata.files import sha256_file
from hoidata.hands import HandPair, load_embedded_hands
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import POINT_COUNT, SampledPoints, sample_points
from models.common.checkpoints import FILE_NAME, Checkpoint
from models.common.vocabulary import Vocabulary
from models.text2hoi.faults import visible_faults
from models.text2hoi.length import SHORTEST_FRAMES
from models.text2hoi.sampler import Answer, SamplingConfig, Text2Hoi
from models.text2hoi.sentences import unseen_words
from models.text2hoi.verb_check import VerbCheck, read_verb
from models.text2hoi.wording import understood_words


@dataclass(frozen=True)
class GeneratedMotion:
    """clip: the motion, hands that were not asked for invalid. contact: (N,) bool contact map it was made for.

    points: where those points lie on the object. coarse: the motion before refinement. evidence: plain values on how
    the hand type was chosen, the length, seed, trained dataset and whether its data was synthetic; "read_as": the verb
    of training the diffusion network takes the sentence for, with its probability, or None where it is told the
    sentence's features; "moved_as": the verb whose training clips move the object most alike, or None; "unusual": what
    of it lies outside the bounds of the verb's training clips, in words; "faults": what a person would see to be wrong
    with it, in words; "unseen": what of the sentence was never in training, in words; "checkpoints": SHA-256 of each
    network that had a part in it.
    """

    clip: Clip
    coarse: Clip
    contact: np.ndarray
    points: SampledPoints
    evidence: dict[str, Any]


@dataclass(frozen=True)
class Wish:
    """What a person asks for beside the sentence; None leaves it to the sentence, or to the length network.

    seed: of everything that is drawn. samples: how many motions; each is the same in whatever number it is asked for.
    frames: 8 to 150 at 30 fps. hand_by: "rules", then similarity by a margin, then the share in training; or the
    paper's plain "similarity".
    """

    seed: int = 0
    samples: int = 1
    hand: HandType | None = None
    frames: int | None = None
    hand_by: Method = "rules"


@dataclass(frozen=True)
class Generator:
    """The trained networks of one dataset with their hand and text encoder: ready to answer sentences."""

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
        """From ``checkpoints/<network>``, with the hands and the encoder the networks were trained with.

        hands: the embedded ones where not given. encoder: the one that the networks name where not given; CLIP must be
        given, with its file. points: sampled on an object, as many as in training. Raises BadInput where a network is
        missing or was trained with other hands or another encoder.
        """
        hands = hands or load_embedded_hands()
        model = Text2Hoi.load(checkpoints, hands, sampling, device)
        encoder = encoder or load_encoder(str(model.facts["encoder"]["name"]))
        for checkpoint in model.trained.values():
            _refuse_others(checkpoint, hands, encoder, Path(checkpoints))
        digests = {name: sha256_file(Path(checkpoints) / name / FILE_NAME) for name in model.trained}
        return cls(model, hands, encoder, Vocabulary.read(model.trained["contact"].facts), digests, points)

    def generate(
        self, text: str, object: ObjectModel, wish: Wish = Wish(), object_words: str | None = None
    ) -> list[GeneratedMotion]:
        """Motions for ``text`` on ``object`` (metres, z up).

        Raises BadInput for no English sentence, and for a length no model was trained for.
        """
        wording = understood_words(text, self.vocabulary, lambda: self.encoder, force=True)
        verb, thing = wording.verb, wording.thing
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
            "read_as": read_verb(self.model.trained["diffusion"], torch.from_numpy(features)),
            "seed": wish.seed,
            "hand": asdict(choice),
            "unseen": unseen_words(self.vocabulary, text, verb, object_words or thing, choice.hand, self.encoder),
            "trained_on": self.model.facts["datasets"],
            "synthetic": bool(self.model.facts["synthetic"]),
            "contact_threshold_m": self.model.facts["contact_threshold_m"],
            "checkpoints": self._used(wish),
            "refined_by": self.model.refined_by,
        }
        # One by one: the last bits of a matrix product depend on how many rows it has.
        answers = [self.model.answers([request])[0] for request in requests]
        made = zip(requests, answers, strict=True)
        return [self._generated(request, answer, points, evidence) for request, answer in made]

    def _used(self, wish: Wish) -> dict[str, str]:
        """SHA-256 of the networks that make the motions: a length that is asked for needs no length network."""
        used = (*self.model.used, *(("length",) if wish.frames is None else ()))
        return {name: digest for name, digest in self.checkpoints.items() if name in used}

    def _hand(self, text: str, wish: Wish) -> HandChoice:
        """The hand asked for; else by the rules, and where the text names none by the share among training clips."""
        if wish.hand:
            return HandChoice(wish.hand, "rule", 1.0, "asked for beside the sentence")
        counts = self.model.trained["contact"].facts["hand_types"]
        total = max(sum(counts.values()), 1)
        prior = {hand: count / total for hand, count in counts.items()}
        return choose_hand(text, self.encoder, prior, wish.hand_by)

    def _request(self, first: Request, text: str, wish: Wish, number: int) -> Request:
        """The request of one sample, with a seed of its own for every sentence, object and number."""
        motion_id = first.motion_id if number == 0 else f"{first.motion_id}~{number}"
        drawn_from = f"{wish.seed} {number} {first.object.name} {text}"
        seed = int.from_bytes(sha256(drawn_from.encode(errors="backslashreplace")).digest()[:7])
        request = replace(first, motion_id=motion_id, seed=seed, number=number)
        n_frames = self._length(request) if wish.frames is None else wish.frames
        if not SHORTEST_FRAMES <= n_frames <= MAX_FRAMES:
            seconds = f"{SHORTEST_FRAMES / FPS:.2f} to {MAX_FRAMES / FPS:g} s"
            expected = f"{SHORTEST_FRAMES} to {MAX_FRAMES} frames ({seconds})"
            raise BadInput("length", expected, f"{n_frames} frames", "ask for another length")
        return replace(request, n_frames=n_frames)

    def _length(self, request: Request) -> int:
        text, active_hands = (torch.from_numpy(values)[None] for values in (request.text, request.active_hands))
        return self.model.sample_lengths(text, active_hands, torch.Generator().manual_seed(request.seed))[0]

    def _generated(
        self, request: Request, answer: Answer, points: SampledPoints, evidence: dict[str, Any]
    ) -> GeneratedMotion:
        motion = answer.motion
        own = {
            "number": request.number,
            "frames": request.n_frames,
            "touched_points": int(motion.contact_map.sum()),
            "draws": answer.draws,
            "moved_as": answer.moved_as,
            "unusual": list(answer.unusual),
            "faults": list(self._faults(request, answer.clip, evidence["read_as"])),
        }
        coarse = self.model.clips([request], [motion], refined=False)[0]
        return GeneratedMotion(answer.clip, coarse, motion.contact_map.numpy() > 0, points, evidence | own)

    def _faults(self, request: Request, clip: Clip, read_as: tuple[str, float] | None) -> tuple[str, ...]:
        check = VerbCheck.of(self.model.trained["diffusion"], self.hands)
        return visible_faults(clip, request.points, self.hands, check, read_as[0] if read_as else None)


def _refuse_others(checkpoint: Checkpoint, hands: HandPair, encoder: TextEncoder, where: Path) -> None:
    facts = checkpoint.facts
    if facts["hand_digest"] != hands.digest:
        remedy = "pass the hand the models were trained with, or train with this one"
        expected = f"hand {facts['hand']} {facts['hand_digest'][:12]}"
        raise BadInput(where, expected, f"{hands.name} {hands.digest[:12]}", remedy)
    refuse_other_encoder(where, facts["encoder"], encoder.identity)
