"""Writes generated motions: motion.npz (arrays), motion.glb (animated model) and a page that plays them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.clips.clip import FPS, SIDES
from hoidata.contact.maps import f1_score
from hoidata.contact.proximity import ProximityIndex
from hoidata.files.atomic import canonical_json
from hoidata.hands import HandPair, track_joints
from hoidata.metrics.verdict import summary
from models.common.checkpoints import FILE_NAME
from models.text2hoi.generation import GeneratedMotion
from pipelines.pages.motion_files import ARRAYS as SHARED
from pipelines.pages.motion_files import (
    MotionFiles,
    clip_joints_m,
    mesh_arrays,
    motion_arrays,
    simplified_for_page,
    write_motions,
)
from pipelines.pages.player import contact_player, motion_player
from pipelines.pages.surface import ContactPaint

# Every array of motion.npz. Axes: S = 2 sides (left, right), F frames, P object points.
ARRAYS = {
    "text": "the sentence",
    "checkpoints": "JSON: SHA-256 of each network's file by its path; `hoidata lineage motion.npz` reads it",
    "seed": "the random seed of the motion",
    **SHARED,
    "coarse_joints_m": "(S, F, 21, 3) the joints before refinement",
    "contact_points_m": "(P, 3) points of the object, in its frame",
    "contact_part": "(P,) 1 where the hinge moves the point",
    "contact": "(P,) the target contact map of the motion",
}
REFINED_BY = {"contact": "contact refinement by optimisation", "network": "the refiner network", "none": "nothing"}


def write_generation(
    out_dir: str | Path,
    motions: Sequence[GeneratedMotion],
    hands: HandPair,
    checkpoints: str,
    notes: Sequence[str] = (),
) -> list[Path]:
    """Write motion.npz, motion.glb (further motions: motion-1.npz, ...) and index.html; returns their paths.

    The same motions give the same bytes.

    Args:
        checkpoints: the folder of the checkpoints, in words.
    """
    files = []
    for motion in motions:
        made_from = checkpoint_digests(motion, checkpoints)
        arrays, paint = generated_arrays(motion, hands, made_from), _paint(motion, motion.contact)
        number = motion.evidence["number"]
        files.append(MotionFiles(motion.clip, arrays, paint, checkpoints=made_from, number=number))
    return write_motions(
        Path(out_dir),
        "generation.html",
        files,
        hands,
        ARRAYS,
        "the target contact",
        title=str(motions[0].evidence["text"]),
        notes=list(notes),
        verdicts=[
            (f"sample {motion.evidence['number'] + 1}", summary(motion.verdict), motion.verdict) for motion in motions
        ],
        motions=[shown_motion(motion, hands, f"sample {motion.evidence['number'] + 1}") for motion in motions],
        facts=[*generation_facts(motions, checkpoints), ("hand model", hands.name)],
    )


def shown_motion(motion: GeneratedMotion, hands: HandPair, caption: str) -> dict[str, Any]:
    """The content of the page for one motion. Large meshes are simplified on the page only."""
    text, reached = str(motion.evidence["text"]), reached_contact(motion, hands)
    clip, coarse = (simplified_for_page(shown) for shown in (motion.clip, motion.coarse))
    title = f"{caption}: {text}"
    paints = {"target": _paint(motion, motion.contact), "generated": _paint(motion, reached)}
    return {
        "caption": caption,
        "player": motion_player(clip, hands, title, caption, paints["generated"], "generated contact"),
        "before": motion_player(coarse, hands, f"{title}, before refinement", caption),
        "maps": [
            contact_player(clip, paint, f"{title}, {name}", name, name, paints["target"])
            for name, paint in paints.items()
        ],
        "agreement": _agreement(motion.contact, reached),
    }


def _agreement(target: np.ndarray, generated: np.ndarray) -> str:
    """The agreement of two contact maps (point,), in words."""
    both, f1 = int((target & generated).sum()), f1_score(target, generated)
    return f"{target.sum()} target points, {generated.sum()} touched points, {both} in both (F1 {f1:.2f})"


def reached_contact(motion: GeneratedMotion, hands: HandPair) -> np.ndarray:
    """(P,) bool: points within the training data's contact threshold of a joint of an acting hand in any frame."""
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
    """(name, value) facts of the motions: hands and why, length, object, seed, models, training data."""
    evidence, clip = motions[0].evidence, motions[0].clip
    hand = evidence["hand"]
    kind, verb = "SYNTHETIC" if evidence["synthetic"] else "recorded", evidence["verb"]
    clips = ", ".join(f"{count} {kind} {name} clips" for name, count in evidence["trained_on"].items())
    lengths = [f"{shown.clip.n_frames} frames, {shown.clip.n_frames / FPS:.2f} s at {FPS} fps" for shown in motions]
    digests = ", ".join(f"{name} {digest[:12]}" for name, digest in evidence["checkpoints"].items())
    resampled = [
        f"sample {shown.evidence['number'] + 1}: the best of {shown.evidence['attempts']} motions; the others did not "
        "carry the object or moved unlike the verb"
        for shown in motions
        if shown.evidence["attempts"] > 1
    ]
    return [
        ("hands", f"{hand['hand']} (decided by {hand['source']}: {hand['evidence']})"),
        ("length", "; ".join(lengths)),
        ("object", clip.object_words),
        *([("verb of the prompt", verb)] if verb else []),
        ("seed", str(evidence["seed"])),
        *[
            ("compared with training", f"sample {shown.evidence['number'] + 1}: {words}")
            for shown in motions
            if (words := _compared(shown))
        ],
        *([("rejection sampling", "; ".join(resampled))] if resampled else []),
        ("trained on", clips),
        ("refined by", REFINED_BY[evidence["refine"]]),
        ("checkpoints", f"{checkpoints} (sha256: {digests})"),
        *[("not in training", note) for note in evidence["unseen"]],
    ]


def _compared(motion: GeneratedMotion) -> str:
    """Motion measures outside the range of the verb's training clips, and the nearest verb if it is another one."""
    verb, nearest_verb = motion.evidence["verb"], motion.evidence["moved_as"]
    is_other = verb and nearest_verb and nearest_verb != verb
    return ", ".join([*([f"motion classified as {nearest_verb!r}"] if is_other else []), *motion.evidence["unusual"]])


def checkpoint_digests(motion: GeneratedMotion, folder: str) -> dict[str, str]:
    """SHA-256 of the checkpoints that generated a motion, by path below ``folder``."""
    names = motion.evidence["checkpoints"]
    return {f"{folder}/{name}/{FILE_NAME}": digest for name, digest in sorted(names.items())}


def generated_arrays(motion: GeneratedMotion, hands: HandPair, digests: dict[str, str]) -> dict[str, np.ndarray]:
    """The arrays of motion.npz (``ARRAYS``); ``digests`` as in ``checkpoint_digests``."""
    return {
        "text": np.array(str(motion.evidence["text"])),
        "checkpoints": np.array(canonical_json(digests)),
        "seed": np.array(motion.evidence["seed"]),
        **motion_arrays(motion.clip, hands),
        **mesh_arrays(motion.clip.object.model),
        "coarse_joints_m": clip_joints_m(motion.coarse, hands),
        "contact_points_m": motion.points.points_m,
        "contact_part": motion.points.part,
        "contact": np.asarray(motion.contact, dtype=bool),
    }
