"""Metrics service: HTTP server for Prometheus on loopback, one request at a time."""

from __future__ import annotations

import contextlib
import json
import logging
import socket
import threading
from collections.abc import Callable, Iterable
from typing import Any, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app

from softfinger.server.loop import shutdown
from softfinger.server.metrics.counts import MetricsCollector
from softfinger.server.metrics.dashboard import make_dashboard
from softfinger.server.services.base import Worker
from softfinger.server.services.records import Sink
from softfinger.server.wire.endpoint import BoundSocket

log: Final = logging.getLogger(__name__)

KEY: Final = "[metrics] endpoint"
REQUEST_TIMEOUT_S: Final = 1.0
"""Time limit for a client to send its request and receive the answer."""
POLL_S: Final = 0.25
DASHBOARD_PATH: Final = "/dashboard.json"


class MetricsService(Worker):
    """Worker that serves the metrics on a bound endpoint. Its failure does not end other services."""

    def __init__(self, bound: BoundSocket, counts: MetricsCollector, event: Callable[..., Any]) -> None:
        super().__init__("metrics")
        self.endpoint: Final = bound.endpoint.replace("tcp://", "http://")
        self._bound, self._event = bound, event
        registry = CollectorRegistry()
        registry.register(counts)
        self._metrics_app = make_wsgi_app(registry)
        self.sink: Final = Sink("metrics", counts.add_records)

    def work(self) -> None:
        with _Server(self._bound, self._answer) as server:
            while not self.closing.is_set():
                server.handle_request()

    def handle_failure(self, error: Exception) -> None:
        self._event("fault", "metrics", message=str(error))

    def stop(self) -> None:
        shutdown.complete_all_steps(super().stop, self._bound.files.close)

    def _answer(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        if environ["PATH_INFO"] == DASHBOARD_PATH:
            start_response("200 OK", [("Content-Type", "application/json")])
            return [json.dumps(make_dashboard()).encode()]
        answer: Iterable[bytes] = self._metrics_app(environ, start_response)
        return answer


class _Server(WSGIServer):
    """WSGI server on a socket that is already listening."""

    timeout = POLL_S

    def __init__(self, bound: BoundSocket, answer: Any) -> None:
        host, port = bound.listener.getsockname()[:2]
        super().__init__((host, port), _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket, self.server_name, self.server_port = bound.listener, host, port
        self.setup_environ()
        self.set_app(answer)

    def handle_error(self, request: Any, client_address: Any) -> None:
        log.debug("metrics: a client was not answered", exc_info=True)


class _Handler(WSGIRequestHandler):
    timeout = REQUEST_TIMEOUT_S

    def handle(self) -> None:
        """Answer one request within REQUEST_TIMEOUT_S.

        `timeout` only limits each read, which is not enough because clients are served one after another.
        """
        timer = threading.Timer(REQUEST_TIMEOUT_S, self._close_connection)
        timer.start()
        try:
            super().handle()
        finally:
            timer.cancel()

    def _close_connection(self) -> None:
        with contextlib.suppress(OSError):  # the client has closed the connection
            self.connection.shutdown(socket.SHUT_RDWR)

    def log_message(self, *_: Any) -> None:
        """Log nothing: a scrape every few seconds is not worth a line."""
