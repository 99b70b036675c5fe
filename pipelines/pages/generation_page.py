"""What a generated motion is written as: motion.npz (arrays), motion.glb (animated) and a page that plays it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.clips.clip import FPS, SIDES
from hoidata.contact.maps import f1_score
from hoidata.contact.proximity import ProximityIndex
from hoidata.files.atomic import canonical_json
from hoidata.hands import HandPair, track_joints
from models.common.checkpoints import FILE_NAME
from models.text2hoi.generation import GeneratedMotion
from pipelines.pages.motion_files import ARRAYS as SHARED
from pipelines.pages.motion_files import MotionFiles, clip_joints_m, drawn, mesh_arrays, motion_arrays, write_motions
from pipelines.pages.player import contact_player, motion_player
from pipelines.pages.surface import ContactPaint

# Every array of motion.npz. Axes: S = 2 sides (left, right), F frames, P object points.
ARRAYS = {
    "text": "the sentence",
    "checkpoints": "JSON: SHA-256 of each network's file by its path; `hoidata lineage motion.npz` reads it",
    "seed": "what the motion was drawn from",
    **SHARED,
    "coarse_joints_m": "(S, F, 21, 3) the joints before refinement",
    "contact_points_m": "(P, 3) points of the object, in its own frame",
    "contact_part": "(P,) 1 where the hinge moves the point",
    "contact": "(P,) the contact map the motion was made for",
}
REFINED_BY = {"contact_refinement": "contact refinement by optimisation", "network": "the refiner network"}


def write_generation(
    out_dir: str | Path,
    motions: Sequence[GeneratedMotion],
    hands: HandPair,
    checkpoints: str,
    notes: Sequence[str] = (),
) -> list[Path]:
    """Write motion.npz, motion.glb (for further motions motion-1.npz, ...) and index.html; gives their paths.

    hands: the model the motions' parameters belong to. checkpoints: the folder they come from, in words. notes: shown
    on top. The same motions give the same bytes.
    """
    files = []
    for motion in motions:
        made_from = checkpoint_digests(motion, checkpoints)
        arrays, paint = generated_arrays(motion, hands, made_from), _paint(motion, motion.contact)
        files.append(MotionFiles(motion.clip, arrays, paint, {}, made_from, motion.evidence["number"]))
    return write_motions(
        Path(out_dir),
        "generation.html",
        files,
        hands,
        ARRAYS,
        "the contact asked for",
        title=str(motions[0].evidence["text"]),
        notes=list(notes),
        motions=[_shown(motion, hands, f"sample {motion.evidence['number'] + 1}") for motion in motions],
        facts=[*generation_facts(motions, checkpoints), ("hand model", hands.name)],
    )


def _shown(motion: GeneratedMotion, hands: HandPair, caption: str) -> dict[str, Any]:
    """What the page shows of one motion; large meshes are thinned, the files keep them whole.

    agreement: of the contact reached with the contact asked for, in words.
    """
    text, reached = str(motion.evidence["text"]), reached_contact(motion, hands)
    clip, coarse = (drawn(shown) for shown in (motion.clip, motion.coarse))
    title = f"{caption}: {text}"
    paints = {"asked for": _paint(motion, motion.contact), "reached": _paint(motion, reached)}
    return {
        "caption": caption,
        "player": motion_player(clip, hands, title, caption, paints["reached"], "contact reached"),
        "before": motion_player(coarse, hands, f"{title}, before refinement", caption),
        "maps": [contact_player(clip, paint, f"{title}, {name}", name, name) for name, paint in paints.items()],
        "agreement": _agreement(motion.contact, reached),
    }


def _agreement(asked: np.ndarray, reached: np.ndarray) -> str:
    """How far two contact maps (point,) agree, in words."""
    both, f1 = int((asked & reached).sum()), f1_score(asked, reached)
    return f"{asked.sum()} points asked for, {reached.sum()} reached, {both} of them asked for (F1 {f1:.2f})"


def reached_contact(motion: GeneratedMotion, hands: HandPair) -> np.ndarray:
    """(P,) bool: points nearer to a joint of an acting hand in any frame than the threshold of the training data."""
    clip, index = motion.clip, ProximityIndex(motion.points)
    reached = np.zeros(len(motion.points.points_m), dtype=bool)
    for side in SIDES:
        track = clip.hands[side]
        if track.valid.any():
            joints = track_joints(track, hands[side])
            near = index.entries(joints, track.valid, clip.object, motion.evidence["contact_threshold_m"])
            reached[near["point"]] = True
    return reached


def _paint(motion: GeneratedMotion, contact: np.ndarray) -> ContactPaint:
    return ContactPaint(motion.points.points_m, motion.points.part, np.asarray(contact, dtype=np.float64))


def generation_facts(motions: Sequence[GeneratedMotion], checkpoints: str) -> list[tuple[str, str]]:
    """Rows (name, value) on how the motions came about: hands and why, length, object, seed, models, training data."""
    evidence, clip = motions[0].evidence, motions[0].clip
    hand = evidence["hand"]
    kind, read_as = "SYNTHETIC" if evidence["synthetic"] else "recorded", evidence["read_as"]
    clips = ", ".join(f"{count} {kind} {name} clips" for name, count in evidence["trained_on"].items())
    lengths = [f"{shown.clip.n_frames} frames, {shown.clip.n_frames / FPS:.2f} s at {FPS} fps" for shown in motions]
    digests = ", ".join(f"{name} {digest[:12]}" for name, digest in evidence["checkpoints"].items())
    drawn = [
        f"sample {shown.evidence['number'] + 1}: the best of {shown.evidence['draws']} motions, as hands did not carry "
        "the object, or hands or object did not move as is usual of the verb"
        for shown in motions
        if shown.evidence["draws"] > 1
    ]
    return [
        ("hands", f"{hand['hand']} (decided by {hand['source']}: {hand['evidence']})"),
        ("length", "; ".join(lengths)),
        ("object", clip.object_words),
        *([("read as", f"{read_as[0]} ({read_as[1]:.0%})")] if read_as else []),
        ("seed", str(evidence["seed"])),
        *[
            ("compared with training", f"sample {shown.evidence['number'] + 1}: {words}")
            for shown in motions
            if (words := _compared(shown))
        ],
        *([("drawn again", "; ".join(drawn))] if drawn else []),
        ("trained on", clips),
        ("refined by", REFINED_BY[evidence["refined_by"]]),
        ("checkpoints", f"{checkpoints} (sha256: {digests})"),
        *[("never seen", note) for note in evidence["unseen"]],
    ]


def _compared(motion: GeneratedMotion) -> str:
    """What lies outside the bounds of the verb's training clips, however little, and which verb it is most like."""
    read_as, moved_as = motion.evidence["read_as"], motion.evidence["moved_as"]
    other = [f"moves most like {moved_as!r}"] if read_as and moved_as and moved_as != read_as[0] else []
    return ", ".join([*other, *motion.evidence["unusual"]])


def checkpoint_digests(motion: GeneratedMotion, folder: str) -> dict[str, str]:
    """SHA-256 of each network's file that made a motion, by its path below ``folder``."""
    names = motion.evidence["checkpoints"]
    return {f"{folder}/{name}/{FILE_NAME}": digest for name, digest in sorted(names.items())}


def generated_arrays(motion: GeneratedMotion, hands: HandPair, made_from: dict[str, str]) -> dict[str, np.ndarray]:
    """The arrays of motion.npz, as ``ARRAYS`` explains them. made_from: see ``checkpoint_digests``."""
    return {
        "text": np.array(str(motion.evidence["text"])),
        "checkpoints": np.array(canonical_json(made_from)),
        "seed": np.array(motion.evidence["seed"]),
        **motion_arrays(motion.clip, hands),
        **mesh_arrays(motion.clip.object.model),
        "coarse_joints_m": clip_joints_m(motion.coarse, hands),
        "contact_points_m": motion.points.points_m,
        "contact_part": motion.points.part,
        "contact": np.asarray(motion.contact, dtype=bool),
    }
