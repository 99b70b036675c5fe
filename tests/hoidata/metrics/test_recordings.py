"""Metrics of ARCTIC's recordings themselves; skipped unless HOIDATA_ARCTIC names their folder."""

import os
from pathlib import Path

import numpy as np
import pytest

from hoidata.clips.clip import SIDES, Clip
from hoidata.contact.proximity import ProximityIndex
from hoidata.datasets.base import RawTree
from hoidata.datasets.registry import get_adapter
from hoidata.hands import HandPair, load_mano_hands
from hoidata.metrics import bimart
from hoidata.metrics.pair import Motion, Pair, TrueContact
from hoidata.objects.sampling import sample_points

ROOT = os.environ.get("HOIDATA_ARCTIC", "")
SEQUENCES = ("s01/waffleiron_grab_01", "s05/ketchup_grab_01")

pytestmark = pytest.mark.skipif(not ROOT, reason="HOIDATA_ARCTIC is not set: the recordings are not in this repository")


@pytest.fixture(scope="module")
def hands() -> HandPair:
    return load_mano_hands(Path(ROOT) / "hand")


@pytest.fixture(scope="module")
def clips(hands: HandPair) -> list[Clip]:
    """Two recordings, whole."""
    adapter = get_adapter("arctic", clips="whole")
    keys = {key.name: key for key in adapter.sequences(Path(ROOT))}
    loaded = [clip for name in SEQUENCES for clip in adapter.load(RawTree(Path(ROOT)), keys[name], hands)]
    assert all(isinstance(clip, Clip) for clip in loaded)
    return loaded


def pair_of(clip: Clip, hands: HandPair) -> Pair:
    points = sample_points(clip.object.model, 16)
    contact = TrueContact(ProximityIndex(points), points.part, np.zeros(16, bool), 0.02)
    motion = Motion(clip, {}, hands)
    return Pair(motion, motion, SIDES, contact, table_m=None)


@pytest.mark.slow
def test_recorded_hands_are_rarely_deeper_than_1_cm_in_the_whole_posed_mesh(clips, hands):
    deep = []
    for clip in clips:
        pair = pair_of(clip.take(np.arange(0, clip.n_frames, 8)), hands)
        deep.append(bimart.pen_1cm_paper(pair, 1))
        assert np.isfinite(bimart._deepest_paper_m(pair)).any()
        assert not np.isposinf(bimart._deepest_paper_m(pair)).any()
    deep_fraction = np.concatenate(deep).mean()
    assert 0 < deep_fraction < 6  # by the sign of each open part it is over 20 %


@pytest.mark.slow
def test_frames_of_recordings_in_which_the_object_rests_do_not_count_as_moving(clips):
    for clip in clips:
        assert (bimart.steps_m(clip.object)[:-1] > bimart.MOVED_AS_RELEASED_M).all()
        assert 0.5 < bimart.moves(clip.object).mean() < 0.9
        assert bimart.turns(clip.object).mean() < 0.5
