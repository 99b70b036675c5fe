"""A sentence and an object become a motion: hand type, length, contact, motion, refinement.

Text2HOI Sec. 3 and 4.1. The motion is a :class:`Clip` of dataset "generated" in a z-up world, the object's origin at
zero in the first frame. Everything is drawn from one seed: the same seed gives the same bytes.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hoidata.annotation import TextEncoder, refuse_other_encoder
from hoidata.annotation.hand_choice import HandChoice, Method, choose_hand
from hoidata.batches.dataset import MAX_FRAMES, ClipBatch, ClipSample, ObjectPoints, collate
from hoidata.clips.clip import SIDES, Clip, HandTrack, HandType, ObjectTrack, Side
from hoidata.errors import BadInput
from hoidata.geometry.rotations import rotmat_to_rotvec
from hoidata.hands import HandPair
from hoidata.objects.model import ObjectModel
from hoidata.objects.sampling import SampledPoints, sample_points
from hoidata.store.distances import DistanceEntries
from models.common.checkpoints import Checkpoint, load_checkpoint, motion_generator
from models.common.features import Hands, hand_rotmats, object_rotmat
from models.common.sampling import SamplerConfig
from models.common.surface import Surface
from models.text2hoi.contact import ContactModel
from models.text2hoi.diffusion import Condition
from models.text2hoi.length import SHORTEST_FRAMES, LengthModel
from models.text2hoi.refiner import RefinerModel, refine

MODELS = ("length", "contact", "diffusion", "refiner")
FIELD_RESOLUTION = 48


@dataclass(frozen=True)
class GeneratedMotion:
    """clip: the motion, hands that were not asked for invalid. contact: (1024,) bool contact map it was made for.

    points: where those points lie on the object. coarse: the motion before refinement. evidence: plain values on how
    the hand type was chosen, the length, seed, trained dataset and whether its data was synthetic.
    """

    clip: Clip
    coarse: Clip
    contact: np.ndarray
    points: SampledPoints
    evidence: dict[str, Any]


@torch.no_grad()
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
) -> GeneratedMotion:
    """A motion for ``text`` on ``object`` (metres), with the models in ``checkpoints/<model>``.

    hands and encoder must be the ones the models were trained with. frames: instead of the length model's answer.
    hand_by: "rules", then similarity by a margin, then the share in training; or the paper's plain "similarity".
    Raises BadInput where a model is missing or was trained with other hands or another encoder.
    """
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(True)
    loaded = {name: load_checkpoint(Path(checkpoints) / name, name) for name in MODELS}
    for checkpoint in loaded.values():
        _refuse_others(checkpoint, hands, encoder, Path(checkpoints))
    choice = _chosen_hand(text, encoder, loaded["contact"].facts["hand_types"], hand_by)
    draws = torch.Generator().manual_seed(seed)
    feature = torch.from_numpy(encoder.encode([text]))
    acts = torch.tensor([[choice.hand in (side, "both") for side in SIDES]])
    n_frames = _length(loaded["length"], feature, acts, draws) if frames is None else frames
    if not SHORTEST_FRAMES <= n_frames <= MAX_FRAMES:
        raise BadInput("frames", f"{SHORTEST_FRAMES} to {MAX_FRAMES}", str(n_frames), "ask for another length")
    points = sample_points(object)
    batch = collate([_request(object, points, feature, acts[0].numpy(), n_frames)])
    touched = _contact(loaded["contact"], batch, feature, draws)
    generator = motion_generator(loaded["diffusion"])
    condition = Condition.of(batch, generator.network.object_feature(batch.points_m), feature, touched)
    coarse, objects = generator.sample(condition, sampler or SamplerConfig(), draws)
    coarse, objects = _started_at_origin(coarse, objects)
    refined = _refined(loaded["refiner"], Hands(hands), batch, coarse, objects, touched)
    facts = loaded["diffusion"].facts
    evidence = {
        "text": text,
        "seed": seed,
        "hand": asdict(choice),
        "frames": n_frames,
        "touched_points": int(touched.sum()),
        "trained_on": facts["datasets"],
        "synthetic": bool(facts["synthetic"]),
    }
    clips = [
        to_clip(motion[0], objects[0], object, acts[0].numpy(), text, object_words or object.name, facts["synthetic"])
        for motion in (refined, coarse)
    ]
    return GeneratedMotion(clips[0], clips[1], touched[0].numpy() > 0, points, evidence)


def to_clip(
    hands: Tensor, objects: Tensor, model: ObjectModel, acts: np.ndarray, text: str, object_words: str, synthetic: bool
) -> Clip:
    """Features (2, F, 99) and (F, 10) as a clip; a hand that does not act is invalid in every frame."""
    n_frames = len(objects)
    tracks: dict[Side, HandTrack] = {
        side: _track(hands[number], bool(acts[number])) for number, side in enumerate(SIDES)
    }
    hinge = objects[:, 9].numpy() if model.is_articulated else None
    track = ObjectTrack(model, rotmat_to_rotvec(object_rotmat(objects).numpy()), objects[:, :3].numpy(), hinge)
    return Clip(
        clip_id=f"generated/{model.name}",
        dataset="generated",
        subject="generated",
        sequence=text,
        hands=tracks,
        object=track,
        source_frames=np.arange(n_frames, dtype=np.int32),
        gravity=np.array([0.0, 0.0, -1.0]),
        verb=None,
        object_words=object_words,
        synthetic=synthetic,
    )


def _track(hand: Tensor, acts: bool) -> HandTrack:
    n_frames = len(hand)
    rotvec = rotmat_to_rotvec(hand_rotmats(hand).numpy()) if acts else np.zeros((n_frames, 16, 3), np.float32)
    return HandTrack(
        wrist_m=hand[:, :3].numpy() if acts else np.zeros((n_frames, 3), np.float32),
        global_orient=rotvec[:, 0],
        hand_pose=rotvec[:, 1:].reshape(n_frames, 45),
        betas=np.zeros((1, 10), np.float32),
        valid=np.full(n_frames, acts),
    )


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


def _length(checkpoint: Checkpoint, feature: Tensor, acts: Tensor, draws: torch.Generator) -> int:
    network = checkpoint.network
    assert isinstance(network, LengthModel)
    return int(network.sample(feature, acts, draws)[0])


def _contact(checkpoint: Checkpoint, batch: ClipBatch, feature: Tensor, draws: torch.Generator) -> Tensor:
    """(1, 1024) one drawn contact map, 0 or 1; the likeliest points where nothing reaches the threshold."""
    network = checkpoint.network
    assert isinstance(network, ContactModel)
    chance = network.sample(batch.points_m, feature, batch.acts, 1, draws)[:, 0]
    return (chance >= torch.minimum(chance.amax(), torch.tensor(checkpoint.contact_threshold))).float()


def _started_at_origin(hands: Tensor, objects: Tensor) -> tuple[Tensor, Tensor]:
    """The whole motion moved so that the object's origin is exactly at zero in the first frame."""
    shift = objects[:, :1, :3].clone()
    hands, objects = hands.clone(), objects.clone()
    hands[..., :3] -= shift[:, None]
    objects[..., :3] -= shift
    return hands, objects


def _refined(
    checkpoint: Checkpoint, layer: Hands, batch: ClipBatch, hands: Tensor, objects: Tensor, touched: Tensor
) -> Tensor:
    network = checkpoint.network
    assert isinstance(network, RefinerModel)
    surface = Surface.of(layer, batch.samples, FIELD_RESOLUTION, torch.device("cpu"))
    return refine(network, surface.coarse(batch, hands, objects, touched))


def _request(model: ObjectModel, points: SampledPoints, feature: Tensor, acts: np.ndarray, n_frames: int) -> ClipSample:
    """A sample of the asked length without any motion in it: what the models need to know of the object."""
    n_points = len(points.points_m)
    nothing = np.zeros(0, np.int64)
    return ClipSample(
        clip_id=f"generated/{model.name}",
        dataset="generated",
        verb=None,
        object_words=model.name,
        object_key=model.name,
        object_model=model,
        hand_type="",
        sentences=(),
        synthetic=False,
        start=0,
        hands=np.zeros((2, n_frames, 99), np.float32),
        object=np.zeros((n_frames, 10), np.float32),
        joints_m=np.zeros((2, n_frames, 21, 3), np.float32),
        valid=np.ones((2, n_frames), bool),
        acts=acts,
        betas=np.zeros((2, 10), np.float32),
        template_m=None,
        text=feature.numpy(),
        points=ObjectPoints(points.points_m, points.normals, points.part),
        contact=np.zeros((2, n_points), bool),
        contact_threshold_m=0.0,
        distances=DistanceEntries(nothing, nothing, nothing, nothing, np.zeros(0, np.float32)),
        world_from_model=np.eye(4),
    )
