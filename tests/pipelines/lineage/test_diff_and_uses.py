"""``lineage diff`` names the planted cause and nothing else; ``lineage uses`` finds what saw some data, and no more."""

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
from hoidata.files.sealed import read_metadata
from hoidata.store.info import generated_info
from hoidata.store.store import write_store
from pipelines.lineage import provenance
from pipelines.lineage.diff import differences
from pipelines.lineage.targets import find_target
from pipelines.lineage.uses import uses

CONTACT = "checkpoints/embedded/grab/contact"
CLIPS = "data/embedded/grab/clips"


def set_params(root: Path, change) -> None:
    params = yaml.safe_load((root / "params.yaml").read_text())
    change(params)
    (root / "params.yaml").write_text(yaml.safe_dump(params))


def other_raw_file(root: Path) -> None:
    path = root / CLIPS / "meta/files.parquet"
    table = parquet.read_table(path)
    rows = table.to_pylist()
    next(row for row in rows if row["path"] == "tools/mug.ply")["sha256"] = "ab" * 32
    parquet.write_table(pa.Table.from_pylist(rows, table.schema), path)


PLANTED = {
    "nothing": (lambda ran, _: ran.again(), []),
    "a param of training": (
        lambda ran, _: [set_params(ran.root, lambda p: p["train"]["demo"]["contact"].update(lr=0.5)), ran.again()],
        ["param train.demo.contact of models/text2hoi/dvc.yaml:train: lr: 0.1 -> 0.5"],
    ),
    "a param far upstream": (
        lambda ran, _: [set_params(ran.root, lambda p: p["convert"].update(margin_frames=9)), ran.again()],
        ["param convert.margin_frames of convert: 2 -> 9"],
    ),
    "the seed": (
        lambda ran, _: [set_params(ran.root, lambda p: p["train"].update(seed=4)), ran.again(weights=1.0)],
        ["seed: 0 -> 4"],
    ),
    "a file of code": (
        lambda ran, _: [ran.write({"models/text2hoi/contact.py": "WIDTH = 9"}), ran.again()],
        ["code models/text2hoi/contact.py: differs"],
    ),
    "a raw file": (
        lambda ran, _: [other_raw_file(ran.root), ran.again(weights=1.0)],
        ["raw file tools/mug.ply: differs"],
    ),
    "the recipe of the corpus": (
        lambda ran, _: [ran.write({"manifests/embedded/grab.json": '{"size": 2}'}), ran.again()],
        ["manifest manifests/embedded/grab.json: differs"],
    ),
    "a library": (
        lambda ran, patch: [patch.setattr(provenance, "library_versions", lambda: {"numpy": "9"}), ran.again()],
        ["library numpy 1 -> 9"],
    ),
    "the device": (lambda ran, _: ran.again(device="cuda", weights=1.0), ["device: cpu -> cuda"]),
    "data edited by hand": (
        lambda ran, _: [ran.write({"data/embedded/grab/splits/splits.csv": "s1 test"}), ran.again()],
        ["data data/embedded/grab/splits: differs, and nothing that is recorded of its making does"],
    ),
    "chance": (
        lambda ran, _: ran.again(weights=1.0),
        ["weights: differ, and nothing that is recorded of their making does"],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("planted", PLANTED)
def test_exactly_the_planted_difference_is_told(ran, monkeypatch, planted):
    plant, expected = PLANTED[planted]
    if planted == "a library":
        monkeypatch.setattr(provenance, "library_versions", lambda: {"numpy": "1"})
        ran.again()
    before = find_target(ran.root, shutil.copytree(ran.root / CONTACT, ran.root.parent / "before")).record
    plant(ran, monkeypatch)
    after = find_target(ran.root, CONTACT, ran.root).record
    assert differences(ran.root, before, after) == expected
    assert len(differences(ran.root, after, before)) == len(expected)


def brute_force(root: Path, project_builder, words: str) -> set[str]:
    """The checkpoints whose header lists a clip of which the words tell, clip by clip as they were built."""
    found = set()
    for path in root.glob("checkpoints/**/*.safetensors"):
        for clip_id in read_metadata(path)["provenance"]["clips"]["train"]:
            clip = project_builder.recorded_clip(clip_id)
            names = {clip_id, clip.subject, clip.object.model.name, *(source.path for source in clip.sources)}
            if words in names:
                found.add(path.parent.relative_to(root).as_posix())
    return found


@pytest.mark.parametrize(
    "words", ["s1", "s2", "s3", "mug", "cup", "box", "tools/mug.ply", "grab/s1/cup_pour.npz", "grab/s2/mug_pass"]
)
def test_all_and_only_the_checkpoints_that_saw_it_are_found(ran, project_builder, words):
    found = uses(ran.root, words)
    assert {use.name for use in found if use.kind == "checkpoint"} == brute_force(ran.root, project_builder, words)
    assert CLIPS in {use.name for use in found if use.kind == "store"}


def test_samples_and_metrics_saw_what_their_networks_did_and_what_they_were_asked(ran):
    def made(words: str) -> set[str]:
        return {use.name for use in uses(ran.root, words) if use.kind in ("sample", "metric")}

    both = {"samples/embedded/grab/text2hoi", "metrics/embedded/grab/text2hoi.json"}
    assert made("s1") == both, "learned by the network"
    assert made("s3") == both, "asked for"
    assert made("s2") == set(), "learned by a network these motions do without"


def test_a_checkpoint_tells_what_it_saw_when_its_store_is_gone(ran):
    shutil.rmtree(ran.root / CLIPS)
    assert {use.name for use in uses(ran.root, "s2")} == {"checkpoints/embedded/grab/length"}


def test_what_nothing_saw_is_refused(ran):
    with pytest.raises(BadInput, match="nobody"):
        uses(ran.root, "nobody")


def test_a_network_saw_what_the_one_it_builds_on_did(ran):
    """A network that learned from subject 2, and builds on one that learned from subject 1."""
    graph = ran.root / "models/text2hoi/dvc.yaml"
    values = yaml.safe_load(graph.read_text())
    made = {"wdir": "../..", "cmd": "refine", "deps": [CLIPS, CONTACT], "outs": ["checkpoints/embedded/grab/refiner"]}
    graph.write_text(yaml.safe_dump({**values, "stages": {**values["stages"], "refine": made}}))
    facts = {"clips": {"train": ["grab/s2/mug_pass"]}}
    record = provenance.build_provenance(ran.root, "models/text2hoi/dvc.yaml:refine", facts)
    path = ran.root / "checkpoints/embedded/grab/refiner/model.safetensors"
    path.parent.mkdir()
    save_file({}, path, {"hoidata": canonical_json({"provenance": record})})
    checkpoints = {use.name for use in uses(ran.root, "s1") if use.kind == "checkpoint"}
    assert checkpoints == {CONTACT, "checkpoints/embedded/grab/refiner"}


def test_another_recording_of_a_subject_is_told_by_clip(ran, project_builder):
    """A file that only one of two clips was read from concerns that clip alone."""
    clips = [project_builder.recorded_clip(clip_id) for clip_id in project_builder.clips]
    more = SourceFile("calibration/s3.txt", 1, "cd" * 32)
    clips[-1] = replace(clips[-1], sources=(*clips[-1].sources, more))
    shutil.rmtree(ran.root / CLIPS)
    write_store(ran.root / CLIPS, clips, generated_info("grab"))
    found = uses(ran.root, "calibration/s3.txt")
    assert {use.kind for use in found} == {"store", "sample", "metric", "table"}
