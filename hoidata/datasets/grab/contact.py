"""GRAB's contact labels: who touches which vertex of the object in which frame, read in pieces of a few megabytes.

``contact.object`` has one whole number per frame and vertex: 0 for none, 21 and 22 for the left and right hand, 26 to
40 and 41 to 55 for their fingers. Filed as 64-bit numbers for 4,500 frames and 48,370 vertices it takes 1.7 GB.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hoidata.clips.clip import SourceContact
from hoidata.errors import BadInput
from hoidata.files.array_pieces import StoredArray, locate_arrays

MOST_LABELS = 32_000_000  # 290 MB; a hand around a fine mesh touches some 6,000 vertices, a tenth of this in 500 frames
_LARGEST_LABEL = 255


@dataclass(frozen=True)
class ContactLabels:
    """Labels of every step-th frame. touched: (kept frame,) bool; labels: their entries, None when not asked for."""

    touched: np.ndarray
    labels: SourceContact | None

    def cut(self, start: int, stop: int) -> SourceContact | None:
        """The entries of the kept frames ``start`` to ``stop`` (exclusive), counted from ``start``."""
        if self.labels is None:
            return None
        first, last = np.searchsorted(self.labels.frame, (start, stop))
        part = slice(first, last)
        return SourceContact(
            self.labels.frame[part] - np.int32(start), self.labels.vertex[part], self.labels.label[part]
        )


def read_contact(
    place: Path, where: str, n_frames: int, n_vertices: int, step: int, with_labels: bool
) -> ContactLabels:
    """The contact labels of every ``step``-th frame from frame 0 on.

    place: of the NPZ; where: names it in errors. n_frames: as the file says; n_vertices: of the object's mesh.
    with_labels: keep every entry, not only whether a frame has one. Raises BadInput for anything else.
    """
    where = f"{where}: contact.object"
    array = locate_arrays(place, "contact").get("object")
    if array is None or array.shape != (n_frames, n_vertices):
        expected = f"numbers of shape ({n_frames}, {n_vertices}): frames, vertices of the contact mesh"
        raise BadInput(where, expected, "none" if array is None else f"{array.dtype} of shape {array.shape}")
    touched = np.zeros(len(range(0, n_frames, step)), dtype=bool)
    kept: list[SourceContact] = []
    n_kept = 0
    for found in map(lambda piece: _labels_of(where, array, step, *piece), array.pieces()):
        touched[found.frame] = True
        n_kept += len(found.frame)
        if with_labels:
            if n_kept > MOST_LABELS:
                raise BadInput(
                    where, f"at most {MOST_LABELS} labels", "more", "convert with the setting contact: false"
                )
            kept.append(found)
    return ContactLabels(touched, _joined(kept, array.by_columns) if with_labels else None)


def _labels_of(where: str, array: StoredArray, step: int, first: int, piece: np.ndarray) -> SourceContact:
    """The labels of one piece, frames counted in steps. first: number of the piece's first row (or column)."""
    if array.by_columns:
        vertex, frame = np.nonzero(_checked(where, piece[:, ::step]))
        label = piece[:, ::step][vertex, frame]
        vertex = vertex + first
    else:
        skipped = -first % step
        rows = piece[skipped::step]
        frame, vertex = np.nonzero(_checked(where, rows))
        label = rows[frame, vertex]
        frame = frame + (first + skipped) // step
    return SourceContact(frame.astype(np.int32), vertex.astype(np.int32), label.astype(np.uint8))


def _checked(where: str, labels: np.ndarray) -> np.ndarray:
    """Which of them say contact. Raises BadInput unless all are whole numbers a label can be; below 0 is none."""
    if not labels.size:
        return labels > 0
    if labels.dtype.kind == "f" and not (np.isfinite(labels).all() and (labels == np.rint(labels)).all()):
        raise BadInput(where, "whole numbers", "fractions, NaN or infinity")
    if labels.max() > _LARGEST_LABEL:
        raise BadInput(where, f"labels up to {_LARGEST_LABEL}", f"{labels.max()}")
    return labels > 0


def _joined(parts: list[SourceContact], by_columns: bool) -> SourceContact:
    """One array of each kind, sorted by frame, then vertex. Empties ``parts`` on the way: they are not held twice."""
    n_labels = sum(len(part.frame) for part in parts)
    whole = SourceContact(*(np.empty(n_labels, dtype) for dtype in (np.int32, np.int32, np.uint8)))
    stop = n_labels
    while parts:
        part = parts.pop()
        start = stop - len(part.frame)
        whole.frame[start:stop], whole.vertex[start:stop], whole.label[start:stop] = part.frame, part.vertex, part.label
        stop = start
    if not by_columns:
        return whole
    order = np.lexsort((whole.vertex, whole.frame))
    return SourceContact(whole.frame[order], whole.vertex[order], whole.label[order])
