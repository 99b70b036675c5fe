"""A sentence and an object become a motion: hand type, length, contact, motion, refinement.

Text2HOI Sec. 3 and 4.1. The motion is a :class:`Clip` of dataset "generated" in a z-up world, the object's origin at
zero in the first frame. Everything is drawn from one seed: the same seed gives the same bytes.

Faults are what a person who watches a motion would see to be wrong with it, and that alone, in words. A number outside
the bounds of a verb's training clips counts where the difference is large enough to be seen
(``hoidata.actions.action``). Hands that never reach the object, lie deep inside of it or leave it in the air, and an
object that stays where it is, are faults whatever the verb.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

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
from hoidata.surface.contact import PlacedHand, deepest_m, placed_hand
from models.common.checkpoints import FILE_NAME, Checkpoint
from models.common.vocabulary import Vocabulary
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


GAP_M = 0.01  # between skin and surface: a hand farther away is seen not to touch
DEEP_M = 0.02  # as thick as a finger, which is then inside as a whole
FLOATING_M = 0.02  # above where the object began: it is in the air
LEAST_FRAMES = 3  # a tenth of a second; what is shorter passes unseen
STILL = {"path_m": 0.01, "tilt_deg": 5.0, "turn_deg": 5.0, "hinge_max_deg": 5.0}  # less of each is no motion
MOVES = {"path_m": 0.05, "hinge_max_deg": 10.0}  # of the mean training clip of a verb that moves its object


def visible_faults(
    clip: Clip, points: ObjectPoints, hands: HandPair, check: VerbCheck | None, asked: str | None
) -> tuple[str, ...]:
    """Faults of a motion, each in words.

    points: sampled on the object. check: of the training clips, None where the networks keep none. asked: the verb that
    the motion is to show, None where it is not known.
    """
    index = surface_index(clip.object.model)
    there: list[Side] = [side for side in SIDES if clip.hands[side].valid.any()]
    placed: dict[Side, PlacedHand] = {side: placed_hand(clip, side, hands) for side in there}
    gaps: dict[Side, np.ndarray] = {side: _gap_m(hand, index) for side, hand in placed.items()}
    found = [*_contact_faults(clip, gaps), *_depth_faults(placed, index)]
    if check is not None:
        numbers = check.numbers(clip, points)
        moved_as, seen = check.moved_as(numbers), check.seen(asked, numbers)
        if asked is not None and _is_still(numbers) and _moves_its_object(check.actions, asked):
            found.append("the object does not move")
        elif seen:
            other = f", more like {moved_as!r}" if check.fails(asked, moved_as) else ""
            whose = f"{asked!r} in training" if asked else "the motions of training"
            found.append(f"unlike {whose}{other}: {', '.join(seen)}")
    return tuple(found)


def _gap_m(hand: PlacedHand, index: SurfaceIndex) -> np.ndarray:
    """(frame,) metres from the skin to the surface, infinite without the hand."""
    return hand.over_clip(index.distance_m(hand.vertices_m, hand.hinge_rad).min(axis=1), np.inf)


def _contact_faults(clip: Clip, gap_m: Mapping[Side, np.ndarray]) -> list[str]:
    away = {side: float(gap.min()) for side, gap in gap_m.items() if gap.min() > GAP_M}
    found = [f"the {side} hand never touches the object ({gap * 100:.1f} cm away)" for side, gap in away.items()]
    if len(away) < len(gap_m) and clip.gravity is not None:
        height = -(clip.object.translation_m.astype(np.float64) @ np.asarray(clip.gravity, np.float64))
        lifted = height - height[0] > FLOATING_M
        alone = int((lifted & (np.min([*gap_m.values()], axis=0) > GAP_M)).sum())
        found += [f"the object is in the air and no hand touches it in {alone} frames"] * (alone >= LEAST_FRAMES)
    return found


def _depth_faults(placed: Mapping[Side, PlacedHand], index: SurfaceIndex) -> list[str]:
    if not index.is_solid:
        return []
    found = []
    for side, hand in placed.items():
        depth = deepest_m(hand, index)
        if (frames := int((depth > DEEP_M).sum())) >= LEAST_FRAMES:
            deepest = float(np.nanmax(depth)) * 100
            found.append(f"the {side} hand is up to {deepest:.1f} cm inside the object in {frames} frames")
    return found


def _is_still(numbers: Mapping[str, float]) -> bool:
    return all(numbers[name] < most for name, most in STILL.items())


def _moves_its_object(actions: Actions, verb: str) -> bool:
    """Whether the mean training clip of a verb moves its object."""
    if verb not in actions.centroids:
        return False
    mean: dict[str, Any] = {
        name: float(own) * deviation + middle
        for own, (name, (middle, deviation)) in zip(actions.centroids[verb], actions.scale.items(), strict=True)
    }
    return any(mean.get(name, 0.0) > least for name, least in MOVES.items())
