"""Access control of the page: requests need the secret address and must come from the page itself.

Browsers let any web site connect to any address of this machine, by a websocket or under a name of the site's domain
(DNS rebinding). Therefore each request must have the page's token in its path, the page's host in its header and, if
the browser sends an origin, the origin of the page.
"""

from __future__ import annotations

import gzip
import hmac
import logging
import secrets
import socket
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from http import HTTPStatus
from ipaddress import ip_address
from typing import Any, Final

from websockets.asyncio import server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from softfinger.config.errors import ConfigError

log: Final = logging.getLogger(__name__)

TOKEN_BYTES: Final = 16
MESSAGE_MAX: Final = 65536
"""Maximum size of a browser's message, bytes. The page sends less than 1000. Larger messages are refused at the header
of their frame; viser's default limit is 50 MB.
"""
BROWSERS_MAX: Final = 32
"""Maximum number of simultaneous browsers. Each has a separate send buffer."""
ERROR_TEXT_MAX: Final = 200
ADDRESS_REMEDY: Final = "open the page by the address that `softfinger view` or `softfinger run --view` printed last\n"
HEADERS: Final = {
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",  # prevents clickjacking: no other page may embed this one
    "Referrer-Policy": "no-referrer",  # the address is secret
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
VISER_TITLE: Final = b"<title>Viser</title>"

RequestHook = Callable[[ServerConnection, Request], Response | None]
Handler = Callable[[ServerConnection], Awaitable[None]]


class Access:
    """Check of requests to a page on `host`.

    Parameters
    ----------
    host
        Address that the page listens on.
    allowed
        Further hosts, NAME or NAME:PORT, for access through a tunnel.
    title
        Title of the page.
    token
        Secret part of the address; None: a new one.
    """

    def __init__(
        self, host: str, allowed: tuple[str, ...] = (), title: str = "softfinger", token: str | None = None
    ) -> None:
        self.token: Final = secrets.token_urlsafe(TOKEN_BYTES) if token is None else token
        self._host, self._allowed, self._title = host, allowed, title

    def address(self, port: int) -> str:
        """Return the page's address for a browser on this machine, or on another one if `host` is a wildcard."""
        if _is_wildcard(self._host):
            name = self._allowed[0] if self._allowed else socket.gethostname()
        else:
            name = "localhost" if self._host == "127.0.0.1" else self._host
        return f"http://{_with_port(name, port)}/{self.token}/"

    def refusal_reason(self, path: str, headers: Headers, local: tuple[Any, ...]) -> str:
        """Return why a request to the `local` address (host, port, ...) is refused; empty if it is allowed."""
        hosts = [value.lower() for value in headers.get_all("Host")]
        if len(hosts) != 1 or hosts[0] not in self._list_hosts(local):
            return f"the request is for the host {hosts}, which is not allowed: add it with --allow-host"
        origins = [value.lower() for value in headers.get_all("Origin")]
        upgrade = "Upgrade" in headers
        if (origins or upgrade) and origins not in ([f"http://{hosts[0]}"], [f"https://{hosts[0]}"]):
            return f"the request comes from {origins or 'nowhere'}, not from this page"
        token = path.partition("?")[0].split("/")[1:2]
        if not token or not hmac.compare_digest(token[0].encode(), self.token.encode()):
            return "the address does not have this page's token"
        return ""

    def _list_hosts(self, local: tuple[Any, ...]) -> set[str]:
        """Return the allowed values of the header Host; numeric addresses cannot belong to a web site's domain."""
        port = int(local[1])
        hosts = {self._host, str(local[0]), *self._allowed}
        if _is_wildcard(self._host) or ip_address(str(local[0]).partition("%")[0]).is_loopback:
            hosts |= {"localhost"}
        if _is_wildcard(self._host):
            hosts |= {socket.gethostname()}
        return {_with_port(name, port).lower() for name in hosts}

    def wrap_answer(self, serve: RequestHook) -> RequestHook:
        """Wrap `serve`: pass on allowed requests, without the token in the path, and refuse all other ones."""

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            reason = self.refusal_reason(request.path, request.headers, connection.local_address)
            if reason:
                body = f"Refused: {reason}; {ADDRESS_REMEDY}".encode()
                headers = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
                response: Response | None = Response(HTTPStatus.FORBIDDEN, "Forbidden", headers, body)
            else:
                response = serve(connection, replace(request, path=request.path.removeprefix(f"/{self.token}") or "/"))
            return None if response is None else self._complete(response)

        return answer

    def _complete(self, response: Response) -> Response:
        body = response.body or b""
        if response.headers.get("Content-Type", "").startswith("text/html"):
            body = _set_title(bytes(body), response.headers.get("Content-Encoding") == "gzip", self._title)
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(body))
        response.headers.update(HEADERS)
        return replace(response, body=body)

    @contextmanager
    def guard_server(self) -> Iterator[None]:
        """Guard the server that viser starts in the block; raises ConfigError if it starts none in the expected way.

        viser has no hook for this. It calls `websockets.asyncio.server.serve` with a `process_request`, both public;
        the call is replaced while the server starts.
        """
        original, name, calls = websockets_server.serve, "serve", list[bool]()

        def serve(handler: Handler, *args: Any, process_request: RequestHook, **options: Any) -> Any:
            calls.append(True)
            options["max_size"] = MESSAGE_MAX
            return original(
                limit_browsers(handler), *args, process_request=self.wrap_answer(process_request), **options
            )

        setattr(websockets_server, name, serve)
        try:
            yield
        finally:
            setattr(websockets_server, name, original)
        if not calls:
            raise ConfigError(
                "the page cannot be protected with this version of viser: pip install 'softfinger[viewer]'"
            )


def limit_browsers(handler: Handler) -> Handler:
    """Return `handler` for at most BROWSERS_MAX browsers; an invalid message of one ends it with a line in the log."""
    browsers = set[ServerConnection]()

    async def serve_browser(connection: ServerConnection) -> None:
        if len(browsers) >= BROWSERS_MAX:
            await connection.close(CloseCode.TRY_AGAIN_LATER, f"the page is open in {BROWSERS_MAX} browsers: close one")
            return
        browsers.add(connection)
        try:
            await handler(connection)
        except Exception as error:  # of many classes, as viser decodes untrusted bytes
            error_text = " ".join(f"{type(error).__name__}: {error}".split())[:ERROR_TEXT_MAX]
            log.warning("disconnected a browser that sent an unknown message (%s)", error_text)
            await connection.close(CloseCode.INVALID_DATA, "no message of this page: load the scene again")
        finally:
            browsers.discard(connection)

    return serve_browser


@lru_cache(maxsize=4)
def _set_title(body: bytes, is_gzip: bool, title: str) -> bytes:
    plain = gzip.decompress(body) if is_gzip else body
    plain = plain.replace(VISER_TITLE, f"<title>{title}</title>".encode(), 1)
    return gzip.compress(plain) if is_gzip else plain


def _with_port(name: str, port: int) -> str:
    """Return `name` as in an address, with the port unless it has one."""
    if name.count(":") > 1 and not name.startswith("["):  # numeric IPv6 address
        name = f"[{name}]"
    return name if ":" in name.rpartition("]")[2] else f"{name}:{port}"


def _is_wildcard(host: str) -> bool:
    return host in ("", "0.0.0.0", "::")
