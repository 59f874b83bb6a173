"""Access to the page and its commands, tested with clients that send headers no browser would."""

import socket
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any
from urllib.parse import urlsplit

import msgspec
import pytest
import viser
from helpers.browser import browser, shown, why_none
from helpers.called import called
from helpers.live_pages import step_until
from helpers.pages import CAMERA
from helpers.waits import ends_within
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from softfinger.config.errors import ConfigError
from softfinger.server.gateway.addresses import Addresses
from softfinger.server.viewer.door.access import Access
from softfinger.server.viewer.live import LivePage
from softfinger.server.viewer.page import Page

pytestmark = pytest.mark.real_time

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
