"""What a generated motion is written as: motion.npz (arrays), motion.glb (animated) and a page that plays it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hoidata.clips.clip import FPS, SIDES
from hoidata.contact.maps import f1_score
from hoidata.contact.proximity import ProximityIndex
from hoidata.files.arrays import write_npz
from hoidata.files.digest import canonical_json
from hoidata.hands import HandPair, track_joints
from models.common.checkpoints import FILE_NAME
from models.text2hoi.generation import GeneratedMotion
from pipelines.pages.glb import write_glb
from pipelines.pages.motion_files import ARRAYS as SHARED
from pipelines.pages.motion_files import clip_joints_m, drawn, mesh_arrays, motion_arrays
from pipelines.pages.player import Player, contact_player, motion_player, write_page
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


@dataclass(frozen=True)
class _Shown:
    """One motion on the page. agreement: of the contact reached with the contact asked for, in words."""

    caption: str
    player: Player
    before: Player
    asked: Player
    reached: Player
    agreement: str


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
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for motion in motions:
        name = f"motion-{number}" if (number := motion.evidence["number"]) else "motion"
        made_from = checkpoint_digests(motion, checkpoints)
        write_npz(folder / f"{name}.npz", generated_arrays(motion, hands, made_from))
        paint = _paint(motion, motion.contact)
        write_glb(folder / f"{name}.glb", motion.clip, hands, paint, extras={"checkpoints": made_from})
        paths += [folder / f"{name}.npz", folder / f"{name}.glb"]
    first = motions[0]
    write_page(
        folder / "index.html",
        "generation.html",
        title=str(first.evidence["text"]),
        synthetic=first.clip.synthetic,
        notes=list(notes),
        motions=[_shown(motion, hands, f"sample {motion.evidence['number'] + 1}") for motion in motions],
        facts=[*generation_facts(motions, checkpoints), ("hand model", hands.name)],
        files=[(path.name, _FILE_WORDS[path.suffix]) for path in paths],
        arrays=[(name, ARRAYS[name]) for name in generated_arrays(first, hands, {})],
        has_players=True,
    )
    return [*paths, folder / "index.html"]


_FILE_WORDS = {
    ".glb": "an animated model for any glTF 2.0 viewer; painted: the contact asked for",
    ".npz": "plain arrays, metres and radians: numpy.load('motion.npz')",
}


def _shown(motion: GeneratedMotion, hands: HandPair, caption: str) -> _Shown:
    """What the page shows of one motion; large meshes are thinned, the files keep them whole."""
    text, reached = str(motion.evidence["text"]), reached_contact(motion, hands)
    clip, coarse = (drawn(shown) for shown in (motion.clip, motion.coarse))
    title = f"{caption}: {text}"
    paints = {"asked for": _paint(motion, motion.contact), "reached": _paint(motion, reached)}
    asked, got = (contact_player(clip, paint, f"{title}, {name}", name, name) for name, paint in paints.items())
    player = motion_player(clip, hands, title, caption, paints["reached"], "contact reached")
    before = motion_player(coarse, hands, f"{title}, before refinement", caption)
    return _Shown(caption, player, before, asked, got, _agreement(motion.contact, reached))


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
        ("refined by", {"hold": "a hold against the object", "network": "the refiner network"}[evidence["refined_by"]]),
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
