"""Which hands act: against what the embedded corpora know, and recording by recording on real clips.

``python -m bench.hands [FOLDER ...]``: folders of datasets as the stages write them (``data/own/manipnet``) with
``clips`` and ``annotation`` in them; those of this project by default. For the embedded corpora the known hand is that
of the action table the corpora are made from, and every stored sentence must name exactly it. For every dataset a row
per recording: the test at the stage's threshold against sampled points and against the surface itself.
"""

import re
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import orjson
import pandas as pd

from bench.harness import show
from hoidata.annotation.derived import derive_verb
from hoidata.clips import SIDES, Clip, HandType, Side
from hoidata.contact.maps import acting_hands
from hoidata.contact.proximity import ProximityIndex
from hoidata.contact.stage import sample_objects
from hoidata.objects.surface_index import surface_index
from hoidata.store.hand_evidence import HandEvidence
from hoidata.store.store import Store, open_store
from hoidata.synthetic.actions import ACTIONS

NAMED = {
    "left": re.compile(r"\bleft hand\b", re.I),
    "right": re.compile(r"\bright hand\b", re.I),
    "both": re.compile(r"\bboth hands\b", re.I),
}
HAND_TYPES: tuple[HandType | None, ...] = ("left", "right", "both", None)
# Verbs that say the same of a motion: what is sprinkled is shaken.
SAME_MOTION = {"sprinkle": "shake"}


class Measured(NamedTuple):
    """One clip and its evidence against sampled points and against the surface."""

    clip: Clip
    points: HandEvidence
    surface: HandEvidence


def main(folders: Sequence[str] = ()) -> None:
    roots = [Path(folder) for folder in folders] or sorted(path.parent for path in Path("data").glob("*/*/clips"))
    for root in roots:
        store = open_store(root / "clips")
        if not store.ids:
            continue
        threshold_m = orjson.loads((root / "annotation" / "info.json").read_bytes())["threshold_m"]
        measured = measure(store, threshold_m)
        if store.info["dataset"] in ACTIONS and all(item.clip.synthetic for item in measured):
            show_known(root, measured)
        show_recordings(root, measured, threshold_m)
        show_verbs(root, measured)


def measure(store: Store, threshold_m: float) -> list[Measured]:
    indices = {name: ProximityIndex(cloud) for name, cloud in sample_objects(store, 1024).items()}
    measured = []
    for clip_id in store.ids:
        clip = store.clip(clip_id)
        joints: dict[Side, np.ndarray] = {side: store.joints(clip_id, side) for side in SIDES}
        points = acting_hands(clip, joints, indices[clip.object.model.name], threshold_m)
        surface = _at_surface(clip, joints, threshold_m)
        measured.append(Measured(clip, points, surface))
    return measured


def _at_surface(clip: Clip, joints_m: dict[Side, np.ndarray], threshold_m: float) -> HandEvidence:
    """The same test against the object's exact surface in the place of sampled points of it."""
    index, distance = surface_index(clip.object.model), {}
    for side in SIDES:
        positions = clip.object.world_from_object.inverse() @ joints_m[side].astype(np.float64)
        nearest = index.distance_m(positions, clip.object.hinge_rad).min(axis=1, initial=np.inf)
        distance[side] = np.where(clip.hands[side].valid, nearest, np.inf)
    return HandEvidence(None, distance, threshold_m).at_threshold(threshold_m)


def known_hand(clip: Clip) -> HandType:
    """The hands of the one action of the embedded corpora with this verb and object."""
    pair = (clip.verb, clip.object.model.name)
    (hand,) = {action.hold.hand for action in ACTIONS[clip.dataset] if (action.verb, action.object_name) == pair}
    return cast(HandType, hand)


def show_known(root: Path, measured: Sequence[Measured]) -> None:
    hand_types = pd.read_parquet(root / "annotation" / "hand_type.parquet").set_index("clip_id")["hand_type"]
    sentences = pd.read_parquet(root / "annotation" / "text.parquet").groupby("clip_id")["sentence"].agg(list)
    known = {item.clip.clip_id: known_hand(item.clip) for item in measured}
    stored = sum(hand_types[clip_id] == hand for clip_id, hand in known.items())
    texts = [(text, hand) for clip_id, hand in known.items() for text in sentences[clip_id]]
    named = sum([name for name, form in NAMED.items() if form.search(text)] == [hand] for text, hand in texts)
    surface = sum(item.surface.hand_type == known[item.clip.clip_id] for item in measured)
    acting, idle = [], [np.inf]
    for item in measured:
        for side in SIDES:
            acts = known[item.clip.clip_id] in (side, "both")
            (acting if acts else idle).append(item.points.closest_m(side))
    row = [
        f"{stored} of {len(known)}",
        f"{named} of {len(texts)}",
        f"{surface} of {len(known)}",
        f"{1e3 * max(acting):.1f}",
        f"{1e3 * min(idle):.0f}",
    ]
    heads = ["known hand", "sentences naming it alone", "at the surface", "farthest acting, mm", "nearest idle, mm"]
    show("Embedded: hand type found, and named", ["dataset", *heads], [[root.name, *row]])


def show_recordings(root: Path, measured: Sequence[Measured], threshold_m: float) -> None:
    names = sorted({item.clip.sequence for item in measured})
    names = names if len(names) <= 12 else []
    groups = {name: [item for item in measured if item.clip.sequence == name] for name in names}
    rows = [recording_row(name, group) for name, group in {**groups, "all": list(measured)}.items()]
    within = f"{1e2 * threshold_m:g} cm"
    heads = [
        "clips", "frames", f"{within} to points: left, right, both, none", "to the surface",
        "frames near: left, right", "at the surface", "closest, mm: left, right", "at the surface",
    ]  # fmt: skip
    show(f"{root}: acting hands, % of clips and of valid frames", ["recording", *heads], rows)


def recording_row(name: str, group: Sequence[Measured]) -> list[str]:
    frames = sum(item.clip.n_frames for item in group)
    columns: list[list[str]] = [[], [], []]
    for kind in ("points", "surface"):
        evidence = [getattr(item, kind) for item in group]
        counts = Counter(item.hand_type for item in evidence)
        columns[0].append(" ".join(f"{100 * counts[hand] / len(group):.0f}" for hand in HAND_TYPES))
        columns[1].append(" ".join(near_share(group, evidence, side) for side in SIDES))
        columns[2].append(" ".join(f"{1e3 * min(item.closest_m(side) for item in evidence):.1f}" for side in SIDES))
    return [name, str(len(group)), str(frames), *(cell for pair in columns for cell in pair)]


def near_share(group: Sequence[Measured], evidence: Sequence[HandEvidence], side: Side) -> str:
    near = sum(int(item.near(side).sum()) for item in evidence)
    valid = sum(int(item.clip.hands[side].valid.sum()) for item in group)
    return f"{100 * near / valid:.0f}" if valid else "-"


def show_verbs(root: Path, measured: Sequence[Measured]) -> None:
    """What the rules of ``hoidata.annotation.derived`` would say, beside the verbs that are known."""
    pairs = [(item.clip.verb, derive_verb(item.clip, item.points).verb) for item in measured if item.points.hand_type]
    rows = []
    for known in sorted({verb or "none" for verb, _ in pairs}):
        found = Counter(derived for verb, derived in pairs if (verb or "none") == known)
        listed = ", ".join(f"{verb} {count}" for verb, count in found.most_common())
        right = (found[known], found[SAME_MOTION.get(known, known)])
        rows.append([known, str(found.total()), *(str(count) for count in right), listed])
    total = [str(sum(int(row[column]) for row in rows)) for column in (1, 2, 3)]
    show(
        f"{root}: verbs from motion",
        ["verb", "clips", "the same", "the same motion", "derived"],
        [*rows, ["all", *total, ""]],
    )


if __name__ == "__main__":
    main(sys.argv[1:])
