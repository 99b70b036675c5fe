"""Commands outside of a project, and `hoidata init`."""

import filecmp
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hoidata.errors import BadInput, MissingResource
from pipelines.cli import app
from pipelines.lineage.graph import written_graph
from pipelines.params import read_params
from pipelines.stages.base import jobs
from pipelines.validation import problems_of

PROJECT = Path(__file__).parents[2]
LOADED = "import sys; before = set(sys.modules); {}; print(*sorted(set(sys.modules) - before))"
HEAVY = {"torch", "numpy", "pandas", "scipy", "dvc", "prefect", "trimesh", "jinja2", "numba"}


def typed(*words: object) -> str:
    return CliRunner().invoke(app, list(map(str, words)), catch_exceptions=False).output


def loaded(code: str) -> set[str]:
    done = subprocess.run([sys.executable, "-c", LOADED.format(code)], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_hoidata_loads_nothing_else():
    assert loaded("import hoidata") == {"hoidata"}


def test_help_does_not_import_the_libraries_of_the_commands():
    assert not HEAVY & loaded("import pipelines.cli")


def test_init_writes_the_graph_with_the_stage_command_of_the_installation(tmp_path):
    assert "new project" in typed("init", tmp_path / "mine")
    assert list(written_graph(tmp_path / "mine")) == list(written_graph(PROJECT))
    assert read_params(tmp_path / "mine")["profile"] == "embedded"
    commands = "".join(path.read_text() for path in (tmp_path / "mine").rglob("dvc.yaml"))
    assert "python -m hoidata stage convert" in commands
    assert "pipelines.stages" not in commands
    assert "analytics = false" in (tmp_path / "mine/.dvc/config").read_text()


def test_init_refuses_an_existing_project_and_appends_to_gitignore(tmp_path):
    (tmp_path / ".gitignore").write_text("mine\n")
    typed("init", tmp_path)
    assert (tmp_path / ".gitignore").read_text() == f"mine\n{(PROJECT / '.gitignore').read_text()}"
    with pytest.raises(BadInput, match=r"a folder without a project, got params\.yaml"):
        typed("init", tmp_path)


@pytest.mark.slow
def test_convert_gives_the_same_bytes_as_the_stage(tmp_path, monkeypatch, small_corpus):
    monkeypatch.chdir(tmp_path)
    corpus = small_corpus("grab")
    words = ("convert", "grab", "--root", corpus.raw, "--out", "store", "--synthetic", "--jobs", 1)
    assert str(tmp_path / "store") in typed(*words)
    files = [path.relative_to(corpus.clips) for path in corpus.clips.rglob("*") if path.is_file()]
    assert filecmp.cmpfiles(corpus.clips, "store", files, shallow=False)[1:] == ([], [])
    with pytest.raises(BadInput, match="a path that does not exist"):
        typed(*words)


def test_a_file_that_no_stage_wrote_is_not_called_sound(tmp_path):
    (tmp_path / "junk.npz").write_text("garbage")
    with pytest.raises(MissingResource, match="is not a store, checkpoint or output of a stage"):
        problems_of(tmp_path / "junk.npz")


@pytest.mark.parametrize(("text", "count"), [("3", 3), ("abc", None), ("-1", None), ("1.5", None)])
def test_the_number_of_processes_is_a_number(monkeypatch, text, count):
    monkeypatch.setenv("HOIDATA_JOBS", text)
    if count is None:
        with pytest.raises(BadInput, match="HOIDATA_JOBS: expected a number of processes"):
            jobs()
    else:
        assert jobs() == count


def test_convert_requires_the_hand_model_that_real_files_need(tmp_path, monkeypatch, small_corpus):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HOIDATA_MANO", raising=False)
    with pytest.raises(MissingResource, match="--hand FOLDER"):
        typed("convert", "grab", "--root", small_corpus("grab").raw, "--out", tmp_path / "store")


def test_show_writes_a_page_of_a_clip_in_a_store_and_lists_the_clips_for_an_unknown_id(
    tmp_path, monkeypatch, small_corpus
):
    monkeypatch.chdir(tmp_path)
    store = small_corpus("grab").clips
    with pytest.raises(BadInput, match="name one, such as grab/") as error:
        typed("show", "--data", store)
    clip_id = str(error.value).rpartition(" ")[2]
    page = Path(typed("show", clip_id, "--data", store, "--out", "pages").strip())
    assert clip_id in page.read_text()
    assert "SYNTHETIC" in page.read_text()
    with pytest.raises(BadInput, match="closest"):
        typed("show", "grab/s99/mug_drink_1", "--data", store)
    with pytest.raises(BadInput, match=r"a clip's id, a dataset's name, or \(without --figures\) --data FOLDER"):
        typed("show")
