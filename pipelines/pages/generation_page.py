"""Writes generated motions: motion.npz (arrays), motion.glb (animated model) and a page that plays them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hoidata.clips.clip import FPS
from hoidata.contact.maps import f1_score
from hoidata.files.atomic import canonical_json
from hoidata.hands import HandPair
from hoidata.metrics.verdict import summary
from models.common.checkpoints import FILE_NAME
from models.text2hoi.generation import GeneratedMotion
from pipelines.pages import motion_files
from pipelines.pages.examples import touched_points
from pipelines.pages.motion_files import MotionFiles, simplified_for_page
from pipelines.pages.player import contact_player, motion_player
from pipelines.pages.surface import ContactPaint

# Every array of motion.npz. Axes: S = 2 sides (left, right), F frames, P object points.
ARRAYS = motion_files.GENERATED_ARRAYS | {
    "text": "the sentence",
    "coarse_joints_m": "(S, F, 21, 3) the joints before refinement",
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
    """Write the files of ``write_motions``; returns their paths. ``checkpoints``: their folder, in words."""
    files = []
    for motion in motions:
        digests = sorted(motion.evidence["checkpoints"].items())
        made_from = {f"{checkpoints}/{name}/{FILE_NAME}": digest for name, digest in digests}
        arrays, paint = generated_arrays(motion, hands, made_from), _paint(motion, motion.contact)
        number = motion.evidence["number"]
        files.append(MotionFiles(motion.clip, arrays, paint, checkpoints=made_from, number=number))
    return motion_files.write_motions(
        Path(out_dir),
        "generation.html",
        files,
        hands,
        ARRAYS,
        "the target contact",
        title=str(motions[0].evidence["text"]),
        notes=list(notes),
        verdicts=[(_sample(motion), summary(motion.verdict), motion.verdict) for motion in motions],
        motions=[shown_motion(motion, hands, _sample(motion)) for motion in motions],
        facts=[*generation_facts(motions, checkpoints), ("hand model", hands.name)],
    )


def _sample(motion: GeneratedMotion) -> str:
    return f"sample {motion.evidence['number'] + 1}"


def shown_motion(motion: GeneratedMotion, hands: HandPair, caption: str) -> dict[str, Any]:
    """The content of the page for one motion. Large meshes are simplified on the page only."""
    text, threshold_m = str(motion.evidence["text"]), motion.evidence["contact_threshold_m"]
    reached = touched_points(motion.clip, hands, motion.points, threshold_m)
    both = (motion.contact & reached).sum()
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
        "agreement": f"{motion.contact.sum()} target points, {reached.sum()} touched points, {both} in both "
        f"(F1 {f1_score(motion.contact, reached):.2f})",
    }


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
    attempts = {_sample(shown): count for shown in motions if (count := shown.evidence["attempts"]) > 1}
    resampled = [f"{sample}: the best of {count} motions" for sample, count in attempts.items()]
    compared = [f"{_sample(shown)}: {words}" for shown in motions if (words := _compared(shown))]
    return [
        ("hands", f"{hand['hand']} (decided by {hand['source']}: {hand['evidence']})"),
        ("length", "; ".join(lengths)),
        ("object", clip.object_words),
        *([("verb of the prompt", verb)] if verb else []),
        ("seed", str(evidence["seed"])),
        *[("compared with training", words) for words in compared],
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


def generated_arrays(motion: GeneratedMotion, hands: HandPair, digests: dict[str, str]) -> dict[str, np.ndarray]:
    """The arrays of motion.npz (``ARRAYS``); ``digests``: SHA-256 of the networks' checkpoints by path."""
    return {
        "text": np.array(str(motion.evidence["text"])),
        "checkpoints": np.array(canonical_json(digests)),
        "seed": np.array(motion.evidence["seed"]),
        **motion_files.motion_arrays(motion.clip, hands),
        **motion_files.mesh_arrays(motion.clip.object.model),
        "coarse_joints_m": motion_files.clip_joints_m(motion.coarse, hands),
        "contact_points_m": motion.points.points_m,
        "contact_part": motion.points.part,
        "contact": np.asarray(motion.contact, dtype=bool),
    }
