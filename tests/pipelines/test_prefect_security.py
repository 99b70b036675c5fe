"""A web page or another user of this machine cannot run or read anything on the server of `hoidata up`."""

import base64
import http.client
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import psutil
import pytest

from hoidata.errors import BadInput, MissingResource
from pipelines.parallel_repro import CODE
from pipelines.prefect_hook import key_for
from pipelines.prefect_server import (
    KEY_FILE,
    api_url,
    is_loopback,
    read_key,
    stop_running,
    wait_until_healthy,
    write_key,
)
from tests.pipelines.prefect_up import hoidata_up, running_engine, wait_until

FOREIGN = "http://evil.example"
SOCKETS = (
    "events/in",
    "events/out",
    "logs/out",
    "task_runs/subscriptions/scheduled",
    "work_pools/local/workers/connect",
)
ENDED = {"COMPLETED", "FAILED", "CRASHED", "CANCELLED"}
pytestmark = [pytest.mark.first, pytest.mark.long]


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


def test_each_start_writes_a_key_that_only_the_owner_can_read(tmp_path):
    key_file = tmp_path / ".prefect" / "api-key"
    key_file.parent.mkdir(mode=0o755)
    key_file.write_text("an old key that others could read")
    keys = {write_key(key_file), write_key(key_file)}
    assert (mode(key_file), mode(key_file.parent)) == (0o600, 0o700)
    assert len(keys) == 2
    assert read_key(key_file) in keys
    assert min(map(len, keys)) >= 40
    assert [item.name for item in key_file.parent.iterdir()] == ["api-key"]


@pytest.mark.parametrize("wide", [0o640, 0o604, 0o620, 0o602])
def test_a_key_that_others_could_read_or_write_is_refused(tmp_path, wide):
    key_file = tmp_path / "api-key"
    write_key(key_file)
    key_file.chmod(wide)
    with pytest.raises(PermissionError, match="`hoidata up` writes a new one"):
        read_key(key_file)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can try as another user")
def test_another_user_cannot_read_the_key():
    with tempfile.TemporaryDirectory() as name:
        project, nobody = Path(name), 65534
        project.chmod(0o755)
        (project / "open").touch()
        key_file = project / ".prefect" / "api-key"
        write_key(key_file)
        assert subprocess.run(["cat", project / "open"], user=nobody).returncode == 0
        assert subprocess.run(["cat", key_file], user=nobody, capture_output=True).returncode != 0


@pytest.mark.parametrize(
    "url",
    [
        "http://0.0.0.0:4200/api",
        "http://[::]:4200/api",
        "http://192.168.1.5:4200/api",
        "http://localhost:4200/api",
        "http://127.0.0.1.evil.example:4200/api",
        "http://127.0.0.1:4200@evil.example/api",
        "https://127.0.0.1:4200/api",
        "http://127.0.0.1:99999/api",
        "http://127.0.0.1/api",
        "http://127.0.0.1:4200",
    ],
)
def test_a_server_is_only_started_on_a_loopback_address(url, monkeypatch):
    monkeypatch.setenv("PREFECT_API_URL", url)
    with pytest.raises(BadInput, match="PREFECT_API_URL: expected a loopback address"):
        api_url()


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "[::1]"])
def test_loopback_addresses_are_accepted(host, monkeypatch):
    monkeypatch.setenv("PREFECT_API_URL", f"http://{host}:4321/api/")
    assert api_url() == f"http://{host}:4321/api"
    assert is_loopback(api_url())


def test_the_key_is_not_sent_to_other_machines_and_does_not_replace_the_users_key(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PREFECT_API_AUTH_STRING", raising=False)
    here = "http://127.0.0.1:4200/api"
    assert key_for(here) is None
    key = write_key()
    assert key_for(here).env == {"PREFECT_API_AUTH_STRING": key}
    assert key_for("https://api.prefect.cloud/api") is None
    assert key_for(None) is None
    monkeypatch.setenv("PREFECT_API_AUTH_STRING", "mine:own")
    assert key_for(here) is None


def test_hoidata_down_stops_the_process_with_the_folders_key_or_reports_that_none_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert not stop_running()
    holding = "import time; from hoidata.files.atomic import exclusive\n"
    holding += f"with exclusive({str(KEY_FILE)!r}): time.sleep(60)"
    up = subprocess.Popen([sys.executable, "-c", holding])
    lock = KEY_FILE.parent / f".{KEY_FILE.name}.lock"
    while not lock.is_file() or not lock.read_text():
        time.sleep(0.05)
    assert stop_running()
    assert up.wait(5) == -signal.SIGTERM


@pytest.mark.parametrize("left", ["the number of one that has ended", "nothing"])
def test_hoidata_down_succeeds_if_the_process_ends_at_that_moment(tmp_path, monkeypatch, left):
    monkeypatch.chdir(tmp_path)
    gone = subprocess.Popen(["true"])
    gone.wait()
    lock = KEY_FILE.parent / f".{KEY_FILE.name}.lock"
    lock.parent.mkdir()
    if left != "nothing":
        lock.write_text(str(gone.pid))
    monkeypatch.setattr("pipelines.prefect_server.exclusive", held_once())
    assert stop_running()


def held_once():
    """A fake of ``exclusive``: the lock is taken at the first call and free at the second."""
    answers = iter([BadInput("key", "nobody", "somebody", "wait"), None])

    @contextmanager
    def asked(*_, **__):
        if (answer := next(answers)) is not None:
            raise answer
        yield 0

    return asked


def test_another_process_at_the_port_is_not_accepted_as_our_server(monkeypatch):
    """It would receive the key and control the flows."""
    monkeypatch.setattr("pipelines.prefect_server.START_TIMEOUT_S", 2)
    ours = subprocess.Popen(["sleep", "60"])
    try:
        with served(b"true") as (url, _), pytest.raises(MissingResource, match="did not answer"):
            wait_until_healthy(f"{url}api", ours)
    finally:
        ours.kill()
        ours.wait()


@pytest.fixture(scope="module")
def up(tmp_path_factory, project_tools):
    """The running server in a copy of the project."""
    folder = tmp_path_factory.mktemp("security")
    project = project_tools.copy_project(folder / "project")
    project_tools.make_narrow(
        project, ["arctic", "manipnet"], ["mean-pose"]
    )  # few deployments, which are registered faster
    with hoidata_up(project, project_tools) as running:
        running.marker = folder / "command-ran"
        running.key = read_key(project / ".prefect" / "api-key")
        deployments = json.loads(with_key(running, "POST", "/deployments/filter", "{}").body)
        [running.deployment] = [
            deployment["id"] for deployment in deployments if deployment["name"] == "annotate-arctic"
        ]
        running.attack = json.dumps({"job_variables": {"command": f"touch {running.marker}"}})
        yield running


def ask(up, method: str, path: str, body: str | None = None, **headers: str) -> SimpleNamespace:
    """Send a request to the API, with the key only if it is in ``headers``; "_" in a header's name means "-"."""
    connection = http.client.HTTPConnection(urlsplit(up.url).netloc, timeout=30)
    connection.request(method, f"/api{path}", body, {name.replace("_", "-"): text for name, text in headers.items()})
    with connection.getresponse() as response:
        answer = SimpleNamespace(status=response.status, body=response.read().decode(), headers=response.headers)
    connection.close()
    return answer


def basic(key: str) -> dict[str, str]:
    return {"Authorization": "Basic " + base64.b64encode(key.encode()).decode()}


def csrf(up) -> dict[str, str]:
    """A CSRF token, which the server gives only with the key."""
    token = json.loads(ask(up, "GET", "/csrf-token?client=tests", **basic(up.key)).body)["token"]
    return {"Prefect_Csrf_Token": token, "Prefect_Csrf_Client": "tests"}


def with_key(up, method: str, path: str, body: str | None = None) -> SimpleNamespace:
    """Send a request as Prefect's client does."""
    return ask(up, method, path, body, **basic(up.key), **csrf(up), Content_Type="application/json")


def assert_nothing_came_of_it(up) -> None:
    """Check that the server has only the given runs, and that no command of an attacker has run."""
    assert json.loads(with_key(up, "POST", "/flow_runs/filter", "{}").body) == []
    assert not up.marker.exists()


def attack_path(up) -> str:
    return f"/deployments/{up.deployment}/create_flow_run"


@pytest.mark.parametrize("kind", ["application/json", "text/plain", "application/x-www-form-urlencoded", None])
def test_requests_that_a_page_can_send_from_a_browser_are_refused(up, kind):
    headers = {"Origin": FOREIGN, **({"Content_Type": kind} if kind else {})}
    refused = ask(up, "POST", attack_path(up), up.attack, **headers)
    assert refused.status in (401, 403)
    assert "Access-Control-Allow-Origin" not in refused.headers
    assert_nothing_came_of_it(up)


@pytest.mark.parametrize("origin", [FOREIGN, "null", "http://127.0.0.1:9", "http://localhost:4200"])
def test_preflight_grants_no_other_origin(up, origin):
    headers = {"Access_Control_Request_Method": "POST", "Access_Control_Request_Headers": "authorization,content-type"}
    refused = ask(up, "OPTIONS", attack_path(up), Origin=origin, **headers)
    assert refused.status == 400
    assert "Access-Control-Allow-Origin" not in refused.headers


@pytest.mark.parametrize("host", ["evil.example", "evil.example/api/health", "localhost"])
def test_a_rebound_name_gets_nothing_without_the_key(up, host):
    assert ask(up, "GET", "/csrf-token?client=page", Host=host).status == 401
    assert ask(up, "POST", attack_path(up), up.attack, Host=host, Content_Type="application/json").status == 403
    assert_nothing_came_of_it(up)


@pytest.mark.parametrize("key", [None, "hoidata:guess", ""])
def test_only_the_health_check_answers_without_the_key(up, key):
    """All paths and methods of the API, with a valid CSRF token, so that only the key is missing."""
    paths = json.loads(with_key(up, "GET", "/openapi.json").body)["paths"]
    wrong = csrf(up) | (basic(key) if key is not None else {})
    calls = [(method.upper(), path) for path, methods in paths.items() for method in methods]
    assert len(calls) > 150
    answered = {path for method, path in calls if ask(up, method, path, "{}", **wrong).status != 401}
    assert answered == {"/health", "/ready"}


@pytest.mark.parametrize("path", SOCKETS)
@pytest.mark.parametrize("hello", ["auth with a guess", "no auth", "no subprotocol"])
def test_sockets_close_without_the_key(up, path, hello):
    from websockets.exceptions import ConnectionClosed, InvalidStatus
    from websockets.sync.client import connect

    protocols = None if hello == "no subprotocol" else ["prefect"]
    words = {"type": "auth", "token": "guess"} if hello == "auth with a guess" else {"type": "hello"}
    url = up.url.replace("http:", "ws:")

    def hear() -> str | bytes:
        with connect(f"{url}/{path}", origin=FOREIGN, subprotocols=protocols) as socket:
            socket.send(json.dumps(words))
            return socket.recv(timeout=10)

    with pytest.raises((ConnectionClosed, InvalidStatus)):
        hear()


def test_files_of_the_server_are_readable_by_the_owner_only(up):
    state = up.project / ".prefect"
    assert mode(state) == 0o700
    assert {mode(item) for item in state.iterdir() if item.is_file() and not item.name.startswith(".")} == {0o600}
    assert up.key not in up.log.read_text()
    assert ".prefect/api-key" in up.log.read_text()


@pytest.mark.parametrize("scheme", ["http", "file"])
def test_a_hostile_page_in_chromium_runs_nothing_and_reads_nothing(up, scheme, tmp_path):
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no chromium on PATH: the page was not opened")
    page = tmp_path / "page.html"
    with served(b"") as (report, posted):
        page.write_bytes(hostile_page(up, report))
        with served(page.read_bytes()) as (site, _):
            address = site if scheme == "http" else page.as_uri()
            results = report_of(chromium, address, tmp_path, posted)
    assert results.pop("server reached") == "opaque"
    assert set(results.values()) <= {"blocked", "opaque", "closed", "form sent"}, results
    assert_nothing_came_of_it(up)


def hostile_page(up, report: str) -> bytes:
    """A page that tries all requests from a browser to the API, and sends the results to the address ``report``.

    It has the API's address and the deployment, but not the key.
    """
    values = {"API": up.url, "DEPLOYMENT": up.deployment, "ATTACK": up.attack, "SOCKETS": SOCKETS, "REPORT": report}
    constants = "".join(f"const {name} = {json.dumps(value)};" for name, value in values.items())
    return Path(__file__).with_name("hostile_page.html").read_text().replace("/* given */", constants).encode()


@contextmanager
def served(page: bytes):
    """A web server that answers each GET with ``page``; returns its address and the list of received POST bodies."""
    posted = queue.Queue()

    class Site(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(page)

        def do_POST(self):
            posted.put(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Site)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/", posted
    finally:
        server.shutdown()
        server.server_close()


def report_of(chromium: str, url: str, folder: Path, posted: queue.Queue) -> dict[str, str]:
    """The POST body of the page at ``url`` in headless Chromium, with its protection of local networks disabled."""
    switches = [
        "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run",
        "--disable-features=LocalNetworkAccessChecks", f"--user-data-dir={folder / 'profile'}",
    ]  # fmt: skip
    process = subprocess.Popen([chromium, *switches, url], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        return json.loads(posted.get(timeout=60))
    finally:
        process.terminate()
        process.wait(30)


def test_a_deployment_started_in_the_folder_runs_and_is_the_only_run(up, project_tools):
    """It runs after the tests above, so that any run they started would have had time to appear.

    ``prefect deployment run annotate-arctic`` updates DVC's target annotate@embedded-arctic.
    """
    result = project_tools.run(up.project, "prefect", "deployment", "run", "annotate-arctic", **up.settings)
    assert result.returncode == 0, result.stdout + result.stderr
    [run] = ended_runs(up)
    assert (run["state_type"], run["job_variables"] or {}) == ("COMPLETED", {}), up.log.read_text()
    assert (up.project / "data/embedded/arctic/annotation/text.parquet").is_file()
    assert not (up.project / "checkpoints").exists()
    assert not up.marker.exists()
    tasks = {run["name"] for run in json.loads(with_key(up, "POST", "/task_runs/filter", "{}").body)}
    assert {CODE, "convert@embedded-arctic", "annotate@embedded-arctic"} <= tasks
    artifacts = {artifact["key"] for artifact in json.loads(with_key(up, "POST", "/artifacts/filter", "{}").body)}
    assert artifacts == {"stages", "results"}


def ended_runs(up) -> list[dict]:
    """Wait until all runs have ended, and return them."""
    runs = lambda: json.loads(with_key(up, "POST", "/flow_runs/filter", "{}").body)  # noqa: E731
    wait_until(lambda: all(run["state_type"] in ENDED for run in runs()), 900, up.process, up.log)
    return runs()


def test_a_run_cannot_set_command_environment_or_folder_even_with_the_key(up):
    """A worker of a work pool would obey these fields; the process that serves the flows ignores them."""
    harm = f"touch {up.marker}"
    names = ("command", "working_dir", "image", "entrypoint", "stream_output")
    variables = {**dict.fromkeys(names, harm), "env": {"PATH": "/nowhere", "PREFECT__FLOW_ENTRYPOINT": harm}}
    response = with_key(up, "POST", attack_path(up), json.dumps({"job_variables": variables}))
    assert response.status == 201, response.body
    [run] = [run for run in ended_runs(up) if run["job_variables"]]
    assert (run["id"], run["state_type"]) == (json.loads(response.body)["id"], "COMPLETED"), up.log.read_text()
    assert not up.marker.exists()


def test_the_flow_and_what_started_it_end_with_the_server(up, project_tools):
    """The last test. Otherwise the next server at the port could control them."""
    engine = running_engine(up.project, project_tools, up)
    children = {child.cmdline()[2]: child for child in psutil.Process(up.process.pid).children()}
    children["prefect"].kill()
    _, alive = psutil.wait_procs([children["pipelines.flows"], engine], 5)
    assert not alive, alive
    assert up.process.wait(60) != 0
