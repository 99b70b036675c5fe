"""The command ``hoidata lineage``: its output formats, its page and its sub-commands."""

import json
import re
from pathlib import Path

import jsonschema
import prov
import pytest
from prov.model import ProvActivity, ProvDocument, ProvEntity
from typer.testing import CliRunner

from hoidata.errors import BadInput
from pipelines.cli import app

CONTACT = "checkpoints/embedded/grab/contact"
WEIGHTS = f"{CONTACT}/model.safetensors"
CLIPS = "data/embedded/grab/clips"
TRAIN = "models/text2hoi/dvc.yaml:train@embedded-grab-contact"
BOX = re.compile(r'    (n\d+)(?:\["[\w/.@: #;-]+"\]|\("[\w/.@: #;-]+"\))')
ARROW = re.compile(r"    (n\d+) --> (n\d+)")
STYLE = re.compile(r"    style (n\d+) fill:#[0-9a-f]{6}")


@pytest.fixture
def typed(ran, monkeypatch):
    """A function that runs ``hoidata lineage`` with some arguments; returns exit code and output."""
    monkeypatch.chdir(ran.root)

    def run(*arguments: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, ["lineage", *arguments], env={"COLUMNS": "300"})
        if result.exception and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result.exit_code, result.output

    return run


def test_without_options_it_prints_the_tree_and_the_exit_code_says_whether_all_is_the_same(typed, ran):
    for words in (CONTACT, WEIGHTS, str(ran.root / WEIGHTS)):
        code, output = typed(words)
        assert code == 0
        assert f"stage {TRAIN} same" in output
        assert "status: same" in output
    ran.write({"hoidata/datasets/grab/adapter.py": "SCALE = 2"})
    assert typed(CONTACT)[0] == 1


def test_only_the_first_word_names_a_sub_command_and_a_file_of_that_name_has_a_path(typed, ran):
    (ran.root / "check").mkdir()
    (ran.root / "check/model.safetensors").write_bytes((ran.root / WEIGHTS).read_bytes())
    assert f"stage {TRAIN}" in typed("./check")[1]
    assert " checked, " in typed("check")[1]


def test_json_has_its_schema_the_facts_and_the_whole_tree(typed):
    code, output = typed("--json", CONTACT, "--raw")
    values = json.loads(output)
    assert (code, values["schema"], values["status"]) == (0, "hoidata.lineage/2", "same")
    assert values["tree"]["children"][0]["name"] == TRAIN
    assert values["clips"] == {"train": ["grab/s1/mug_lift", "grab/s1/cup_pour"]}
    assert {path for path, _ in values["raw"][CLIPS]["files"]} >= {"grab/s1/mug_lift.npz", "tools/mug.ply"}


@pytest.mark.parametrize("target", [CONTACT, CLIPS, "metrics/embedded/grab/text2hoi.json"])
def test_mermaid_has_only_boxes_arrows_and_colours_and_every_arrow_joins_two_boxes(typed, target):
    head, *lines = typed(target, "--mermaid")[1].splitlines()
    boxes = {match[1] for line in lines if (match := BOX.fullmatch(line))}
    arrows = [match.groups() for line in lines if (match := ARROW.fullmatch(line))]
    assert head == "flowchart LR"
    assert len(lines) == 2 * len(boxes) + len(arrows)
    assert all(STYLE.fullmatch(line) for line in lines if "style" in line)
    assert {name for pair in arrows for name in pair} == boxes


def test_a_hostile_name_does_not_leave_its_box_in_mermaid_or_the_page(typed, ran):
    hostile = '"]; <script>alert(1).safetensors'
    (ran.root / hostile).write_bytes((ran.root / WEIGHTS).read_bytes())
    _, *lines = typed(hostile, "--mermaid")[1].splitlines()
    assert all(BOX.fullmatch(line) or ARROW.fullmatch(line) or STYLE.fullmatch(line) for line in lines)
    typed(hostile, "--page", "page.html")
    assert "<script" not in (ran.root / "page.html").read_text()


@pytest.mark.parametrize("target", [CONTACT, CLIPS, "metrics/embedded/grab/text2hoi.json"])
def test_prov_json_fits_its_schema_and_is_read_by_the_package_prov(typed, target):
    output = typed(target, "--prov")[1]
    schema = json.loads((Path(prov.__file__).parent / "tests/schemas/prov-json.schema.json").read_text())
    jsonschema.validators.validator_for(schema)(schema).validate(json.loads(output))
    document = ProvDocument.deserialize(content=output, format="json")
    names = {str(record.identifier) for record in document.get_records((ProvEntity, ProvActivity))}
    assert "hoi:file/data/embedded/grab/raw.json" in names
    assert "hoi:run/raw@embedded-grab" in names


def test_the_page_has_all_nodes_and_raw_files_and_loads_nothing(typed, ran):
    assert typed(CONTACT, "--page", "lineage.html")[0] == 0
    page = (ran.root / "lineage.html").read_text()
    for name in (TRAIN, "train.demo.contact", "hoidata/datasets/grab/adapter.py", "tools/mug.ply", "60 to 68"):
        assert name in page
    assert "<script" not in page
    assert not re.search(r"""(?:src|href)=["'](?!#)""", page)


def test_raw_lists_each_file_with_digest_licence_and_frames(typed):
    output = typed(CONTACT, "--raw")[1]
    assert "4 files, 2 clips, licence none: generated" in output
    assert re.search(r"^  [0-9a-f]{64}  grab/s1/mug_lift\.npz$", output, re.MULTILINE)
    assert "grab/s1/mug_lift  frames 60-68  grab/s1/mug_lift.npz tools/mug.ply" in output


def test_exit_codes_of_the_sub_commands(typed, ran):
    assert typed("diff", CONTACT, CONTACT) == (0, "no recorded cause differs\n")
    code, output = typed("diff", CONTACT, "checkpoints/embedded/grab/length")
    assert code == 1
    assert "clip grab/s2/mug_pass" in output or "raw file grab/s2/mug_pass.npz: only in the second" in output
    code, output = typed("uses", "s2", "--json")
    assert {use["kind"] for use in json.loads(output)} == {"store", "table", "checkpoint"}
    assert typed("check")[0] == 0
    (ran.root / CLIPS / "meta/info.json").write_text("{}")
    code, output = typed("check")
    assert code == 1
    assert f"data {CLIPS} tampered" in output


def test_a_digest_table_is_compared_with_the_outputs_here(typed, ran):
    table = ran.root / "made.json"
    assert typed("check", "--write", str(table))[0] == 0
    assert typed("check", "--against", str(table))[0] == 0
    values = json.loads(table.read_text())
    assert {CLIPS, "data/embedded/grab/raw.json"} <= values["outputs"].keys()
    assert WEIGHTS in values["networks"]
    assert not [name for name in values["outputs"] if not name.startswith("data/")]
    values["networks"][WEIGHTS] = "0" * 64
    table.write_text(json.dumps(values))
    assert typed("check", "--against", str(table))[0] == 1  # other weights, the same processor and libraries
    table.write_text(json.dumps({**values, "processor": "another one"}))
    code, output = typed("check", "--against", str(table))
    assert (code, "1 from another machine" in output, "processor another one there" in output) == (0, True, True)
    (ran.root / "data/embedded/grab/raw.json").write_text("{}")
    assert typed("check", "--against", str(table))[0] == 1


def test_facts_of_a_run_are_stored_outside_of_its_outputs_also_when_it_fails(tmp_path, monkeypatch):
    from pipelines.sidecar import RUNS, noted_run

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DVC_STAGE", "models/text2hoi/dvc.yaml:train@embedded-grab-contact")
    with noted_run("train@embedded-grab-contact"):
        pass
    facts = json.loads((tmp_path / RUNS / "models-text2hoi-dvc.yaml-train@embedded-grab-contact.json").read_text())
    assert facts["ended"] == "complete"
    assert {"began_at", "seconds", "processor_seconds", "peak_mib", "host", "device", "cores", "commit"} <= facts.keys()
    monkeypatch.delenv("DVC_STAGE")
    with pytest.raises(BadInput), noted_run("convert@embedded-grab"):
        raise BadInput("a", "b", "c")
    assert json.loads((tmp_path / RUNS / "convert@embedded-grab.json").read_text())["ended"] == "failed"
