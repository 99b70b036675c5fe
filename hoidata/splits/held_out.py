"""Groups of clips held out so that all they are made of is seen in training: only never together."""

from collections import Counter, defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence

from hoidata.files import sha256_bytes


def hold_out(groups: Sequence[str], seen: Sequence[Iterable[Hashable]], shares: Mapping[str, float]) -> dict[str, str]:
    """Part by group, of the groups that do not train.

    groups: of every clip. seen: of every clip, what training must have a clip of if this one is held out. shares: of
    all clips, by part. Of the groups that bring a part nearer to its share, the one comes next of whose most held out
    content least is held out then (never all of it); among equals the first by the SHA-256 of its name.
    """
    content: dict[str, Counter[Hashable]] = defaultdict(Counter)
    for group, contents in zip(groups, seen, strict=True):
        content[group].update(contents)
    size, total = Counter(groups), sum(content.values(), Counter[Hashable]())
    held, part_of = Counter[Hashable](), dict[str, str]()
    missing = {part: share * len(groups) for part, share in shares.items() if share}

    def held_then(group: str) -> float:
        return max((held[item] + count) / total[item] for item, count in content[group].items())

    order = sorted(content, key=lambda name: sha256_bytes(name.encode()))
    while missing:
        part = max(missing, key=lambda name: missing[name] / shares[name])
        fitting = [name for name in order if name not in part_of and size[name] <= 2 * missing[part]]
        best = min(fitting, key=held_then, default=None)
        if best is None or held_then(best) >= 1:
            del missing[part]
            continue
        part_of[best] = part
        held += content[best]
        missing[part] -= size[best]
    return part_of


def without_shared_frames(
    spans: Sequence[tuple[Hashable, int, int]], parts: Sequence[str | None], order: Sequence[str]
) -> list[str | None]:
    """The parts, but None for a clip that shares frames with one of a part before its own in ``order``.

    spans: of every clip its sequence, first and last source frame.
    """
    kept: dict[Hashable, list[tuple[int, int, str]]] = defaultdict(list)
    found: list[str | None] = [None] * len(spans)
    for part in order:
        for row, (sequence, first, last) in enumerate(spans):
            others = (item for item in kept[sequence] if item[2] != part)
            if parts[row] == part and not any(first <= end and start <= last for start, end, _ in others):
                found[row] = part
                kept[sequence].append((first, last, part))
    return found
