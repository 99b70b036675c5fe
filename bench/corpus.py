"""Raw folders of any size, made from the embedded corpora: files of equal content are hard links under new names.

H2O and GRAB sequences are repeated under further subjects. ARCTIC's are too, with description files of their own: as
in the real ones, many described ranges overlap, so that the number of clips does not follow from that of frames.
"""

import itertools
import os
from pathlib import Path

import numpy as np

from hoidata.datasets.h2o.adapter import H2OAdapter
from hoidata.files import load_npy_object
from hoidata.synthetic.corpus import write_corpus

# Clips of the three datasets as Text2HOI counts them (Cha et al. 2024, table 1): 6,592 in all.
PAPER = {"h2o": 660, "grab": 1335, "arctic": 4597}
ARCTIC_CLIPS_PER_SEQUENCE = 15
ARCTIC_SHORTEST, ARCTIC_RANGE = 150, 182  # frames of the sequences used, and of a described range: 1 M in all
H2O_FOLDERS = ("cam_pose", "hand_pose_mano", "obj_pose_rt", "action_label")


def embedded_root() -> Path:
    """The embedded corpora: of HOIDATA_BENCH_CORPORA, else those ``make demo`` wrote, else generated here once."""
    given = os.environ.get("HOIDATA_BENCH_CORPORA")
    made = Path(".hoidata", "raw", "embedded")
    if given or all((made / name).is_dir() for name in PAPER):
        return Path(given or made).resolve()
    folder = Path(".hoidata", "bench", "embedded").resolve()
    for name in PAPER:
        if not (folder / name).is_dir():
            write_corpus(name, folder / name)
    return folder


def replicate(source: Path, target: Path, share: float) -> dict[str, int]:
    """Raw folders of ``share`` times the paper's clips below ``target``; how many clips each should give.

    source: of ``embedded_root``, on the same file system.
    """
    wanted = {name: max(1, round(share * count)) for name, count in PAPER.items()}
    _replicate_h2o(source / "h2o", target / "h2o", wanted["h2o"])
    _replicate_grab(source / "grab", target / "grab", wanted["grab"])
    _replicate_arctic(source / "arctic", target / "arctic", wanted["arctic"])
    return wanted


def _link_folder(source: Path, target: Path) -> None:
    target.mkdir(parents=True)
    for item in os.scandir(source):
        if item.is_dir():
            _link_folder(Path(item.path), target / item.name)
        else:
            os.link(item.path, target / item.name)


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    os.link(source, target)


def _copies(sequences: list[Path]) -> itertools.chain[tuple[int, Path]]:
    """All sequences once, then all again, without end, with the number of the copy."""
    return itertools.chain.from_iterable(((copy, path) for path in sequences) for copy in itertools.count())


def _replicate_h2o(source: Path, target: Path, clips: int) -> None:
    _link_folder(source / "object", target / "object")
    sequences = sorted(path.parent for path in source.glob("subject*/*/*/cam4"))
    counts = {path: _labelled_runs(path / "cam4" / "action_label") for path in sequences}
    made, fewest = 0, min(counts.values())
    for copy, path in _copies(sequences):
        if made == clips or clips - made < fewest:
            return
        if counts[path] > clips - made:
            continue
        subject, place, number = path.relative_to(source).parts
        # Subjects 1 to 3 of the first copy keep their names; each further copy counts on.
        name = f"subject{int(subject.removeprefix('subject')) + 10 * copy}"
        for kind in H2O_FOLDERS:
            _link_folder(path / "cam4" / kind, target / name / place / number / "cam4" / kind)
        if (path / "cam4" / "cam_intrinsics.txt").is_file():
            _link(path / "cam4" / "cam_intrinsics.txt", target / name / place / number / "cam4" / "cam_intrinsics.txt")
        made += counts[path]


def _labelled_runs(folder: Path) -> int:
    labels = np.array([int(float(path.read_text())) for path in sorted(folder.glob("*.txt"))])
    starts = np.flatnonzero(np.diff(np.r_[0, labels]) != 0)
    stops = np.r_[starts[1:], len(labels)]
    shortest = H2OAdapter().shortest_frames
    return sum(labels[start] != 0 and stop - start >= shortest for start, stop in zip(starts, stops, strict=True))


def _replicate_grab(source: Path, target: Path, clips: int) -> None:
    _link_folder(source / "tools", target / "tools")
    sequences = sorted(source.glob("grab/s*/*.npz"))
    for copy, path in itertools.islice(_copies(sequences), clips):
        subject = int(path.parent.name.removeprefix("s")) + 10 * copy
        _link(path, target / "grab" / f"s{subject}" / path.name)


def _replicate_arctic(source: Path, target: Path, clips: int) -> None:
    _link_folder(source / "meta", target / "meta")
    lengths = {path: len(load_npy_object(path)) for path in sorted(source.glob("raw_seqs/s*/*.object.npy"))}
    sequences = [path for path, length in lengths.items() if length >= ARCTIC_SHORTEST]
    left = clips
    for copy, path in _copies(sequences):
        stem, subject = path.name.removesuffix(".object.npy"), path.parent.name
        key = f"s{int(subject.removeprefix('s')) + 10 * copy:02d}/{stem}"
        for kind in ("object", "mano"):
            _link(path.with_name(f"{stem}.{kind}.npy"), target / "raw_seqs" / f"{key}.{kind}.npy")
        count = min(left, ARCTIC_CLIPS_PER_SEQUENCE)
        words = (source / "description" / subject / stem / "description.txt").read_text().splitlines()
        text = _descriptions(words, lengths[path], count)
        place = target / "description" / key / "description.txt"
        place.parent.mkdir(parents=True)
        place.write_text(text)
        left -= count
        if not left:
            return


def _descriptions(lines: list[str], n_frames: int, count: int) -> str:
    """``count`` different ranges of about ``ARCTIC_RANGE`` frames, with the words of the given lines in turn."""
    longest = min(n_frames, ARCTIC_RANGE)
    starts = n_frames - longest + 1
    made = []
    for number in range(count):
        start, shorter = 1 + number * max(1, starts // count) % starts, number * max(1, starts // count) // starts
        _, _, words = lines[number % len(lines)].partition(" ")
        made.append(f"{start}-{start + longest - 1 - shorter} {words}")
    return "\n".join(made) + "\n"
