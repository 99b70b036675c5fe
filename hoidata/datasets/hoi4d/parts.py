"""Which tracked box is which mesh of HOI4D, and where a mesh of its own lies in the whole object."""

from collections.abc import Sequence
from itertools import permutations

import numpy as np

from hoidata.datasets.hinge import rigid_fit
from hoidata.errors import BadInput

MOST_OFF = 0.15  # of a part's extents: boxes are annotated to some per cent
CLEARLY = 2.0  # another assignment must be so many times worse


def matched(
    where: str, tracked_m: np.ndarray, names: Sequence[str], meshes_m: np.ndarray
) -> tuple[list[int], np.ndarray]:
    """Which of the tracked boxes each mesh is, and the ratio of their extents (mesh, 3).

    tracked_m: (box, 3) and meshes_m: (mesh, 3) extents along each one's own axes. Raises BadInput where no assignment
    fits to 15 %, or a second one fits nearly as well.
    """
    off = np.abs(np.log(tracked_m[None] / meshes_m[:, None])).max(axis=2)  # (mesh, box)
    ways = sorted(
        (max(off[mesh, box] for mesh, box in enumerate(way)), way)
        for way in permutations(range(len(tracked_m)), len(names))
    )
    if not ways or ways[0][0] > np.log1p(MOST_OFF):
        got = "none" if not ways else f"at best {np.expm1(ways[0][0]):.0%} off"
        remedy = "nothing to do: poses of other objects, or fewer than its parts"
        raise BadInput(where, f"boxes of the size of {', '.join(names)}", got, remedy)
    if len(ways) > 1 and ways[1][0] < CLEARLY * max(ways[0][0], np.log1p(0.02)):
        got = f"parts of nearly the same size: {ways[0][0]:.1%} and {ways[1][0]:.1%} off"
        raise BadInput(where, "parts that their sizes tell apart", got, "nothing to do: which is which cannot be told")
    chosen = list(ways[0][1])
    return chosen, tracked_m[chosen] / meshes_m


def aligned_from_whole(where: str, aligned_m: np.ndarray, whole_m: np.ndarray) -> np.ndarray:
    """(4, 4) rigid transform between two copies of a mesh with the same vertices. Raises BadInput for others."""
    if aligned_m.shape != whole_m.shape:
        raise BadInput(where, f"{len(whole_m)} vertices as in the whole object", f"{len(aligned_m)}")
    transform = rigid_fit(whole_m[None], aligned_m[None])[0]
    off = float(np.abs(whole_m @ transform[:3, :3].T + transform[:3, 3] - aligned_m).max())
    if off > 1e-4 * max(1.0, float(np.ptp(whole_m))):
        raise BadInput(where, "the same mesh, turned and moved", f"one {off:.3g} m off", "download the models again")
    return transform
