"""What a batch of 64 clips of 150 frames costs: only the distance entries a step looks at, beside all of them.

``python -m bench batches``. Random clips with as many distance entries as a hand close to its object has; both ways
give the losses the same frames.
"""

from collections.abc import Sequence

import numpy as np
import torch

from bench.harness import medians, show
from hoidata.batches.dataset import ClipBatch, ClipSample, collate
from hoidata.batches.requests import ObjectPoints
from hoidata.batches.sight import Sight
from hoidata.objects.model import ObjectModel
from hoidata.store.distances import DistanceEntries

CLIPS, FRAMES, ENTRIES = 64, 150, 80_000
SEEN_FRAMES, SEEN_ENTRIES = 8, 8192


def main() -> None:
    random = np.random.default_rng(0)
    samples = [random_sample(number, random) for number in range(CLIPS)]
    lengths = [FRAMES] * CLIPS

    def ours() -> ClipBatch:
        return collate(samples, Sight.drawn(lengths, SEEN_FRAMES, SEEN_ENTRIES, np.random.default_rng(1)))

    def all_entries() -> tuple[ClipBatch, torch.Tensor]:
        """Pads each clip by itself, reads every entry, and looks for those of the chosen frames afterwards."""
        batch = collate(samples)
        padded = [np.pad(own.hands, [(0, 0), (0, FRAMES - own.length), (0, 0)]) for own in samples]
        rows = torch.from_numpy(every_entry(samples))
        chosen = torch.from_numpy(Sight.drawn(lengths, SEEN_FRAMES, 0, np.random.default_rng(1)).frames)
        place = torch.full((CLIPS, FRAMES), -1).scatter_(1, chosen, torch.arange(SEEN_FRAMES).expand_as(chosen))
        kept = torch.nonzero(place[rows[:, 0], rows[:, 2]] >= 0)[:, 0]
        assert len(padded) == CLIPS
        return batch, rows[kept[torch.randint(len(kept), (SEEN_ENTRIES,))]]

    times = medians({"entries of chosen frames": ours, "all entries, then chosen": all_entries})
    rows = [[name, f"{own.median * 1e3:.1f}", f"{own.processor * 1e3:.1f}"] for name, own in times.items()]
    title = f"A batch of {CLIPS} clips of {FRAMES} frames, {ENTRIES:,} distance entries each"
    show(title, ["way", "clock ms", "processor ms"], rows)


def every_entry(samples: Sequence[ClipSample]) -> np.ndarray:
    """(entry, 5) int64 rows of all clips."""
    rows = []
    for number, sample in enumerate(samples):
        own = sample.distances
        columns = (np.full(len(own.frame), number), own.side, own.frame, own.joint, own.point)
        rows.append(np.stack([np.asarray(column, np.int64) for column in columns], axis=1))
    return np.concatenate(rows)


def random_sample(number: int, random: np.random.Generator) -> ClipSample:
    """A clip of random numbers, in the layout and order of a stored one."""
    kinds = {"side": 2, "joint": 21, "point": 1024}
    index = {name: random.integers(0, most, ENTRIES).astype(np.int16) for name, most in kinds.items()}
    frame = np.sort(random.integers(0, FRAMES, ENTRIES)).astype(np.int16)
    distances = DistanceEntries(**index, frame=frame, distance_m=random.random(ENTRIES).astype(np.float32))
    points, normals = random.normal(size=(2, 1024, 3)).astype(np.float32)
    cloud = ObjectPoints(points, normals, np.zeros(1024, np.uint8))
    model = ObjectModel("random", np.eye(3), np.array([[0, 1, 2]]), np.zeros(3, np.uint8))
    arrays = {name: random.normal(size=shape).astype(np.float32) for name, shape in SHAPES.items()}
    return ClipSample(
        clip_id=f"random/{number}", dataset="random", verb="lift", object_words="thing", object_key="thing",
        object_model=model, hand_type="both", sentences=("Lift.",) * 4, synthetic=True, start=0,
        valid=np.ones((2, FRAMES), bool), active_hands=np.ones(2, bool), template_m=None, points=cloud,
        contact=np.zeros((2, 1024), bool), contact_threshold_m=0.02, distances=distances,
        world_from_model=np.eye(4), **arrays,
    )  # fmt: skip


SHAPES = {
    "hands": (2, FRAMES, 99), "object": (FRAMES, 10), "joints_m": (2, FRAMES, 21, 3), "betas": (2, 10),
    "text": (4, 512),
}  # fmt: skip


if __name__ == "__main__":
    main()
