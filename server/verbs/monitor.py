"""`softfinger monitor`: live view of a running server in a terminal.

Only a client of the wire. It draws a dashboard on a terminal, and writes one line per second into a pipe or file. With
`--json` it writes one JSON object per second.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import textwrap
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import msgspec

from softfinger.proxy.record import MODE_NAMES
from softfinger.server import keys
from softfinger.server.gateway.addresses import find_addresses
from softfinger.server.wire.client import NoTelemetry, Sample, explain_no_telemetry, subscribe
from softfinger.server.wire.protocol import CONTACT, EVENT, FINGERS, HEALTH, find_finger

if TYPE_CHECKING:  # rich takes 50 ms to import and only the dashboard needs it
    from rich.console import RenderableType

_EVENTS_MAX: Final = 8
_DASHBOARD_PERIOD_S: Final = 0.1
_LINE_PERIOD_S: Final = 1.0
_STALLED_S: Final = 1.5  # health is sent once a second, so a longer silence means that ticks stopped
_ONCE_WAIT_S: Final = 2.5  # a full health message arrives within two seconds
_ROUNDING: Final = 1e-9
"""Values below this are rounding errors of a sum, in any unit of the wire; no device senses or displays so little."""
_BAR_CELLS: Final = 32
_EVENT_INDENT: Final = 12
_MODE_STYLES: Final = {0: "green", 1: "bold blue", 2: "bold red"}


def run(args: argparse.Namespace) -> int:
    try:
        if args.json:
            _show_until_end(args, lambda board: print(_to_json(board), flush=True), _LINE_PERIOD_S)
        elif args.once or not sys.stdout.isatty() or os.environ.get("TERM") == "dumb":
            _show_until_end(args, lambda board: print(format_line(board), flush=True), _LINE_PERIOD_S)
        else:
            _show_dashboard(args)
    except KeyboardInterrupt:
        return 0
    except BrokenPipeError:  # the reader (head, grep -m1) closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


class Dashboard:
    """State of the server according to the messages received so far."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint = endpoint
        self.fingers: dict[str, Sample] = {}
        """Latest tick of each finger by its name; a single finger has the name ""."""
        self.health: Sample | None = None
        self.events: deque[Sample] = deque(maxlen=_EVENTS_MAX)
        self.event_count = 0
        self.messages = 0
        self.lost = 0
        self.force_peak_n = 1.0
        self.stopped = False
        """True after the server reported that it stopped, until its next tick."""
        self._arrived_s = time.monotonic()

    def update(self, sample: Sample) -> None:
        self.messages += 1
        self._arrived_s = time.monotonic()
        finger = find_finger(sample.topic)
        if finger is not None:
            self.fingers[finger], self.stopped = sample, False
            self.lost += sample.lost
            contact = sample.data.contact
            self.force_peak_n = max(self.force_peak_n, contact.normal_force, contact.tangential_force)
        elif sample.topic == EVENT:
            self.events.append(sample)
            self.event_count += 1
            if sample.kind == "lifecycle":
                self.stopped = sample.name == "stopped"
        elif sample.topic == HEALTH:
            self.health = sample

    @property
    def contact(self) -> Sample | None:
        return self.fingers.get("")

    @property
    def silent_s(self) -> float:
        """Time since the last message, s."""
        return time.monotonic() - self._arrived_s

    @property
    def outage_text(self) -> str:
        """Text on why nothing is rendered now; empty while messages arrive."""
        if self.stopped:
            return "the server has stopped"
        return f"no data for {self.silent_s:.1f} s" if self.messages and self.silent_s > _STALLED_S else ""

    def summary(self) -> dict[str, Any]:
        """Return the board as plain data; `contact` and `health` are None until their first message.

        With several fingers there is no `contact`; each finger is in `fingers`.
        """
        named_fingers = {name: sample for name, sample in self.fingers.items() if name}
        fingers = {
            "fingers": {
                name: {"mode": _name_mode(sample["contact.mode"]), "contact": sample.as_map()}
                for name, sample in named_fingers.items()
            }
        }
        return (fingers if named_fingers else {}) | {
            "endpoint": self.endpoint,
            "silent_s": round(self.silent_s, 3),
            "mode": _name_mode(self.contact["contact.mode"]) if self.contact else None,
            "contact": self.contact.as_map() if self.contact else None,
            "health": self.health.as_map() if self.health else None,
            "lost": self.lost,
            "event_count": self.event_count,
            "events": [event.as_map() for event in self.events],
        }


def _show_until_end(args: argparse.Namespace, show: Callable[[Dashboard], None], period_s: float) -> None:
    """Receive messages and redraw the dashboard every `period_s`, until `--once` or `--duration` ends it."""
    started = time.monotonic()
    end = started + (args.duration or math.inf)
    first = math.inf  # time of the first message: the daemon may start later
    next_show = started + period_s
    topics = CONTACT, EVENT, HEALTH, FINGERS
    lock = keys.read_keys(args)
    endpoint = find_addresses(args.endpoint, lock, within_s=args.timeout).telemetry
    with subscribe(endpoint, topics, keys=lock) as subscription:
        board = Dashboard(endpoint)
        while True:
            sample = subscription.receive(max(0.0, min(_DASHBOARD_PERIOD_S, end - time.monotonic())))
            if sample is not None:
                board.update(sample)
            now = time.monotonic()
            if board.messages:
                first = min(first, now)
            if not board.messages and now >= min(end, started + args.timeout):
                raise NoTelemetry(explain_no_telemetry(endpoint, min(args.timeout, args.duration or math.inf)))
            if args.once:
                if board.messages and (now >= min(end, first + _ONCE_WAIT_S) or (board.fingers and board.health)):
                    show(board)
                    return
            elif now >= next_show or now >= end:
                if board.messages or period_s < _LINE_PERIOD_S:
                    show(board)
                next_show = now + period_s
            if now >= end:
                return


def _to_json(board: Dashboard) -> str:
    # msgspec writes null for nan, json.dumps writes invalid JSON.
    return msgspec.json.encode(board.summary(), enc_hook=str).decode()


def format_line(board: Dashboard) -> str:
    parts = [time.strftime("%H:%M:%S")]
    if board.outage_text:
        parts.append(f"{board.outage_text};")
    for name, sample in sorted(board.fingers.items()):
        data = sample.data
        parts.append(
            (f"{name}: " if name else "")
            + f"tick {data.tick} {_name_mode(data.contact.mode)} object {data.contact.object} "
            f"normal {_format_fixed(data.contact.normal_force, 0, 3)} N "
            f"tangential {_format_fixed(data.contact.tangential_force, 0, 3)} N "
            f"depth {_format_fixed(data.contact.penetration * 1e3, 0, 3)} mm"
        )
    if board.health:
        health = board.health.data
        parts.append(
            f"rate {health.rate:.1f}/s late p99 {health.late.p99 * 1e6:.1f} us "
            f"exec p99 {health.exec.p99 * 1e6:.1f} us missed {health.missed} drops {health.drops}"
        )
        if health.preparing:
            parts.append(f"preparing: {health.preparing};")
    parts.append(f"lost {board.lost} events {board.event_count}")
    if board.events:
        parts.append(f"(last: {_format_event(board.events[-1])})")
    return " ".join(parts)


def _name_mode(mode: int) -> str:
    return MODE_NAMES[mode] if 0 <= mode < len(MODE_NAMES) else f"mode {mode}"


def _format_event(event: Sample) -> str:
    common = ("schema", "timestamp", "tick", "kind", "name")
    more = " ".join(f"{key}={_shorten(value)}" for key, value in event.data.items() if key not in common)
    text = f"{event.kind} {event.name} {more}".rstrip()
    return text if text.isprintable() else repr(text)  # text from the wire must not control the terminal


def _shorten(value: Any) -> str:
    if isinstance(value, float):
        return "0" if abs(value) < _ROUNDING else f"{value:.3g}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_shorten(item) for item in value)}]"
    return str(value)


def _format_fixed(value: float, width: int, digits: int) -> str:
    """Format a number with `digits` decimals, and without a minus sign if it rounds to zero."""
    return f"{round(value, digits) + 0.0:{width}.{digits}f}"


def _show_dashboard(args: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.live import Live

    console = Console()
    with Live(console=console, auto_refresh=False) as live:
        _show_until_end(
            args, lambda board: live.update(render(board, *console.size), refresh=True), _DASHBOARD_PERIOD_S
        )


def render(board: Dashboard, width: int, height: int) -> RenderableType:
    from rich.console import Group
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    rows = Table.grid(padding=(0, 2))
    rows.add_column(style="dim", min_width=12)
    rows.add_column(no_wrap=True)
    if not board.fingers:
        rows.add_row("contact", Text("waiting for telemetry", style="yellow"))
    for name, sample in sorted(board.fingers.items()):
        if name:
            rows.add_row("finger", Text(name, style="bold"))
        _add_contact_rows(rows, sample.data, board)
    if board.health is not None:
        health = board.health.data
        for name, values in (("late", health.late), ("exec", health.exec)):
            figures = "   ".join(
                f"{key} {_format_fixed(getattr(values, key) * 1e6, 8, 2)}" for key in ("p50", "p99", "max")
            )
            rows.add_row(name, f"{figures}  us")
        rows.add_row("ticks", f"{_format_fixed(health.rate, 0, 1)} /s   missed {health.missed}   drops {health.drops}")
        rows.add_row("energy", f"{_format_fixed(health.energy_total * 1e3, 0, 3)} mJ")
        if health.preparing:
            rows.add_row("preparing", Text(health.preparing, style="yellow"))
    rows.add_row("lost here", Text(str(board.lost), style="red" if board.lost else ""))
    title = Text(f"softfinger  {board.endpoint}")  # not markup: an IPv6 address has brackets
    if board.outage_text:
        title.append(f"  {board.outage_text}", style="bold red")
    # Each frame takes two rows, and the terminal needs one for the cursor.
    events = _format_events(board, width - 4, height - rows.row_count - 5)
    return Group(Panel(rows, title=title, title_align="left"), Panel(events, title="events", title_align="left"))


def _format_events(board: Dashboard, width: int, height: int) -> str:
    """Return the latest events that fit completely, the latest one last."""
    lines: list[str] = []
    for event in reversed(board.events):
        lines_of_event = textwrap.wrap(
            f"{event.tick:>10}  {_format_event(event)}", max(width, 20), subsequent_indent=" " * _EVENT_INDENT
        )
        if len(lines_of_event) + len(lines) > max(height, 1) and lines:
            break
        lines = lines_of_event + lines
    return "\n".join(lines) or "none yet"


def _add_contact_rows(rows: Any, data: Any, board: Dashboard) -> None:
    from rich.text import Text

    contact = data.contact
    style = "dim" if board.outage_text else ""  # outdated values
    rows.add_row("mode", Text(_name_mode(contact.mode), style=style or _MODE_STYLES.get(contact.mode, "")))
    rows.add_row("object", f"number {contact.object} of the scene" if contact.object >= 0 else "none")
    rows.add_row("tick", str(data.tick))
    for name, value in (("normal", contact.normal_force), ("tangential", contact.tangential_force)):
        bar = _format_bar(0.0 if board.outage_text else value, board.force_peak_n)
        rows.add_row(name, Text(f"{bar} {_format_fixed(value, 7, 3)} N", style=style))
    rows.add_row("force", Text("  ".join(_format_fixed(value, 8, 3) for value in data.force) + "  N", style=style))
    rows.add_row("torque", Text("  ".join(_format_fixed(v * 1e3, 8, 3) for v in data.torque) + "  N mm", style=style))
    rows.add_row("penetration", f"{_format_fixed(contact.penetration * 1e3, 8, 3)}  mm")
    rows.add_row("spin", f"{_format_fixed(math.degrees(contact.spin), 8, 2)}  deg")


def _format_bar(value: float, full: float) -> str:
    cells = round(_BAR_CELLS * min(max(value / full, 0.0), 1.0)) if math.isfinite(value) else 0
    return "█" * cells + "·" * (_BAR_CELLS - cells)
