"""Every built-in adapter and the walk-through's example pass the conformance check; it detects each kind of mistake."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hoidata.clips.clip import SIDES, Clip, HandTrack, Side
from hoidata.conformance.check import Finding, check_adapter
from hoidata.conformance.loading import first_difference, opened_files
from hoidata.datasets import DatasetPart, RawTree, SequenceKey, get_adapter
from hoidata.datasets.arctic.adapter import ArcticAdapter
from hoidata.datasets.grab.adapter import GrabAdapter
from hoidata.datasets.h2o.adapter import H2OAdapter
from hoidata.errors import BadInput
from hoidata.hands import HandModel, load_embedded_hands
from tests.builders import kitchen

HANDS = load_embedded_hands()


@pytest.fixture(scope="module")
def kitchen_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return kitchen.write_kitchen(tmp_path_factory.mktemp("raw"), HANDS)


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> type:
    """The walk-through's adapter class."""
    return kitchen.import_example(tmp_path_factory.mktemp("package")).KitchenAdapter


def check(adapter, root: Path, **options) -> list[Finding]:
    return check_adapter(adapter, root, HANDS, worker=False, **options)


def not_passed(findings: list[Finding]) -> dict[str, str]:
    """Rule -> detail of each finding that failed or warned."""
    return {item.rule: f"{item.outcome}: {item.detail}" for item in findings if item.outcome in ("fail", "warn")}


def changed(example: type, change: Callable[[Clip], Clip]) -> object:
    """The example adapter with ``change`` applied to every clip."""
    return mistaken(example, loading(lambda clips, *_: list(map(change, clips)))(example))


def mistaken(example: type, methods: dict) -> object:
    """A subclass of the example with other methods; its class is in this module so that it can be pickled."""
    kind = dataclass(frozen=True)(type("MistakenAdapter", (example,), methods | {"__module__": __name__}))
    globals()["MistakenAdapter"] = kind
    return kind()


def test_the_walk_throughs_example_keeps_every_rule(example: type, kitchen_root: Path) -> None:
    findings = check(example(), kitchen_root)
    assert not_passed(findings) == {}
    assert len(findings) >= 36
    assert len({item.rule for item in findings}) == len(findings)
    assert [item.rule for item in findings if item.outcome == "skip"] == ["a worker process gives the same"]


@pytest.mark.long
def test_the_command_checks_an_adapter_of_another_package(tmp_path: Path, kitchen_root: Path) -> None:
    module = kitchen.write_package(tmp_path / "site")
    run = partial_run(tmp_path / "site")
    listed = run("list")
    assert listed.returncode == 0
    for text in ("kitchen-hoi 2.5", "CC BY 4.0", "shortest_frames=10", "built in", "margin_frames=0"):
        assert text in listed.stdout
    good = run("check", "kitchen", "--root", str(kitchen_root))
    assert good.returncode == 0, good.stdout + good.stderr
    assert "36 pass" in good.stdout
    module.write_text(module.read_text().replace("return sorted(", "return list("))
    module.write_text(module.read_text().replace("clip_id=str(key)", 'clip_id=f"{key}".upper()'))
    bad = run("check", "kitchen", "--root", str(kitchen_root), "--setting", "shortest_frames=5")
    assert bad.returncode == 1
    assert "does not begin with kitchen/p01/lift_cup_1" in " ".join(bad.stdout.replace("│", " ").split())
    wrong = run("check", "kitchen", "--root", str(kitchen_root), "--setting", "fps=5")
    assert wrong.returncode == 1
    assert "expected some of shortest_frames, got fps" in " ".join(wrong.stderr.split())


def partial_run(site: Path) -> Callable[..., subprocess.CompletedProcess]:
    """``hoidata adapters ...`` with a folder of packages on the path."""
    environment = os.environ | {"PYTHONPATH": f"{site}{os.pathsep}{os.environ.get('PYTHONPATH', '')}", "COLUMNS": "300"}
    command = [sys.executable, "-m", "pipelines.cli", "adapters"]
    return lambda *words: subprocess.run([*command, *words], capture_output=True, text=True, env=environment)


@pytest.mark.long
@pytest.mark.parametrize("name", ["arctic", "grab", "h2o"])
def test_a_built_in_adapter_keeps_every_rule_on_its_embedded_corpus(name: str, small_corpus) -> None:
    findings = check_adapter(get_adapter(name), small_corpus(name).raw, HANDS)
    assert not_passed(findings) == {}
    assert {item.rule for item in findings if item.outcome == "skip"} <= {"grasped objects rotate with the hand"}


@pytest.mark.long
@pytest.mark.skipif("HOIDATA_MANIPNET" not in os.environ, reason="HOIDATA_MANIPNET names the folder of real recordings")
def test_manipnet_keeps_every_rule_on_its_recordings_but_shares_one_shape_among_them() -> None:
    findings = check_adapter(get_adapter("manipnet"), Path(os.environ["HOIDATA_MANIPNET"]), HANDS, sequences=2)
    assert [item.outcome for item in findings].count("fail") == 0
    shared = {
        "clips stay the same when another sequence is removed",
        "other sequences convert when a file is cut short",
    }
    assert set(not_passed(findings)) <= shared


# Mistakes in clips: the change, and words of the finding that must report it.
def transposed(clip: Clip) -> Clip:
    return replace(clip, object=replace(clip.object, rotvec=-clip.object.rotvec))


def quaternions_from(order: list[int], sides: tuple[Side, ...] = ()) -> Callable[[Clip], Clip]:
    """Rotations of the object, and of the hands of these sides, from quaternions (x, y, z, w) in another order."""

    def wrong(rotvec: np.ndarray) -> np.ndarray:
        return Rotation.from_quat(Rotation.from_rotvec(rotvec).as_quat()[:, order]).as_rotvec().astype("f4")

    def change(clip: Clip) -> Clip:
        hands = {s: replace(t, global_orient=wrong(t.global_orient)) for s, t in clip.hands.items() if s in sides}
        track = replace(clip.object, rotvec=wrong(clip.object.rotvec))
        return replace(clip, object=track, hands={**clip.hands, **hands})

    return change


WXYZ_AS_XYZW, XYZW_AS_WXYZ = [3, 0, 1, 2], [1, 2, 3, 0]


def each_hand(change: Callable[[HandTrack, HandModel], dict[str, np.ndarray]]) -> Callable[[Clip], Clip]:
    """A change of both hand tracks, from each track and its model."""

    def changed_hands(clip: Clip) -> Clip:
        hands = {side: replace(track, **change(track, HANDS[side])) for side, track in clip.hands.items()}
        return replace(clip, hands=hands)

    return changed_hands


without_mean = each_hand(lambda track, model: {"hand_pose": (track.hand_pose - model.mean_pose).astype("f4")})
mean_twice = each_hand(lambda track, model: {"hand_pose": (track.hand_pose + model.mean_pose).astype("f4")})
transl_for_wrist = each_hand(
    lambda track, model: {
        "wrist_m": (track.wrist_m - model.wrist_offset_m(track.betas, track.template_m)).astype("f4"),
    }
)
hands_in_millimetres = each_hand(lambda track, _: {"wrist_m": track.wrist_m * 1000})
nine_betas = each_hand(lambda track, _: {"betas": track.betas[:, :9]})
betas_without_frames = each_hand(lambda track, _: {"betas": track.betas[0]})
without_hands = each_hand(lambda track, _: {"valid": np.zeros_like(track.valid)})


def sides_exchanged(clip: Clip) -> Clip:
    return replace(clip, hands={"left": clip.hands["right"], "right": clip.hands["left"]})


def parts_exchanged(clip: Clip) -> Clip:
    model = replace(clip.object.model, part=(1 - clip.object.model.part).astype(np.uint8))
    return replace(clip, object=replace(clip.object, model=model))


def mesh_times(scale) -> Callable[[Clip], Clip]:
    def change(clip: Clip) -> Clip:
        model = replace(clip.object.model, vertices_m=clip.object.model.vertices_m * np.asarray(scale))
        return replace(clip, object=replace(clip.object, model=model))

    return change


def every_frame_of_the_source(clip: Clip) -> Clip:
    return replace(clip, source_frames=np.arange(clip.n_frames, dtype=np.int32))


COUNTER = count()
WRONG_CLIPS: dict[str, tuple[Callable[[Clip], Clip], str]] = {
    "transposed": (transposed, "transposed by 0.0"),
    "mean missing": (without_mean, "with the mean pose added"),
    "mean twice": (mean_twice, "with the mean pose taken"),
    "transl for wrist": (transl_for_wrist, "with J0 added to the wrist"),
    "sides": (sides_exchanged, "sides exchanged, or mirrored?"),
    "sides, seen at the tips": (sides_exchanged, "with left and right exchanged"),
    "hand unit": (hands_in_millimetres, "expected places within 100 m"),
    "mesh unit": (mesh_times(1000), "expected a mesh 0.001 to 10 m long"),
    "mesh in centimetres": (mesh_times(100), "wrists are within 0.3 m"),
    "mirrored mesh": (mesh_times((-1, 1, 1)), "turned inside out"),
    "not resampled": (
        every_frame_of_the_source,
        "24 frames at 30 per second are 0.77 s, its source frames at 60 0.38 s",
    ),
    "shift of frames": (lambda c: replace(c, source_frames=c.source_frames // 2 * 2 + np.arange(24) % 2), ""),
    "interpolated frames": (
        lambda c: replace(c, source_frames=c.source_frames[[*range(9), 8, 8, 8, *range(12, 24)]]),
        "",
    ),
    "every frame twice": (
        lambda c: replace(c, source_frames=np.repeat(c.source_frames[::2] // 2, 2)),
        "24 frames at 30 per second are 0.77 s",
    ),
    "verb": (lambda c: replace(c, verb="Lift_up"), "the verb 'Lift_up'"),
    "noun": (lambda c: replace(c, object_words="cup_01"), "the object 'cup_01'"),
    "gravity": (lambda c: replace(c, gravity=np.array([0.0, -1.0, 0.0])), "up is +z"),
    "no gravity": (lambda c: replace(c, gravity=None), "no gravity, and no note why"),
    "way back": (lambda c: replace(c, source_from_world=np.diag([1.0, 2.0, 1.0, 1.0])), "shears"),
    "sources": (lambda c: replace(c, sources=()), "clips name their source files"),
    "half the sources": (lambda c: replace(c, sources=c.sources[1:]), "meshes/cup.obj"),
    "id": (lambda c: replace(c, clip_id=f"kitchen/{next(COUNTER):04d}"), "does not begin with kitchen/"),
    "dataset": (lambda c: replace(c, dataset="cellar"), "its dataset is 'cellar'"),
    "fitted": (lambda c: replace(c, hands_from="keypoints"), "fit_error_m must be stated"),
    "nine betas": (nine_betas, "betas: expected shape (1, 10), got (1, 9)"),
    "betas without frames": (betas_without_frames, "betas: expected shape (24, 10), got (10,)"),
    "NaN": (lambda c: replace(c, object=replace(c.object, rotvec=c.object.rotvec * np.nan)), "finite floats"),
}
# One source frame early or late, as if clocks differ; three interpolated frames between recorded ones.
NO_MISTAKE = {"shift of frames", "interpolated frames"}


@pytest.mark.parametrize("mistake", WRONG_CLIPS)
def test_a_mistake_in_clips_is_caught(mistake: str, example: type, kitchen_root: Path) -> None:
    change, words = WRONG_CLIPS[mistake]
    problems = not_passed(check(changed(example, change), kitchen_root, sequences=2))
    if mistake in NO_MISTAKE:
        assert problems == {}
    else:
        assert words in str(problems)


@pytest.mark.parametrize(
    ("base", "name", "change", "words"),
    [
        (H2OAdapter, "h2o", transposed, "grasped objects rotate with the hand"),
        (GrabAdapter, "grab", sides_exchanged, "sides exchanged, or mirrored?"),
        (ArcticAdapter, "arctic", without_mean, "with the mean pose added"),
        (ArcticAdapter, "arctic", transposed, "with object rotations transposed"),
        (ArcticAdapter, "arctic", parts_exchanged, "with the object's parts exchanged"),
        (ArcticAdapter, "arctic", quaternions_from(WXYZ_AS_XYZW), "if quaternions are wxyz, not xyzw"),
        (GrabAdapter, "grab", quaternions_from(WXYZ_AS_XYZW), "if quaternions are wxyz, not xyzw"),
        (H2OAdapter, "h2o", quaternions_from(XYZW_AS_WXYZ), "if quaternions are xyzw, not wxyz"),
        (H2OAdapter, "h2o", quaternions_from(WXYZ_AS_XYZW, SIDES), "if quaternions of hands too are wxyz, not xyzw"),
    ],
)
@pytest.mark.long
def test_a_wrong_convention_shows_on_the_embedded_corpora(base, name, change, words, small_corpus) -> None:
    problems = not_passed(check(changed(base, change), small_corpus(name).raw, sequences=8))
    assert words in str(problems)


# Mistakes in finding and reading files: each function returns methods for a subclass of the example.
Methods = Callable[[type], dict]


def unsorted_keys(example: type) -> dict:
    return {"sequences": lambda self, root: example.sequences(self, root)[::-1]}


def opening_files(example: type) -> dict:
    def sequences(self, root: Path) -> list[SequenceKey]:
        keys = example.sequences(self, root)
        return [key for key in keys if (Path(root) / "recordings" / f"{key.name}.json").read_text()]

    return {"sequences": sequences}


def loading(change: Callable[..., list]) -> Methods:
    """A ``load`` that returns ``change(clips, adapter, raw, key)``."""

    def methods(example: type) -> dict:
        def load(self, raw: RawTree, key: SequenceKey, hands) -> list:
            return change(example.load(self, raw, key, hands), self, raw, key)

        return {"load": load}

    return methods


def with_note(note: Callable[[RawTree], object]) -> Methods:
    """A ``load`` that stores a text about the raw folder in the clips."""
    return loading(lambda clips, _, raw, *__: [replace(clip, gravity_note=str(note(raw))) for clip in clips])


def numbered_ids(clips: list[Clip], adapter, raw: RawTree, key: SequenceKey) -> list[Clip]:
    return [replace(clip, clip_id=f"{clip.clip_id}/{adapter.sequences(raw.root).index(key)}") for clip in clips]


def size_without_raw(raw: RawTree) -> int:
    return len((raw.root / "recordings" / "p02" / "lift_cup_1.json").read_bytes())


def counting(clips: list[Clip], *_) -> list[Clip]:
    return [replace(clip, verb="lift" + "s" * next(COUNTER)) for clip in clips]


def raising(make: Callable[[], Exception]) -> Methods:
    def methods(example: type) -> dict:
        def load(*arguments) -> list:
            try:
                return example.load(*arguments)
            except BadInput as error:
                raise make() from error

        return {"load": load}

    return methods


@pytest.mark.parametrize(
    ("methods", "rule", "words"),
    [
        (unsorted_keys, "sequences are sorted, unique and named as they should be", "not sorted"),
        (opening_files, "sequences are found by name: no file is opened", "recordings/p01/lift_cup_1.json is opened"),
        (loading(numbered_ids), "clips stay the same when another sequence is removed", "differs in"),
        (
            with_note(size_without_raw),
            "files are read through the RawTree only",
            "recordings/p02/lift_cup_1.json is opened without it",
        ),
        (loading(counting), "a second run gives the same", "differs in kitchen/p01/lift_cup_1.verb"),
        (
            with_note(lambda raw: raw.root),
            "a copy of the named source files in another folder gives the same",
            "gravity_note",
        ),
        (raising(lambda: KeyError("trans")), "a damaged file raises BadInput, or gives valid clips", "KeyError"),
        (
            raising(lambda: BadInput("a recording", "a good one", "a bad one", "")),
            "errors name the file, the expected and the actual content and a remedy",
            "a recording",
        ),
        (
            loading(lambda clips, *_: [*clips, "a clip"]),
            "results are clips or quarantined intervals",
            "kitchen/p01/lift_cup_1: a str",
        ),
        (loading(lambda *_: []), "at least one sequence gives a clip", "it gives no clip"),
    ],
)
def test_a_mistake_in_finding_or_reading_files_is_caught(methods, rule, words, example, kitchen_root) -> None:
    problems = not_passed(check(mistaken(example, methods(example)), kitchen_root))
    assert problems[rule].startswith("fail")
    assert words in problems[rule]


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"name": "Kitchen 2"}, "lower-case letters"),
        ({"licence": ""}, "licence is not stated"),
        ({"licence": "research only, no redistribution"}, "may_be_shared is True"),
        ({"source_fps": 0.0}, "source_fps is 0.0"),
        ({"needs_mano": "yes"}, "needs_mano is 'yes'"),
        ({"parts": ()}, "parts is empty"),
        ({"parts": (DatasetPart("recordings", ("recordings/*/*.json",), "zip"),)}, "meshes/cup.obj matches no pattern"),
    ],
)
def test_missing_or_contradicting_facts_are_caught(facts, words, example, kitchen_root) -> None:
    adapter = example(**facts) if "parts" in facts else mistaken(example, facts)
    assert words in str(not_passed(check(adapter, kitchen_root, sequences=1)))


def test_conventions_that_exclude_each_other_are_caught(example: type, kitchen_root: Path) -> None:
    adapter = example()
    convention = replace(adapter.hand_convention, left_shape="unused")
    frame = replace(adapter.frame, up_axis=None)
    problems = str(
        not_passed(check(replace(adapter, hand_convention=convention, frame=frame), kitchen_root, sequences=1))
    )
    assert "they exclude each other" in problems
    assert "not which axis is up" in problems


def test_an_object_that_is_not_an_adapter_fails_with_what_it_lacks() -> None:
    (lacking,) = check(object(), Path())
    assert (lacking.outcome, "no parts" in lacking.detail or "no name" in lacking.detail) == ("fail", True)


def test_the_raw_folder_is_unchanged(example: type, kitchen_root: Path) -> None:
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in kitchen_root.rglob("*.*")}
    check(example(), kitchen_root)
    assert before == {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in kitchen_root.rglob("*.*")}


def rotated_against_the_hand(clip: Clip) -> Clip:
    """A clip of 15 frames whose object rotates against the hand, as a screw cap between fingers."""
    return transposed(clip.take(slice(0, 15)))


def test_one_clip_of_fifteen_frames_gets_no_verdict_on_its_convention(example: type, kitchen_root) -> None:
    findings = check(changed(example, rotated_against_the_hand), kitchen_root, sequences=1)
    assert not_passed(findings) == {}
    undecided = {item.rule: item.detail for item in findings if item.detail.startswith("not decided: ")}
    assert set(undecided) == {
        "wrists are within 0.3 m of the object when closest",
        "a fingertip comes within 2 cm of the object in most clips",
        "fingers bend towards the palm: a left hand is a left hand",
        "no other interpretation of the numbers brings the fingertips closer",
        "grasped objects rotate with the hand",
    }
    assert undecided["no other interpretation of the numbers brings the fingertips closer"] == (
        "not decided: 15 frames with a hand; 40 are needed, at most 24 of each clip count: load more sequences"
    )
    assert "transposed by 0.0" in str(not_passed(check(changed(example, transposed), kitchen_root, sequences=2)))


def flat_mesh(clip: Clip) -> Clip:
    triangle = clip.object.model.faces[:1]
    model = replace(clip.object.model, faces=np.concatenate([triangle, triangle[:, ::-1]]))
    return replace(clip, object=replace(clip.object, model=model))


@pytest.mark.parametrize(
    ("change", "rule", "why"),
    [
        (without_hands, "hands are 0.15 to 0.25 m long", "no hand is valid in any frame"),
        (without_hands, "fingers bend towards the palm: a left hand is a left hand", "0 frames of hands"),
        (flat_mesh, "object meshes are not turned inside out (mirrored)", "no mesh encloses 1 %"),
        (lambda c: c.take(slice(0, 3)), "frames are 1/30 s apart by the source's clock", "has 3 frames"),
    ],
)
def test_a_rule_with_too_little_data_is_reported_as_undecided(
    change, rule: str, why: str, example: type, kitchen_root: Path
) -> None:
    (undecided,) = (item for item in check(changed(example, change), kitchen_root, sequences=2) if item.rule == rule)
    assert undecided.outcome == "skip"
    assert undecided.detail.startswith("not decided: ")
    assert why in undecided.detail


def test_rules_about_files_are_undecided_if_none_was_read_through_the_raw_tree(example, kitchen_root) -> None:
    def load(self, raw, key, hands) -> list:
        return [replace(clip, sources=()) for clip in example.load(self, RawTree(raw.root), key, hands)]

    findings = check(mistaken(example, {"load": load}), kitchen_root, sequences=2)
    undecided = {item.rule for item in findings if item.detail.startswith("not decided: ")}
    assert undecided == {
        "files that are read belong to a declared part",
        "a damaged file raises BadInput, or gives valid clips",
        "errors name the file, the expected and the actual content and a remedy",
    }
    assert "is opened without it" in str(not_passed(findings))


def test_a_difference_is_named_by_its_path(make_clip) -> None:
    clip = make_clip()
    assert first_difference((clip,), (make_clip(),)) is None
    other = replace(clip, object=replace(clip.object, rotvec=clip.object.rotvec + 1e-7))
    assert first_difference((clip,), (other,)) == f"{clip.clip_id}.object.rotvec"
    assert first_difference((clip,), (clip, clip)) == "the number of results (1 and 2)"


def test_opened_files_below_a_folder_are_seen_however_they_are_opened(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros(3))
    (tmp_path / "b.txt").write_text("b")
    with opened_files(tmp_path) as opened:
        np.load(tmp_path / "a.npy")
        os.close(os.open(tmp_path / "b.txt", os.O_RDONLY))
        sorted(tmp_path.iterdir())
        Path(__file__).read_bytes()
    assert opened == {"a.npy", "b.txt"}
