"""Metrics service: HTTP server for Prometheus on loopback, one request at a time.

It also serves a Grafana dashboard of the metrics, /dashboard.json.
"""

from __future__ import annotations

import contextlib
import json
import logging
import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app

from softfinger.server.loop import shutdown
from softfinger.server.metrics.counts import MetricsCollector
from softfinger.server.services.base import Worker
from softfinger.server.services.records import Sink
from softfinger.server.wire.endpoint import BoundSocket

PROMETHEUS: Final = {"type": "prometheus", "uid": "${datasource}"}
QUANTILES: Final = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}
HEIGHT, WIDTH = 8, 12
"""Size of a graph; a dashboard is 24 wide."""


def _select(name: str) -> str:
    return f'softfinger_{name}{{instance=~"$instance"}}'


def _rate(name: str, function: str = "rate") -> str:
    return f"{function}({_select(name)}[$__rate_interval])"


def _quantile(share: float, histogram: str, labels: str = "le") -> str:
    return f"histogram_quantile({share:g}, sum by ({labels}) ({_rate(f'{histogram}_bucket')}))"


GRAPHS: Final[Mapping[str, tuple[str, Mapping[str, str]]]] = {
    "Ticks and missed deadlines": ("ops", {"ticks": _rate("ticks_total"), "missed": _rate("deadlines_missed_total")}),
    "Lateness of the servo": ("s", {name: _quantile(share, "lateness_seconds") for name, share in QUANTILES.items()}),
    "Execution time of a tick": (
        "s",
        {name: _quantile(share, "execution_seconds") for name, share in QUANTILES.items()},
    ),
    "Force on the hand": (
        "newton",
        {
            "mean {{finger}}": f"sum by (finger) ({_rate('force_newtons_sum')}) / "
            f"sum by (finger) ({_rate('force_newtons_count')})",
            "p99 {{finger}}": _quantile(0.99, "force_newtons", "le, finger"),
        },
    ),
    "Share of time in each mode": ("percentunit", {"{{finger}} {{mode}}": _rate("mode_seconds_total")}),
    "Ticks changed by the guard": ("ops", {"{{finger}} {{cause}}": _rate("guarded_ticks_total")}),
    "Device": ("ops", {"{{finger}} {{status}}": _rate("device_errors_total")}),
    "Telemetry": (
        "short",
        {
            "subscribers": _select("subscribers"),
            "messages lost": _rate("messages_lost_total", "increase"),
            "ticks dropped": _rate("records_dropped_total", "increase"),
            "connections refused": _rate("connections_refused_total", "increase"),
            "publisher started again": _rate("publisher_restarts_total", "increase"),
        },
    ),
    "Recordings": (
        "short",
        {
            "ticks a second": _rate("recorded_ticks_total"),
            "kB a second": f"{_rate('recorded_bytes_total')} / 1000",
            "ticks left out": _rate("unrecorded_ticks_total", "increase"),
            "events left out": _rate("unrecorded_events_total", "increase"),
            "longest write, ms": f"1000 * {_select('recording_worst_write_seconds')}",
        },
    ),
}
"""Unit, and expression by legend, of each graph by title. Shares add up: that graph is stacked."""
TABLES: Final = {"Version": _select("build_info"), "State": f"{_select('state')} == 1"}
"""Expression of each table by title."""


def make_dashboard() -> dict[str, Any]:
    """Return the dashboard in Grafana's format: two panels in a row."""
    panels = [
        _make_panel(number, title, HEIGHT, {"type": "timeseries", "fieldConfig": _make_field_config(unit)})
        | {
            "targets": [
                {"refId": letter, "expr": expression, "legendFormat": legend}
                for letter, (legend, expression) in zip("ABCDE", expressions.items(), strict=False)
            ]
        }
        for number, (title, (unit, expressions)) in enumerate(GRAPHS.items())
    ]
    panels[-1]["gridPos"]["w"] = 2 * WIDTH  # the tables start a row
    for number, (title, expression) in enumerate(TABLES.items(), len(panels) + len(panels) % 2):
        target = {"refId": "A", "expr": expression, "format": "table", "instant": True}
        panels.append(_make_panel(number, title, HEIGHT // 2, {"type": "table", "targets": [target]}))
    variables = [
        {"name": "datasource", "type": "datasource", "query": "prometheus", "label": "Prometheus"},
        {
            "name": "instance", "type": "query", "label": "Instance", "datasource": PROMETHEUS,
            "query": "label_values(softfinger_ticks_total, instance)", "includeAll": True, "multi": True, "refresh": 2,
        },
    ]  # fmt: skip
    return {
        "title": "softfinger", "uid": "softfinger", "tags": ["haptics"], "schemaVersion": 39, "editable": True,
        "refresh": "5s", "time": {"from": "now-15m", "to": "now"}, "templating": {"list": variables}, "panels": panels,
    }  # fmt: skip


def _make_panel(number: int, title: str, height: int, content: Mapping[str, Any]) -> dict[str, Any]:
    place = {"h": height, "w": WIDTH, "x": WIDTH * (number % 2), "y": HEIGHT * (number // 2)}
    return {"id": number + 1, "title": title, "datasource": PROMETHEUS, "gridPos": place, **content}


def _make_field_config(unit: str) -> dict[str, Any]:
    is_stacked = unit == "percentunit"
    custom = {"stacking": {"mode": "normal" if is_stacked else "none"}, "fillOpacity": 30 if is_stacked else 0}
    return {"defaults": {"unit": unit, "custom": custom}, "overrides": []}


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

    def get_request(self) -> Any:
        try:
            return super().get_request()
        except OSError:  # without a free file descriptor the connection remains in the queue
            time.sleep(POLL_S)
            raise

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
