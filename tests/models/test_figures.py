"""The illustrations of Text2HOI as pages: each holds its motions, contact maps and numbers."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hoidata.clips.clip import Clip
from hoidata.geometry.transform import RigidTransform
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.store.annotated import AnnotatedStore
from models.common.predicting import sample_family
from models.registry import load_family
from models.text2hoi.generation import Generator
from pipelines.pages.figures import Figure, Panel, Subject, seen_from, write_pages
from pipelines.pages.player import write_page
from pipelines.stages.base import StagePaths

HANDS = load_embedded_hands()
TITLE = re.compile(r"<h3>(.*?)</h3>")
ROW = re.compile(r"<tr><td>(.*?)</td>")


@pytest.fixture
def subject(annotated: AnnotatedStore, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Subject:
    """A box that the left hand lifts in training and in the test clip, and the right hand passes in training."""
    monkeypatch.chdir(tmp_path)
    paths, family = StagePaths("test", "toy"), load_family("mean-motion")
    paths.checkpoints.parent.mkdir(parents=True)
    paths.checkpoints.symlink_to(trained)
    out = replace(paths, family=family.name).samples
    sample_family(family, annotated.root, trained, out, {"samples": 1}, HANDS)
    generator = Generator.load(trained, HANDS)
    return Subject(annotated, annotated.ids("test")[0], generator, paths, ("mean-motion", "mean-pose", "ground-truth"))


@pytest.mark.long
def test_each_page_holds_its_motions(subject):
    pages = {path.stem: path.read_text() for path in write_pages(Path("pages"), subject)}
    left, right, both = (f"Lift a box with {words}." for words in ("the left hand", "the right hand", "both hands"))
    refined = [
        "ground truth",
        "recorded, with 5 mm of noise",
        "recorded, with 5 mm of noise, refined",
        "recorded, hands 1 cm inside",
        "recorded, hands 1 cm inside, refined",
    ]
    sizes = [f"{size} times the size" for size in ("0.6", "1", "1.6")]
    expected = {
        "methods": ["recorded", "mean motion"],
        "prompts": [left, "Pass a box with the right hand."],
        "sizes": sizes,
        "samples": [f"sample {number}" for number in (1, 2, 3, 4)],
        "hands": [left, right, both],
        "refiner": refined,
        "frames": ["in the world", "in the object&#39;s frame", "in the left wrist&#39;s frame"],
    }
    assert {name: TITLE.findall(page) for name, page in pages.items()} == expected
    for name, page in pages.items():
        assert left in page
        with_maps = name in ("prompts", "sizes", "samples", "hands")
        assert page.count('<figure class="player') == len(expected[name]) * (1 + with_maps)
        assert ROW.findall(page) == (expected[name] if with_maps or name == "refiner" else [])


def test_text_is_never_markup(tmp_path):
    evil = "<script>x</script>"
    figure = Figure(evil, evil, evil, evil, [Panel(evil, [], evil)], [evil], [(evil,)])
    values = {"facts": [(evil, evil)], "links": [(evil, evil)], "synthetic": True, "has_players": False}
    page = write_page(tmp_path / "page.html", "figures.html", title=evil, figure=figure, **values).read_text()
    assert evil not in page
    assert page.count("&lt;script&gt;") >= 10


@pytest.mark.parametrize("number", [0, 2])
def test_a_moving_frame_keeps_distances_and_rests_at_the_identity(annotated, number):
    """A lifted box, and a folder whose hinge opens."""
    clip = annotated.clip(annotated.ids("train")[number])
    still = seen_from(clip, clip.object.world_from_object.inverse())
    np.testing.assert_allclose(still.object.translation_m, 0, atol=1e-6)
    np.testing.assert_allclose(still.object.rotvec, 0, atol=1e-6)
    np.testing.assert_allclose(distances_m(still), distances_m(clip), atol=1e-5)
    track = clip.hands["left"]
    wrist = RigidTransform.from_rotvec(track.global_orient.astype(np.float64), track.wrist_m.astype(np.float64))
    canonical = seen_from(clip, wrist.inverse()).hands["left"]
    np.testing.assert_allclose(canonical.wrist_m, 0, atol=1e-6)
    np.testing.assert_allclose(canonical.global_orient, 0, atol=1e-6)
    np.testing.assert_array_equal(canonical.hand_pose, track.hand_pose)


def distances_m(clip: Clip) -> np.ndarray:
    """(frame, vertex, 42) from vertices of the object to the joints of both hands."""
    model = clip.object.model
    vertices_m = clip.object.points_in_world(model.vertices_m, model.part)
    joints_m = np.concatenate([track_joints(track, HANDS[side]) for side, track in clip.hands.items()], axis=1)
    return np.linalg.norm(vertices_m[:, :, None] - joints_m[:, None], axis=3)
