"""Stores sent to an object store and fetched again, against a server of S3's protocol that the test starts."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from hoidata.errors import BadInput, MissingResource
from hoidata.files.digest import sha256_file
from hoidata.store.info import generated_info
from hoidata.store.remote import pull_store, push_store
from hoidata.store.store import open_store, write_store
from pipelines.cli import app
from tests.builders.clips import build_clip

fsspec = pytest.importorskip("fsspec")
pytestmark = pytest.mark.filterwarnings("ignore")  # of the client's and the server's own libraries


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("store") / "clips"
    write_store(folder, [build_clip(clip_id=f"test/s1/{name}") for name in ("a", "b")], generated_info("test"))
    return folder


def digests(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): sha256_file(path) for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def server():
    """The endpoint of a server that starts here and ends with the module."""
    pytest.importorskip("s3fs")
    moto = pytest.importorskip("moto.server")
    started = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    started.start()
    host, port = started.get_host_and_port()
    yield f"http://{host}:{port}"
    started.stop()


@pytest.fixture
def bucket(server, monkeypatch):
    """s3://corpora on that server, reached as a user would: by environment variables."""
    for name, value in {
        "AWS_ENDPOINT_URL": server,
        "AWS_ACCESS_KEY_ID": "a",
        "AWS_SECRET_ACCESS_KEY": "b",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
    }.items():
        monkeypatch.setenv(name, value)
    system = fsspec.filesystem("s3", skip_instance_cache=True)
    if not system.exists("corpora"):
        system.mkdir("corpora")
    return "s3://corpora"


@pytest.mark.slow
def test_a_store_comes_back_from_an_object_store_byte_for_byte_and_can_be_read(store, bucket, tmp_path):
    sent = CliRunner().invoke(app, ["push", str(store), f"{bucket}/grab"])
    assert sent.exit_code == 0, sent.output
    fetched = CliRunner().invoke(app, ["pull", f"{bucket}/grab", str(tmp_path / "again")])
    assert fetched.exit_code == 0, fetched.output
    assert digests(tmp_path / "again") == digests(store)
    assert open_store(tmp_path / "again").clip("test/s1/a").clip_id == "test/s1/a"
    push_store(store, f"{bucket}/grab")  # a second time over the first
    system = fsspec.filesystem("s3", skip_instance_cache=True)
    name = "corpora/grab/meta/objects.parquet"
    data = system.cat_file(name)
    system.pipe_file(name, data[:50] + bytes([data[50] ^ 1]) + data[51:])
    before = digests(tmp_path / "again")
    with pytest.raises(BadInput, match=r"objects\.parquet: expected SHA-256"):
        pull_store(f"{bucket}/grab", tmp_path / "again")
    assert digests(tmp_path / "again") == before
    with pytest.raises(BadInput, match="a place that can be reached"):
        push_store(store, "s3://no-such-bucket-here/grab")


def test_a_store_on_another_disk_is_sent_and_fetched_too_and_half_of_one_is_none(store, tmp_path):
    push_store(store, str(tmp_path / "there"))
    pull_store(str(tmp_path / "there"), tmp_path / "again")
    assert digests(tmp_path / "again") == digests(store)
    (tmp_path / "there/digests.json").unlink()
    with pytest.raises(MissingResource, match="being sent"):
        pull_store(str(tmp_path / "there"), tmp_path / "again")
    with pytest.raises(MissingResource, match="no store"):
        push_store(tmp_path, str(tmp_path / "elsewhere"))
    with pytest.raises(BadInput, match="an address fsspec knows"):
        pull_store("nothing://there", tmp_path / "again")


def test_an_address_cannot_name_files_outside_of_the_store(store, tmp_path):
    push_store(store, str(tmp_path / "there"))
    listing = tmp_path / "there/digests.json"
    listing.write_text(listing.read_text().replace("meta/files.parquet", "../../files.parquet"))
    with pytest.raises(BadInput, match="files inside the store"):
        pull_store(str(tmp_path / "there"), tmp_path / "again")
