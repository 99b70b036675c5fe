"""Fixed windows of whole recordings as clips of an annotated dataset, as BimArt's released evaluation cuts them."""

from dataclasses import dataclass, replace

import numpy as np

from hoidata.clips.clip import SIDES, Side
from hoidata.settings import require_at_least
from hoidata.store.annotated import AnnotatedStore
from hoidata.store.distances import DistanceEntries


@dataclass(frozen=True)
class WindowProtocol:
    """Which windows of a clip are evaluated; the defaults are those of BimArt's released code."""

    start: int = 100  # first frame of the first window
    stride: int = 64  # frames from one window to the next
    frames: int = 64  # of a window
    trimmed_end: int = 164  # last frames of the clip that no window reaches

    def __post_init__(self) -> None:
        for name, least in (("start", 0), ("stride", 1), ("frames", 3), ("trimmed_end", 0)):
            require_at_least("windows", self, name, least)

    def starts(self, n_frames: int) -> range:
        """First frames of the windows of a clip."""
        return range(self.start, n_frames - self.trimmed_end - self.frames, self.stride)


class WindowedStore(AnnotatedStore):
    """An annotated dataset with windows instead of the clips of one subset, named ``<clip id>@<first frame>``.

    A window has the sentences, the active hands and the sequence of its clip, but no camera, body, further objects or
    contact labels of the source. A clip that is too short has no window.
    """

    def __init__(self, whole: AnnotatedStore, protocol: WindowProtocol, split: str = "test") -> None:
        self.__dict__ |= whole.__dict__  # tables and caches are shared
        cut = {
            clip_id: protocol.starts(int(whole.store.sequences.at[clip_id, "n_frames"])) for clip_id in whole.ids(split)
        }
        self._first = {f"{clip_id}@{start}": start for clip_id, starts in cut.items() for start in starts}
        self._n_frames = protocol.frames
        clip_of = {
            name: clip_id
            for clip_id in whole.store.ids
            for name in ([f"{clip_id}@{start}" for start in cut[clip_id]] if clip_id in cut else [clip_id])
        }
        names, clip_ids = list(clip_of), list(clip_of.values())
        rows = whole.store.sequences.loc[clip_ids].assign(clip_id=names).set_index("clip_id", drop=False)
        first = np.array([self._first.get(name, 0) for name in names])
        is_window = np.array([name in self._first for name in names])
        rows["first_row"] += first
        for side in SIDES:
            rows[f"{side}_betas_row"] += first * (rows[f"{side}_betas_count"] > 1)
            rows.loc[is_window & (rows[f"{side}_betas_count"] > 1), f"{side}_betas_count"] = protocol.frames
        rows.loc[is_window, "n_frames"] = protocol.frames
        rows.loc[is_window, ["camera_row", "body_row", "source_contact_row"]] = -1
        rows["other_objects"] = [
            [] if window else others for window, others in zip(is_window, rows["other_objects"], strict=True)
        ]
        self.store = replace(whole.store, sequences=rows.rename_axis(None), _rows={})
        self.splits = {name: whole.splits[clip_id] for name, clip_id in clip_of.items()}
        with_text = {name: clip_id for name, clip_id in clip_of.items() if clip_id in whole._sentences}
        self._sentences = {name: whole._sentences[clip_id] for name, clip_id in with_text.items()}
        hand_types = whole.hand_types.loc[clip_ids].assign(clip_id=names)
        self.hand_types = hand_types.set_index("clip_id", drop=False)
        self._clips = whole._clips.loc[clip_ids].set_axis(names)

    def distances(self, clip_id: str, side: Side | None = None) -> DistanceEntries:
        entries, first = super().distances(clip_id, side), self._first.get(clip_id)
        return entries if first is None else entries.window(first, first + self._n_frames)

    def touched_frames(self, clip_id: str, side: Side) -> np.ndarray:
        if clip_id not in self._first:
            return super().touched_frames(clip_id, side)
        entries = self.distances(clip_id, side)
        pairs = np.unique(np.stack((entries.frame, entries.point)), axis=1)
        return np.bincount(pairs[1], minlength=self.contact_info["points"]).astype(np.uint16)
