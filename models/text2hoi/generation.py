"""A sentence and an object become a motion: hand type, length, contact, motion, refinement.

Text2HOI Sec. 3 and 4.1. The motion is a :class:`Clip` of dataset "generated" in a z-up world, the object's origin at
zero in the first frame. Everything is drawn from one seed: the same seed gives the same bytes.
"""

import hashlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hoidata.annotation.encoders import TextEncoder, refuse_other_encoder
from hoidata.annotation.hand_choice import HandChoice, Method, choose_hand
from hoidata.batches.dataset import MAX_FRAMES
from hoidata.batches.requests import ObjectPoints, Request
from hoidata.clips.clip import SIDES, Clip, HandType
from hoidata.clips.features import OBJECT_POSITION, WRIST
from hoidata.errors import BadInput
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import SampledPoints, sample_points
from models.common.checkpoints import Checkpoint
from models.common.sampling import SamplerConfig
from models.text2hoi.length import SHORTEST_FRAMES
from models.text2hoi.sampler import SamplingConfig, Text2Hoi, Text2HoiMotion


@dataclass(frozen=True)
class GeneratedMotion:
    """clip: the motion, hands that were not asked for invalid. contact: (N,) bool contact map it was made for.

    points: where those points lie on the object. coarse: the motion before refinement. evidence: plain values on how
    the hand type was chosen, the length, seed, trained dataset and whether its data was synthetic.
    """

    clip: Clip
    coarse: Clip
    contact: np.ndarray
    points: SampledPoints
    evidence: dict[str, Any]


def generate(
    text: str,
    object: ObjectModel,
    checkpoints: str | Path,
    hands: HandPair,
    encoder: TextEncoder,
    seed: int = 0,
    *,
    sampler: SamplerConfig | None = None,
    frames: int | None = None,
    object_words: str | None = None,
    hand_by: Method = "rules",
    threads: int = 2,
    device: str = "cpu",
) -> GeneratedMotion:
    """A motion for ``text`` on ``object`` (metres), with the networks in ``checkpoints/<network>``.

    hands and encoder must be the ones the networks were trained with. frames: instead of the length network's answer.
    hand_by: "rules", then similarity by a margin, then the share in training; or the paper's plain "similarity".
    Raises BadInput where a network is missing or was trained with other hands or another encoder.
    """
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(True)
    model = Text2Hoi.load(checkpoints, hands, SamplingConfig(sampler or SamplerConfig()), device)
    for checkpoint in model.trained.values():
        _refuse_others(checkpoint, hands, encoder, Path(checkpoints))
    choice = _chosen_hand(text, encoder, model.trained["contact"].facts["hand_types"], hand_by)
    points = sample_points(object)
    request = Request(
        motion_id=f"generated/{object.name}",
        object=object,
        points=ObjectPoints(points.points_m, points.normals, points.part),
        text=encoder.encode([text])[0],
        active_hands=np.array([choice.hand in (side, "both") for side in SIDES]),
        n_frames=0,
        seed=seed,
        clip_id=text,
        object_words=object_words or object.name,
    )
    request = replace(request, n_frames=_length(model, request) if frames is None else frames)
    if not SHORTEST_FRAMES <= request.n_frames <= MAX_FRAMES:
        expected = f"{SHORTEST_FRAMES} to {MAX_FRAMES}"
        raise BadInput("frames", expected, str(request.n_frames), "ask for another length")
    motion = _started_at_origin(model.motions([request])[0])
    evidence = {
        "text": text,
        "seed": seed,
        "hand": asdict(choice),
        "frames": request.n_frames,
        "touched_points": int(motion.contact_map.sum()),
        "trained_on": model.facts["datasets"],
        "synthetic": bool(model.facts["synthetic"]),
    }
    refined, coarse = (model.clips([request], [motion], refined=kind)[0] for kind in (True, False))
    return GeneratedMotion(refined, coarse, motion.contact_map.numpy() > 0, points, evidence)


def _refuse_others(checkpoint: Checkpoint, hands: HandPair, encoder: TextEncoder, where: Path) -> None:
    facts = checkpoint.facts
    if facts["hand_digest"] != hands.digest:
        remedy = "pass the hand the models were trained with, or train with this one"
        expected = f"hand {facts['hand']} {facts['hand_digest'][:12]}"
        raise BadInput(where, expected, f"{hands.name} {hands.digest[:12]}", remedy)
    refuse_other_encoder(where, facts["encoder"], encoder.identity)


def _chosen_hand(text: str, encoder: TextEncoder, counts: dict[HandType, int], method: Method) -> HandChoice:
    """Rules first; where the text names no hand, the share of hands among the training clips decides, and is named."""
    total = max(sum(counts.values()), 1)
    return choose_hand(text, encoder, {hand: count / total for hand, count in counts.items()}, method)


def _length(model: Text2Hoi, request: Request) -> int:
    """Frames drawn from the seed and the sentence, so that other words are another draw."""
    text, active_hands = (torch.from_numpy(values)[None] for values in (request.text, request.active_hands))
    seed = int.from_bytes(hashlib.sha256(f"{request.seed} {request.clip_id}".encode()).digest()[:7])
    return model.sample_lengths(text, active_hands, torch.Generator().manual_seed(seed))[0]


def _started_at_origin(motion: Text2HoiMotion) -> Text2HoiMotion:
    """The whole motion moved so that the object's origin is exactly at zero in the first frame."""
    shift = motion.object[0, OBJECT_POSITION].clone()
    coarse, refined, thing = motion.coarse.clone(), motion.refined.clone(), motion.object.clone()
    for hands in (coarse, refined):
        hands[..., WRIST] -= shift
    thing[..., OBJECT_POSITION] -= shift
    return replace(motion, coarse=coarse, refined=refined, object=thing)
