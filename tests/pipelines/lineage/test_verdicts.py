"""The status that ``hoidata lineage`` gives each node after some edit, on a project after a run."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from dvc_data.hashfile.hash_info import HashInfo
from dvc_data.hashfile.meta import Meta
from dvc_data.hashfile.tree import Tree

from hoidata.errors import BadInput
from hoidata.files.atomic import canonical_json, sha256_file
from hoidata.files.checksums import payload_digest
from pipelines.lineage.check import check
from pipelines.lineage.locks import CACHE, dvc_digest, listing_digest, outdated_samples
from pipelines.lineage.raw import raw_sources
from pipelines.lineage.targets import find_target
from pipelines.lineage.tree import overall_status, target_tree
from pipelines.pages.metrics_table import markdown_table
from tests.builders.folders import write_text

pytestmark = pytest.mark.slow

CONTACT = "checkpoints/embedded/grab/contact/model.safetensors"
CLIPS = "data/embedded/grab/clips"
RAW = ".hoidata/raw/embedded/grab"
ADAPTER = "hoidata/datasets/grab/adapter.py"


def changed_nodes(root: Path | None, name: str = CONTACT, here: Path | None = None) -> dict[str, str]:
    """The status of all nodes that are not as recorded."""
    tree = target_tree(root, find_target(root, name, here or root))
    return {
        f"{node.kind} {node.name}": node.status for node in tree.walk() if node.status != "same" and not node.repeated
    }


def set_param(root: Path, value: float) -> None:
    params = yaml.safe_load((root / "params.yaml").read_text())
    params["train"]["demo"]["contact"]["lr"] = value
    (root / "params.yaml").write_text(yaml.safe_dump(params))


def flip(path: Path, number: int) -> None:
    data = bytearray(path.read_bytes())
    data[number] ^= 1
    path.write_bytes(data)


SITUATIONS = {
    "nothing": (lambda ran: None, {}),
    "an edited param": (lambda ran: set_param(ran.root, 0.5), {"param train.demo.contact": "changed"}),
    "a param of another network": (
        lambda ran: ran.write({"params.yaml": (ran.root / "params.yaml").read_text().replace("0.2", "0.9")}),
        {},
    ),
    "edited code that matters": (
        lambda ran: ran.write({ADAPTER: "SCALE = 2"}),
        {f"code {ADAPTER}": "changed", "code code": "changed"},
    ),
    "edited code that does not matter": (lambda ran: ran.write({"models/text2hoi/unused.py": "1"}), {}),
    "an edited raw file": (lambda ran: ran.write({f"{RAW}/tools/mug.ply": "longer"}), {"raw RAW": "changed"}),
    "a missing raw file": (lambda ran: (ran.root / RAW / "tools/mug.ply").unlink(), {"raw RAW": "missing"}),
    "raw files gone": (lambda ran: shutil.rmtree(ran.root / RAW), {"raw RAW": "missing"}),
    "a missing manifest": (
        lambda ran: (ran.root / "manifests/embedded/grab.json").unlink(),
        {"manifest manifests/embedded/grab.json": "missing"},
    ),
    "a flipped bit in the weights": (lambda ran: flip(ran.root / CONTACT, -1), {f"checkpoint {CONTACT}": "tampered"}),
    "a flipped bit in the header": (lambda ran: flip(ran.root / CONTACT, 400), {f"checkpoint {CONTACT}": "tampered"}),
    "a header that cannot be read": (lambda ran: flip(ran.root / CONTACT, 8), {f"checkpoint {CONTACT}": "tampered"}),
    "a flipped bit in a store": (
        lambda ran: flip(next((ran.root / CLIPS / "arrays").glob("frames-*.npz")), 200),
        {f"data {CLIPS}": "tampered"},
    ),
    "a store that is gone": (lambda ran: shutil.rmtree(ran.root / CLIPS), {f"data {CLIPS}": "missing"}),
}


@pytest.mark.parametrize("situation", SITUATIONS)
def test_each_edit_gets_its_status(ran, situation):
    change, expected = SITUATIONS[situation]
    change(ran)
    expected = {key.replace("RAW", (ran.root / RAW).as_posix()): status for key, status in expected.items()}
    assert changed_nodes(ran.root) == expected
    worst = overall_status(target_tree(ran.root, find_target(ran.root, CONTACT, ran.root)))
    assert worst == (next(iter(expected.values())) if expected else "same")


def test_overwritten_weights_are_tampered_although_the_header_is_intact(ran):
    path = ran.root / CONTACT
    data = path.read_bytes()
    path.write_bytes(data[:-16] + bytes(np.ones(4, np.float32)))
    target = find_target(ran.root, CONTACT, ran.root)
    assert (target.status, target.note) == ("tampered", "the weights differ from their checksum")


def test_a_checkpoint_trained_with_uncommitted_edits_is_uncommitted_until_the_commit(ran):
    ran.write({ADAPTER: "SCALE = 3"})
    set_param(ran.root, 0.7)
    ran.run_again()
    expected = {f"code {ADAPTER}": "uncommitted", "code code": "uncommitted", "param train.demo.contact": "uncommitted"}
    assert changed_nodes(ran.root) == expected
    ran.commit()
    assert changed_nodes(ran.root) == {}


def test_a_checkpoint_of_an_older_commit_names_the_commit_with_its_code_and_params(ran):
    old_commit = ran.git("rev-parse", "HEAD").strip()
    copy = shutil.copytree((ran.root / CONTACT).parent, ran.root.parent / "kept")
    ran.write({ADAPTER: "SCALE = 2"})
    set_param(ran.root, 0.5)
    ran.run_again()
    ran.commit()
    target = find_target(ran.root, str(copy))
    assert (target.status, target.note[-17:]) == ("same", f"commit {old_commit[:10]}")
    nodes = {node.name: node for node in target_tree(ran.root, target).walk()}
    assert nodes[ADAPTER].status == nodes["train.demo.contact"].status == "changed"
    assert nodes[ADAPTER].detail == f"as recorded in commit {old_commit[:10]}"
    assert nodes["train.demo.contact"].detail == f"lr: 0.1 -> 0.5 (as recorded in commit {old_commit[:10]})"


def test_a_digest_of_an_older_run_is_found_in_git(ran):
    digest = dvc_digest((ran.root / CONTACT).parent)
    old_commit = ran.git("rev-parse", "HEAD").strip()
    set_param(ran.root, 0.5)
    ran.run_again()
    ran.commit()
    target = find_target(ran.root, digest)
    assert (target.kind, target.status) == ("checkpoint", "missing")
    assert old_commit[:10] in target.note
    assert changed_nodes(ran.root, digest)["param train.demo.contact"] == "changed"


@pytest.mark.parametrize("digest", [payload_digest, sha256_file, dvc_digest])
def test_a_checkpoint_is_found_by_each_of_its_digests_and_their_prefixes(ran, digest):
    for length in (64, 12):
        target = find_target(ran.root, digest(ran.root / CONTACT)[:length])
        assert target.kind == "checkpoint"
        assert target.record["schema"] == "hoidata.provenance/1"


def test_an_unknown_digest_and_an_unknown_path_are_refused(ran):
    for name in ("0123456789ab", "checkpoints/none", "params.yaml"):
        with pytest.raises(BadInput):
            find_target(ran.root, name, ran.root)


def test_a_copied_checkpoint_is_recognised_and_one_in_no_lock_file_is_an_orphan(ran, tmp_path):
    copied = Path(shutil.copytree((ran.root / CONTACT).parent, tmp_path / "copied"))
    assert changed_nodes(ran.root, str(copied)) == {}
    for lock in (ran.root / "dvc.lock", ran.root / "models/text2hoi/dvc.lock"):
        lock.write_text("schema: '2.0'\nstages: {}\n")
    assert changed_nodes(ran.root, str(copied)) == {}, "the commit still has it"
    shutil.rmtree(ran.root / ".git")
    assert changed_nodes(ran.root, str(copied)) == {f"checkpoint {copied / 'model.safetensors'}": "orphan"}


def test_outside_of_a_project_the_header_has_the_whole_tree_and_nothing_is_compared(ran, tmp_path):
    path = tmp_path / "elsewhere.safetensors"
    shutil.copy(ran.root / CONTACT, path)
    shutil.rmtree(ran.root)
    target = find_target(None, str(path))
    tree = target_tree(None, target)
    assert (tree.status, overall_status(tree)) == ("same", "recorded")
    assert {f"code {ADAPTER}", "param train.seed", f"data {CLIPS}"} <= {
        f"{node.kind} {node.name}" for node in tree.walk()
    }
    source = raw_sources(None, target.record)[0]
    assert [clip.clip_id for clip in source.clips] == ["grab/s1/mug_lift", "grab/s1/cup_pour"]
    assert sorted(source.digests) == ["grab/s1/cup_pour.npz", "grab/s1/mug_lift.npz", "tools/cup.ply", "tools/mug.ply"]
    assert source.clips[0].frames == (60, 68)
    flip(path, -1)
    assert overall_status(target_tree(None, find_target(None, str(path)))) == "tampered"


def test_missing_raw_files_of_the_user_have_the_status_needs_licensed_data(ran, monkeypatch):
    monkeypatch.chdir(ran.root)
    listed = json.loads((ran.root / "data/embedded/grab/raw.json").read_text())
    ran.write({"data/embedded/grab/raw.json": json.dumps(listed | {"source": "files"})})
    ran.run_again()
    ran.commit()
    assert changed_nodes(ran.root) == {"raw grab": "needs licensed data"}
    monkeypatch.setenv("HOIDATA_GRAB", str(ran.root / RAW))
    assert changed_nodes(ran.root) == {}


def test_an_adapter_of_another_package_counts_as_code(project_builder, tmp_path, monkeypatch):
    site, root = tmp_path / "site", tmp_path / "project"
    entry = "[hoidata.adapters]\ngrab = toy_reader.adapter:Toy\n"
    files = {
        "toy_reader/__init__.py": "",
        "toy_reader/adapter.py": "SCALE = 1",
        "toy_reader-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: toy-reader\nVersion: 1.0\n",
        "toy_reader-1.0.dist-info/entry_points.txt": entry,
    }
    write_text(site, files)
    root.mkdir()
    monkeypatch.syspath_prepend(str(site))
    project_builder.build(root, {name: text for name, text in project_builder.code.items() if name != ADAPTER})
    assert changed_nodes(root) == {}
    (site / "toy_reader/adapter.py").write_text("SCALE = 2")
    assert changed_nodes(root) == {"code toy_reader/adapter.py": "changed", "code code": "changed"}


@pytest.mark.parametrize("name", [CLIPS, "samples/embedded/grab/text2hoi/clips", "metrics/embedded/grab/text2hoi.json"])
def test_stores_samples_and_metrics_have_a_lineage(ran, name):
    assert changed_nodes(ran.root, name) == {}
    ran.write({ADAPTER: "SCALE = 2"})
    assert changed_nodes(ran.root, name)["code code"] == "changed"
    path = ran.root / name
    victim = path if path.is_file() else path / "meta/info.json"
    victim.write_text(victim.read_text() + " ")
    assert changed_nodes(ran.root, name)[f"data {name}"] == "tampered"


def test_the_lineage_of_metrics_has_the_networks_of_their_motions(ran):
    """The stage depends on the folder of all motions, of which each family's stage writes a part."""
    name = "metrics/embedded/grab/text2hoi.json"
    flip(ran.root / CONTACT, -1)
    assert changed_nodes(ran.root, name)["data checkpoints/embedded/grab/contact"] == "tampered"
    checked = check(ran.root, find_target(ran.root, name, ran.root))
    assert {node.status for node in checked if "contact" in node.name} == {"tampered"}
    shutil.rmtree(ran.root / "checkpoints/embedded/grab/contact")
    checked = check(ran.root, find_target(ran.root, name, ran.root))
    assert {node.status for node in checked if "contact" in node.name} == {"missing"}


def test_an_overlay_of_the_profile_is_no_change_of_what_dvc_recorded(ran):
    params = yaml.safe_load((ran.root / "params.yaml").read_text())
    ran.write({"params.yaml": yaml.safe_dump({**params, "profiles": {"embedded": {"sample": {"seed": 5}}}})})
    assert "changed" not in changed_nodes(ran.root, "samples/embedded/grab/text2hoi/clips").values()
    ran.write({"params.yaml": yaml.safe_dump({**params, "sample": {"seed": 5}})})
    assert changed_nodes(ran.root, "samples/embedded/grab/text2hoi/clips")["param sample"] == "changed"


def test_a_folder_has_the_digest_that_dvc_gives_it(tmp_path):
    """Names in the order of their characters: "-" is before "/"."""
    tree = Tree()
    for name in ("text2hoi/b", "text2hoi-coarse/a", "text2hoi.json", "Z"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
        tree.add(tuple(name.split("/")), Meta(), HashInfo("md5", hashlib.md5(name.encode()).hexdigest()))
    tree.digest()
    assert dvc_digest(tmp_path) == tree.hash_info.value


def test_the_tree_of_a_generated_motion_has_its_networks(ran):
    motion = ran.root / "generated/motion.npz"
    motion.parent.mkdir()
    np.savez(motion, checkpoints=np.array(canonical_json({CONTACT: sha256_file(ran.root / CONTACT)})))
    assert changed_nodes(ran.root, "generated") == {}
    flip(ran.root / CONTACT, -1)
    assert changed_nodes(ran.root, "generated") == {f"checkpoint {CONTACT}": "tampered"}
    ran.run_again(weights=1.0)
    assert changed_nodes(ran.root, "generated") == {f"checkpoint {CONTACT}": "changed"}
    (ran.root / CONTACT).unlink()
    assert changed_nodes(ran.root, "generated") == {f"checkpoint {CONTACT}": "missing"}
    assert set(changed_nodes(None, str(motion)).values()) == {"recorded"}


def test_a_check_of_a_generated_motion_is_one_of_its_networks_and_their_inputs(ran):
    motion = ran.root / "generated/motion.npz"
    motion.parent.mkdir()
    np.savez(motion, checkpoints=np.array(canonical_json({CONTACT: sha256_file(ran.root / CONTACT)})))
    names = {node.name for node in check(ran.root, find_target(ran.root, "generated", ran.root))}
    assert {CONTACT, CLIPS} <= names
    assert not [name for name in names if "length" in name or name.startswith(("samples", "metrics"))]


@pytest.mark.parametrize(
    ("victim", "node_prefix"),
    [
        (CONTACT, f"checkpoint {CONTACT}"),
        (f"{CLIPS}/meta/info.json", f"data {CLIPS}"),
        (f"{RAW}/tools/mug.ply", "raw "),
    ],
)
def test_check_hashes_all_files_and_lists_those_that_have_changed(ran, victim, node_prefix):
    assert {node.status for node in check(ran.root)} == {"same"}
    flip(ran.root / victim, -1)
    changed = [node for node in check(ran.root) if node.status != "same"]
    assert any(f"{node.kind} {node.name}".startswith(node_prefix) for node in changed)
    target = find_target(ran.root, "checkpoints/embedded/grab/length", ran.root)
    assert all("contact" not in node.name for node in check(ran.root, target))


def test_metrics_are_outdated_after_a_network_or_motions_were_written_again(tmp_path):
    """a and b are two methods; b needs the network, and a file of b was measured before it was sampled again."""

    def digest(number: int) -> str:
        return listing_digest({"x": str(number)})

    def write(network: str, b: str) -> dict[str, str]:
        samples, out = "samples/p/grab", "checkpoints/p/grab/net"
        stages = {
            "train": {"outs": [{"path": out, "md5": network}]},
            "a": {"outs": [{"path": f"{samples}/a", "md5": digest(1)}]},
            "b": {"deps": [{"path": out, "md5": "n1"}], "outs": [{"path": f"{samples}/b", "md5": b}]},
            "evaluate@p-grab": {"deps": [{"path": samples, "md5": "ab.dir"}]},
        }
        (tmp_path / "dvc.lock").write_text(yaml.safe_dump({"stages": stages}))
        return outdated_samples(tmp_path, "p", "grab")

    listing = tmp_path / CACHE / "ab/.dir"
    listing.parent.mkdir(parents=True)
    listing.write_text(json.dumps([{"relpath": "a/x", "md5": "1"}, {"relpath": "b/x", "md5": "2"}]))
    assert write("n1", digest(2)) == {}
    assert write("n2", digest(2)) == {"b": "checkpoints/p/grab/net"}
    assert write("n1", digest(3)) == {"b": "samples/p/grab/b"}
    table = markdown_table(tmp_path, ["b"], ["contact_f1"], {"b": "samples/p/grab/b"})
    assert "- b: stale, samples/p/grab/b has changed since" in table
