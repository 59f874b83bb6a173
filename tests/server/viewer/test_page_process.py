"""The page as a process: its address, its token, access by clients that send headers no browser would, restarts."""

import asyncio
import os
import random
import re
import shlex
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import msgpack
import msgspec
import pytest
import viser
from helpers.browser import browser, eventually, shown, why_none
from helpers.called import called
from helpers.fuzzing import mutated
from helpers.pages import CAMERA, is_served, step_until
from helpers.processes import COMMAND, find_child, has_exited, read_memory
from helpers.programs import Program
from helpers.shortages import refuse_threads
from helpers.waits import ends_within
from viser._messages import GuiUpdateMessage
from viser.infra._async_message_buffer import AsyncMessageBuffer
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

import softfinger.server.viewer.page  # noqa: F401 - it mends viser
from softfinger.config.errors import ConfigError
from softfinger.server.gateway.addresses import Addresses
from softfinger.server.viewer.door import process as of_page
from softfinger.server.viewer.door.access import Access
from softfinger.server.viewer.door.process import RESTARTS, PageProcess
from softfinger.server.viewer.live import LivePage
from softfinger.server.viewer.page import Page

pytestmark = pytest.mark.real_time

WAIT_S = 280.0
"""Limit of a test that hangs, below the five minutes after which tests/run.py ends all tests."""


def find_page(process: subprocess.Popen[str]) -> int:
    """Wait for the page's process."""
    return find_child(process.pid, b"\0view\0")


@contextmanager
def run_with_page(*more: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    ends = ["--endpoint", "tcp://127.0.0.1:*", "--commands", "tcp://127.0.0.1:*"]
    command = [*COMMAND, "run", "--realtime", "off", *ends, "--view", *more]
    with Program(command, stderr=subprocess.PIPE, text=True, process_group=0) as process:
        timer = threading.Timer(WAIT_S, os.killpg, (process.pid, signal.SIGKILL))
        timer.start()
        try:
            first = next(line for line in process.stderr if "compiling kernel" not in line)
            assert first.endswith("the page; to stop it: Ctrl-C\n")
            address = next(process.stderr)
            assert address.startswith("http://localhost:")
            yield process, address.rstrip()
        finally:
            timer.cancel()
            process.kill()


def test_a_page_that_ends_is_restarted_at_the_same_address() -> None:
    with run_with_page() as (process, address):
        page = find_page(process)
        assert urlsplit(address).path.strip("/") not in Path(f"/proc/{page}/cmdline").read_text()
        os.kill(page, signal.SIGKILL)
        ended = next(line for line in process.stderr if "the page has ended" in line)
        assert f"exit code -9; the servo continues; restart 1 of {RESTARTS}" in ended
        assert eventually(lambda: is_served(address)) and process.poll() is None
        pid = find_page(process)
        process.kill()
        assert eventually(lambda: has_exited(pid))


@pytest.fixture
def start_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], tuple[PageProcess, list[str]]]:
    """Return a function that starts a shell script instead of a page; it returns the process and its reports."""

    def start(script: str) -> tuple[PageProcess, list[str]]:
        program, reports = tmp_path / "python", list[str]()
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(program))
        return PageProcess(f"ipc://{tmp_path}/t", f"ipc://{tmp_path}/c", [], reports.append), reports

    return start


def test_a_page_that_hangs_at_start_is_killed(start_page: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(of_page, "START_TIMEOUT_S", 0.2)
    page, reports = start_page("exec sleep 600")
    page.supervise()
    page.close()
    assert len(reports) == 1 and "the page has ended, with exit code -9" in reports[0]


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # the pipe of each crashed page, until collected
@pytest.mark.parametrize("has_threads", [True, False])
def test_a_page_that_crashes_repeatedly_restarts_three_times(has_threads: bool, start_page: Any, monkeypatch) -> None:
    page, reports = start_page("echo http://localhost:1/secret/\nexit 3")
    if not has_threads:
        refuse_threads(monkeypatch)
    assert eventually(lambda: page.supervise() or len(reports) > RESTARTS)
    page.supervise()
    page.close()
    last = r"with exit code 3; .*; (?:restart (\d) of 3|to see it again: .*view)"
    numbers = [re.search(last, text) for text in reports]
    assert [number and number[1] for number in numbers] == ["1", "2", "3", None]


def test_a_stopped_page_ends_with_the_daemon(start_page: Any) -> None:
    page, _ = start_page("echo http://localhost:1/secret/\nexec sleep 600")
    os.kill(page._process.pid, signal.SIGSTOP)
    page.close()
    assert page._process.returncode == -signal.SIGTERM


def test_a_browser_that_does_not_read_does_not_delay_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    page, read = Page("127.0.0.1", 0), threading.Event()
    stop = page.server.stop
    monkeypatch.setattr(page.server, "stop", lambda: read.wait() and stop())  # as viser waits for a browser
    with ends_within(60):
        page.close()
    read.set()


BROWSER = """#!/bin/sh
printf '%s\\n' "$@" > "{seen}/words.new"
mv "{seen}/words.new" "{seen}/words"
"""


def test_a_browser_opens_the_page_through_a_private_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "browser"
    program.write_text(BROWSER.format(seen=tmp_path))
    program.chmod(0o755)
    monkeypatch.setenv("BROWSER", f"{shlex.quote(str(program))} %s")
    monkeypatch.setenv("DISPLAY", ":0")
    command = [*COMMAND, "view", "tap", "--port", "8320"]
    with Program([*command, "--print-address"], stdout=subprocess.PIPE, text=True, kill_at_end=True) as process:
        address = process.stdout.readline().strip()
        while not (tmp_path / "words").exists():
            assert process.poll() is None
            time.sleep(0.01)
        (word,) = (tmp_path / "words").read_text().splitlines()
        file = Path(url2pathname(urlsplit(word).path))
        assert urlsplit(address).path.strip("/") not in word
        assert stat.S_IMODE(file.stat().st_mode) == 0o600 and stat.S_IMODE(file.parent.stat().st_mode) == 0o700
        assert address in file.read_text()
        process.send_signal(signal.SIGINT)
        process.wait()
        assert not file.exists()


@pytest.mark.system
@pytest.mark.skipif(bool(why_none()), reason=why_none())
def test_an_open_browser_reconnects_to_a_restarted_page() -> None:
    with run_with_page() as (process, address), browser() as page:
        threading.Thread(target=process.communicate, daemon=True).start()  # reads stderr, so that it does not block
        screen = shown(page, address)

        def tick() -> int:
            match = re.search(r"tick (\d+)", screen.page.inner_text("body"))
            return int(match[1]) if match else -1

        assert eventually(lambda: tick() > 0)
        os.kill(find_page(process), signal.SIGKILL)
        before = tick()
        assert eventually(lambda: tick() > before + 2000)  # two seconds in real time


PAGE = """
import sys
from softfinger.server.viewer.page import Page
page = Page("127.0.0.1", 0)
page.add_views()
print(page.address, flush=True)
sys.stdin.readline()
page.close()
"""
SAID: list[dict[str, Any]] = [
    CAMERA,
    {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 1.0}},
    {"type": "ScenePointerMessage", "event_type": "click", "ray_origin": [0, 0, 1], "ray_direction": [0, 0, -1],
     "screen_pos": [[0.5, 0.5]]},
    {"type": "TransformControlsUpdateMessage", "name": "/a", "wxyz": [1, 0, 0, 0], "position": [0, 0, 0]},
    {"type": "ShareUrlDisconnect"},
]  # fmt: skip
"""Messages that viser's browser client sends."""
GROWTH_MAX_KB = 200_000
"""A Python process grows by some tens of MB in its first seconds; corrupted messages may not add memory."""


def talk(address: str, messages: list[bytes]) -> None:
    where = urlsplit(address)
    with connect(
        f"ws://{where.netloc}{where.path}", origin=Origin(f"http://{where.netloc}"), compression=None, max_queue=None,
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], max_size=None,
    ) as client:  # fmt: skip
        client.recv(timeout=60.0)
        try:
            for message in messages:
                client.send(message)
        except ConnectionClosed:
            return  # the page may close the connection


def test_a_browser_that_connects_while_a_message_is_queued_ends_nothing() -> None:
    """viser wakes browsers in one thread while another adds one: the message is queued and the event is set."""
    loop = asyncio.new_event_loop()
    buffer = AsyncMessageBuffer(loop, persistent_messages=True)
    waiters: Any = buffer.message_event._waiters

    class Connecting:
        def done(self) -> bool:
            waiters.append(self)
            return True

    waiters.append(Connecting())
    message = GuiUpdateMessage("a", {"value": 1.0})
    buffer.push(message)
    assert list(buffer.message_from_id.values()) == [message] and buffer.message_event.is_set()
    loop.call_soon(loop.stop)
    loop.run_forever()
    loop.close()


@pytest.mark.parametrize("seconds", [0.8, pytest.param(15.0, marks=pytest.mark.exhaustive)])
def test_corrupted_messages_do_not_harm_the_page(seconds: float, tmp_path: Path) -> None:
    seeds = [msgpack.packb(message) for message in SAID]
    chance = random.Random(25 if seconds < 5.0 else None)
    log = tmp_path / "said"
    with log.open("wb") as stderr, Program(
        [sys.executable, "-c", PAGE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, text=True
    ) as page:  # fmt: skip
        address = page.stdout.readline().strip()
        try:
            talk(address, seeds)
            before, until = read_memory(page.pid), time.monotonic() + seconds
            while time.monotonic() < until:
                talk(address, [seeds[0], *(mutated(seeds, chance) for _ in range(8))])
            assert page.poll() is None and read_memory(page.pid) - before < 1024 * GROWTH_MAX_KB
            assert is_served(address)
        finally:
            page.communicate("\n", timeout=60.0)
    assert page.returncode == 0
    assert "Traceback" not in log.read_text("utf-8"), log.read_text("utf-8")[-3000:]


ATTACK = """async (address) => {
    const socket = new WebSocket(address.replace("http:", "ws:"), ["viser-vVERSION"]);
    return await new Promise((done) => {
        socket.onopen = () => done("open");
        socket.onerror = () => done("refused");
    });
}"""
EVIL = "https://evil.example"


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with closing(Page("127.0.0.1", 8370, ("rig.lab", "tunnel.lab:9000"))) as page:
        yield page


class Elsewhere(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Suppress the log."""


def get_host(page: Page) -> str:
    return urlsplit(page.address).netloc


def get_path(page: Page) -> str:
    return urlsplit(page.address).path


def get_page(page: Page, where: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    with closing(HTTPConnection("127.0.0.1", page.server.get_port(), timeout=60.0)) as connection:
        connection.request("GET", where, headers={"Host": get_host(page)} | headers)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()


@contextmanager
def opened(page: Page, where: str, origin: str | None, host: str | None = None) -> Iterator[ClientConnection]:
    protocol, sent_origin = Subprotocol(f"viser-v{viser.__version__}"), None if origin is None else Origin(origin)
    address, unbuffered = f"ws://{host or get_host(page)}{where}", {"compression": None, "max_queue": None}
    with (
        socket.create_connection(("127.0.0.1", page.server.get_port()), timeout=60.0) as sock,
        connect(address, sock=sock, origin=sent_origin, subprotocols=[protocol], **unbuffered) as client,
    ):
        client.recv(timeout=60.0)
        yield client


def try_upgrade(page: Page, where: str, origin: str | None, host: str | None = None) -> int:
    try:
        with opened(page, where, origin, host):
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def test_the_page_is_served_only_at_its_address(page: Page) -> None:
    status, headers, body = get_page(page, get_path(page))
    assert status == 200 and b"<title>softfinger</title>" in body
    assert headers["X-Frame-Options"] == "DENY" and "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert headers["Referrer-Policy"] == "no-referrer"
    assert get_page(page, get_path(page), **{"Accept-Encoding": "gzip"})[0] == 200


@pytest.mark.parametrize("where", ["/", "/index.html", "/wrong-token/", "http://evil.example/", "/%2e%2e/", "*"])
def test_without_the_token_nothing_is_served(page: Page, where: str) -> None:
    status, headers, body = get_page(page, where)
    assert status == 403 and b"token" in body and b"softfinger view" in body and headers["X-Frame-Options"] == "DENY"
    if where.startswith("/"):
        assert try_upgrade(page, where, f"http://{get_host(page)}") == 403


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8370", "localhost", "localhost:1", "rig.lab:1", ""])
def test_another_host_is_refused(page: Page, host: str) -> None:
    """A web site can point its host name at this machine's address."""
    assert get_page(page, get_path(page), Host=host)[0] == 403
    if host:
        assert try_upgrade(page, get_path(page), f"http://{host}", host) == 403


@pytest.mark.parametrize("second", ["evil.example", "localhost", ""])
@pytest.mark.parametrize("first", [True, False])
def test_a_request_for_two_hosts_is_refused(page: Page, second: str, first: bool) -> None:
    """Servers differ in the header they use, so two are refused in either order, even if both name the page."""
    hosts = [get_host(page), second or get_host(page)]
    with closing(HTTPConnection("127.0.0.1", page.server.get_port(), timeout=60.0)) as connection:
        connection.putrequest("GET", get_path(page), skip_host=True)
        for host in hosts if first else reversed(hosts):
            connection.putheader("Host", host)
        connection.endheaders()
        assert connection.getresponse().status in (400, 403)


@pytest.mark.parametrize("origin", [EVIL, "null", None, "", "http://localhost", "http://localhost:1"])
def test_a_websocket_from_elsewhere_is_refused(page: Page, origin: str | None) -> None:
    assert try_upgrade(page, get_path(page), origin) == 403


def test_a_request_of_another_origin_is_refused(page: Page) -> None:
    """Browsers send the header Origin for other sites."""
    assert get_page(page, get_path(page), Origin=EVIL)[0] == get_page(page, get_path(page), Origin="null")[0] == 403


def test_the_page_and_allowed_hosts_have_access(page: Page) -> None:
    port = page.server.get_port()
    for host in (get_host(page), f"127.0.0.1:{port}", f"rig.lab:{port}", "tunnel.lab:9000"):
        assert try_upgrade(page, get_path(page).rstrip("/"), f"http://{host}", host) == 101
        assert get_page(page, get_path(page), Host=host)[0] == 200


@pytest.mark.system
@pytest.mark.skipif(bool(why_none()), reason=why_none())
def test_another_site_cannot_reach_the_page_in_a_browser(page: Page) -> None:
    attack = ATTACK.replace("VERSION", viser.__version__)
    with HTTPServer(("127.0.0.1", 0), Elsewhere) as other_site, browser() as tab:
        thread = threading.Thread(target=other_site.serve_forever)
        thread.start()
        try:
            shown(tab, page.address)
            assert tab.title() == "softfinger" and tab.evaluate(attack, page.address) == "open"
            tab.goto(f"http://localhost:{other_site.server_port}/")
            assert tab.evaluate(attack, page.address) == "refused"
            tab.set_content(f'<iframe src="{page.address}"></iframe>')
            tab.wait_for_load_state("load")
            assert [frame.url for frame in tab.frames[1:]] == ["chrome-error://chromewebdata/"]
        finally:
            other_site.shutdown()
            thread.join()


def test_each_page_has_its_own_token() -> None:
    assert Access("::1").address(80).startswith("http://[::1]:80/")
    assert Access("0.0.0.0", ("rig.lab",)).address(80).startswith("http://rig.lab:80/")
    tokens = {Access("127.0.0.1").token for _ in range(100)}
    assert len(tokens) == 100 and min(map(len, tokens)) >= 21


def test_an_unguarded_server_is_refused() -> None:
    with pytest.raises(ConfigError, match="cannot be protected"), Access("127.0.0.1").guard_server():
        pass


@pytest.mark.parametrize("host", ["nowhere.invalid", "192.0.2.1", "a..b", "x" * 300])
def test_an_unusable_host_is_an_error(host: str) -> None:
    with ends_within(30):
        result = called("view", "tap", "--no-open", "--duration", "0.1", "--port", "0", "--host", host)
    assert result.returncode == 2
    assert result.stderr.startswith(f"softfinger: --host {host}: ") and "of this machine" in result.stderr


def send_value(stream: ClientConnection, control: Any, value: Any) -> None:
    message = {"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": {"value": value}}
    stream.send(msgspec.msgpack.encode(message))


def test_controls_reject_values_outside_their_limits(page: Page, endpoints: tuple[str, str]) -> None:
    with closing(LivePage(page, Addresses(*endpoints))) as live:
        slider, choice = live._tuning._knobs["stiffness"].slider, live._tuning._scene_list
        assert step_until(live, lambda: page.fingers and slider.value == 1000.0)
        requests: list[Any] = []
        live._tuning._params = lambda name, values: requests.append(values)
        live._tuning._set_scene = lambda name, values: requests.append(values)
        with opened(page, get_path(page), f"http://{get_host(page)}") as stream:
            stream.send(msgspec.msgpack.encode(CAMERA))
            assert step_until(live, page.server.get_clients)
            for control, wrong in ((slider, 1e6), (slider, -1.0), (slider, float("nan")), (choice, "/etc/scene.toml")):
                right, before = control.value, control.update_timestamp
                send_value(stream, control, wrong)
                assert step_until(live, lambda c=control, r=right, b=before: c.update_timestamp > b and c.value == r)
            assert not requests
            send_value(stream, slider, 740.0)
            assert step_until(live, lambda: requests)
        assert requests == [{"object.0.material.stiffness_n_per_m": 740.0}]
