"""``lineage diff`` reports exactly the planted cause; ``lineage uses`` lists exactly the outputs that use some data."""

import shutil
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
import yaml
from safetensors.numpy import save_file

from hoidata.clips.clip import SourceFile
from hoidata.errors import BadInput
from hoidata.files.atomic import canonical_json
from hoidata.files.checksums import read_metadata
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from pipelines.lineage import provenance
from pipelines.lineage.diff import differences
from pipelines.lineage.raw import RawClip
from pipelines.lineage.targets import find_target
from pipelines.lineage.uses import comes_from, uses

CONTACT = "checkpoints/embedded/grab/contact"
CLIPS = "data/embedded/grab/clips"


def set_params(root: Path, change) -> None:
    params = yaml.safe_load((root / "params.yaml").read_text())
    change(params)
    (root / "params.yaml").write_text(yaml.safe_dump(params))


def change_raw_file(root: Path) -> None:
    path = root / CLIPS / "meta/files.parquet"
    table = parquet.read_table(path)
    rows = table.to_pylist()
    next(row for row in rows if row["path"] == "tools/mug.ply")["sha256"] = "ab" * 32
    parquet.write_table(pa.Table.from_pylist(rows, table.schema), path)


PLANTED = {
    "nothing": (lambda ran, _: ran.run_again(), []),
    "a param of training": (
        lambda ran, _: [set_params(ran.root, lambda p: p["train"]["demo"]["contact"].update(lr=0.5)), ran.run_again()],
        ["param train.demo.contact of models/text2hoi/dvc.yaml:train: lr: 0.1 -> 0.5"],
    ),
    "a param far upstream": (
        lambda ran, _: [set_params(ran.root, lambda p: p["convert"].update(margin_frames=9)), ran.run_again()],
        ["param convert.margin_frames of convert: 2 -> 9"],
    ),
    "the seed": (
        lambda ran, _: [set_params(ran.root, lambda p: p["train"].update(seed=4)), ran.run_again(weights=1.0)],
        ["seed: 0 -> 4"],
    ),
    "a file of code": (
        lambda ran, _: [ran.write({"models/text2hoi/contact.py": "WIDTH = 9"}), ran.run_again()],
        ["code models/text2hoi/contact.py: differs"],
    ),
    "a raw file": (
        lambda ran, _: [change_raw_file(ran.root), ran.run_again(weights=1.0)],
        ["raw file tools/mug.ply: differs"],
    ),
    "the recipe of the corpus": (
        lambda ran, _: [ran.write({"manifests/embedded/grab.json": '{"size": 2}'}), ran.run_again()],
        ["manifest manifests/embedded/grab.json: differs"],
    ),
    "a library": (
        lambda ran, patch: [patch.setattr(provenance, "library_versions", lambda: {"numpy": "9"}), ran.run_again()],
        ["library numpy 1 -> 9"],
    ),
    "the device": (lambda ran, _: ran.run_again(device="cuda", weights=1.0), ["device: cpu -> cuda"]),
    "data edited by hand": (
        lambda ran, _: [ran.write({"data/embedded/grab/splits/splits.csv": "s1 test"}), ran.run_again()],
        ["data data/embedded/grab/splits: differs, although all its recorded causes are equal"],
    ),
    "chance": (
        lambda ran, _: ran.run_again(weights=1.0),
        ["weights: differ, although all their recorded causes are equal"],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("planted", PLANTED)
def test_exactly_the_planted_difference_is_reported(ran, monkeypatch, planted):
    plant, expected = PLANTED[planted]
    if planted == "a library":
        monkeypatch.setattr(provenance, "library_versions", lambda: {"numpy": "1"})
        ran.run_again()
    before = find_target(ran.root, shutil.copytree(ran.root / CONTACT, ran.root.parent / "before")).record
    plant(ran, monkeypatch)
    after = find_target(ran.root, CONTACT, ran.root).record
    assert differences(ran.root, before, after) == expected
    assert len(differences(ran.root, after, before)) == len(expected)


def brute_force(root: Path, project_builder, source: str) -> set[str]:
    """The checkpoints with a training clip that ``source`` names, computed from the clips as they were built."""
    checkpoints = set()
    for path in root.glob("checkpoints/**/*.safetensors"):
        for clip_id in read_metadata(path)["provenance"]["clips"]["train"]:
            clip = project_builder.recorded_clip(clip_id)
            names = {clip_id, clip.subject, clip.object.model.name, *(source.path for source in clip.sources)}
            if source in names:
                checkpoints.add(path.parent.relative_to(root).as_posix())
    return checkpoints


@pytest.mark.parametrize(
    "source", ["s1", "s2", "s3", "mug", "cup", "box", "tools/mug.ply", "grab/s1/cup_pour.npz", "grab/s2/mug_pass"]
)
def test_exactly_the_checkpoints_that_use_the_source_are_listed(ran, project_builder, source):
    outputs = uses(ran.root, source)
    assert {use.name for use in outputs if use.kind == "checkpoint"} == brute_force(ran.root, project_builder, source)
    assert CLIPS in {use.name for use in outputs if use.kind == "store"}


def test_samples_and_metrics_use_the_clips_of_their_networks_and_their_own(ran):
    def outputs(source: str) -> set[str]:
        return {use.name for use in uses(ran.root, source) if use.kind in ("sample", "metric")}

    both = {"samples/embedded/grab/text2hoi", "metrics/embedded/grab/text2hoi.json"}
    assert outputs("s1") == both, "a training clip of the network"
    assert outputs("s3") == both, "a sampled clip"
    assert outputs("s2") == set(), "a training clip of another network"


def test_a_checkpoint_lists_its_clips_without_the_store(ran):
    shutil.rmtree(ran.root / CLIPS)
    assert {use.name for use in uses(ran.root, "s2")} == {"checkpoints/embedded/grab/length"}


def test_a_source_that_nothing_uses_is_refused(ran):
    with pytest.raises(BadInput, match="nobody"):
        uses(ran.root, "nobody")


def test_a_file_of_a_frame_concerns_the_clips_of_its_folder():
    clip = RawClip("h2o/a", "subject2", ("mug",), (0, 9), ("subject2/h1/3/obj_pose", "subject2/h1/3/verb.txt"))
    for source in (
        "subject2/h1/3/obj_pose/000010.txt",
        "obj_pose/000010.txt",
        "/raw/subject2/h1/3/obj_pose/000010.txt",
    ):
        assert comes_from(clip, source) == (source != "obj_pose/000010.txt")
    assert not comes_from(clip, "subject2/h1/3/obj_pose_rt/000010.txt")


def test_a_network_uses_the_clips_of_the_network_it_builds_on(ran):
    """A network trained on subject 2 that builds on one trained on subject 1."""
    graph = ran.root / "models/text2hoi/dvc.yaml"
    values = yaml.safe_load(graph.read_text())
    stage = {"wdir": "../..", "cmd": "refine", "deps": [CLIPS, CONTACT], "outs": ["checkpoints/embedded/grab/refiner"]}
    graph.write_text(yaml.safe_dump({**values, "stages": {**values["stages"], "refine": stage}}))
    facts = {"clips": {"train": ["grab/s2/mug_pass"]}}
    record = provenance.build_provenance(ran.root, "models/text2hoi/dvc.yaml:refine", facts)
    path = ran.root / "checkpoints/embedded/grab/refiner/model.safetensors"
    path.parent.mkdir()
    save_file({}, path, {"hoidata": canonical_json({"provenance": record})})
    checkpoints = {use.name for use in uses(ran.root, "s1") if use.kind == "checkpoint"}
    assert checkpoints == {CONTACT, "checkpoints/embedded/grab/refiner"}


def test_a_raw_file_of_one_clip_concerns_that_clip_alone(ran, project_builder):
    clips = [project_builder.recorded_clip(clip_id) for clip_id in project_builder.clips]
    calibration = SourceFile("calibration/s3.txt", 1, "cd" * 32)
    clips[-1] = replace(clips[-1], sources=(*clips[-1].sources, calibration))
    shutil.rmtree(ran.root / CLIPS)
    write_store(ran.root / CLIPS, clips, generated_info("grab"))
    outputs = uses(ran.root, "calibration/s3.txt")
    assert {use.kind for use in outputs} == {"store", "sample", "metric", "table"}
