"""`bench view`: cost of open pages for the servo, and frame rate of a page.

One process runs the daemon, and each viewer is a separate process. Cases take turns, so that disturbances of the
machine affect all of them: no viewer; viewers without a browser, one and several; with `--browsers` one viewer with a
page in Chromium, and with several. Their frames are drawn in software, as on a machine without a graphics card, and
counted by the page itself.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.server.progress import show_progress
from softfinger.server.wire.client import subscribe
from softfinger.tools.bench.telemetry import measure_processor_s, run_process, run_source
from softfinger.tools.measure import Array, compute_quantiles, draw_exceedance, format_microseconds, show_and_draw

TURN_S: Final = 10.0
SETTLE_S: Final = 8.0
"""A slow page first lowers its resolution, twice."""
SIZE: Final = (1100, 700)
"""Size of a page, pixels."""
ARGUMENTS: Final = [
    "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync",
]  # fmt: skip
"""Arguments for a Chromium that draws in software and makes no requests to the network."""

COUNT: Final = """() => {
    const begun = performance.now();
    let frames = 0;
    const count = () => { frames += 1; requestAnimationFrame(count); };
    requestAnimationFrame(count);
    window.framesPerSecond = () => 1000 * frames / (performance.now() - begun);
}"""


class PageCounts(NamedTuple):
    """Number of viewer processes, and number of browser pages that are open at the first of them."""

    viewers: int
    pages: int


class TurnResult(NamedTuple):
    """Results of a turn.

    ticks   (n, 3)  lateness s, busy s, deadlines missed so far
    load            a viewer's share of a processor
    frames          frames a second of each page
    """

    ticks: Array
    load: float
    frames: list[float]


def run(args: argparse.Namespace) -> int:
    page_counts = list_cases(args)
    turns = max(1, round(args.seconds / TURN_S))
    parts: dict[str, list[TurnResult]] = {name: [] for name in page_counts}
    with tempfile.TemporaryDirectory() as folder:
        endpoint, commands = (f"ipc://{folder}/{name}" for name in ("telemetry", "commands"))
        words = [sys.executable, "-m", "softfinger.server.cli", "run", "--rig", args.rig]
        words += ["--endpoint", endpoint, "--commands", commands]
        with run_source(words, endpoint), show_progress("measuring", turns * len(page_counts)) as advance:
            for number in range(turns * len(page_counts)):
                name = list(page_counts)[number % len(page_counts)]
                parts[name].append(measure(page_counts[name], endpoint, commands, args.seconds / turns))
                advance(number + 1)
    result = {name: summarize_turns(rows) for name, rows in parts.items()}
    late = {name: np.concatenate([turn.ticks[:, 0] for turn in turns]) for name, turns in parts.items()}
    texts = ("woken late", "ticks later than this", "")
    content = {"rig": args.rig, "seconds": args.seconds, "cases": result}
    return show_and_draw(args, content, format_table(result), lambda path: draw_exceedance(path, late, 1.0, *texts))


def list_cases(args: argparse.Namespace) -> dict[str, PageCounts]:
    """Return the cases by name; raises ConfigError if browsers are not available."""
    counts = {"no viewer": PageCounts(0, 0), "1 viewer": PageCounts(1, 0)}
    if args.viewers > 1:
        counts[f"{args.viewers} viewers"] = PageCounts(args.viewers, 0)
    if args.browsers:
        if shutil.which("chromium") is None:
            raise ConfigError("--browsers: chromium is not installed (Debian: apt install chromium)")
        counts["1 page"] = PageCounts(1, 1)
    if args.browsers > 1:
        counts[f"{args.browsers} pages"] = PageCounts(1, args.browsers)
    return counts


def measure(case: PageCounts, endpoint: str, commands: str, seconds: float) -> TurnResult:
    """Return the daemon's ticks with the viewers and pages of a case."""
    with ExitStack() as running:
        words = ["--endpoint", endpoint, "--commands", commands]
        served = [running.enter_context(run_viewer(*words)) for _ in range(case.viewers)]
        pages = running.enter_context(open_pages(served[0][1], case.pages)) if case.pages else []
        for page in pages:
            page.evaluate(COUNT)
        start_cpu_s, begun = [measure_processor_s(process.pid) for process, _ in served], time.monotonic()
        ticks = receive_ticks(endpoint, seconds)
        frames = [float(page.evaluate("framesPerSecond()")) for page in pages]
        processor_seconds = [
            measure_processor_s(process.pid) - before for (process, _), before in zip(served, start_cpu_s, strict=True)
        ]
        return TurnResult(
            ticks, float(np.mean(processor_seconds)) / (time.monotonic() - begun) if processor_seconds else 0.0, frames
        )


def receive_ticks(endpoint: str, seconds: float) -> Array:
    """Return every tick (n, 3) of some seconds: lateness s, busy s, deadlines missed so far."""
    rows, end = [], time.monotonic() + seconds
    with subscribe(endpoint) as samples:
        while (remaining_s := end - time.monotonic()) > 0.0:
            if (sample := samples.receive(remaining_s)) is not None:
                servo = sample.data.servo
                rows.append((servo.late, servo.busy, servo.missed))
    return np.array(rows).reshape(-1, 3)


@contextmanager
def run_viewer(*words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run `softfinger view` with arguments; yields the process and the address of its page.

    Raises ConfigError with the output of the process if there is no page.
    """
    command = [sys.executable, "-m", "softfinger.server.cli", "view", "--no-open", *words]
    with run_process(command, stderr=subprocess.PIPE, text=True, process_group=0) as process:  # no Ctrl-C
        assert process.stderr is not None
        output = ""
        while (match := re.search(r"(?m)^(http\S+)\n", output)) is None:
            line = process.stderr.readline()
            if not line:
                raise ConfigError(f"no page was served: {output.strip() or 'it ended without a word'}")
            output += line
        yield process, match[1]


@contextmanager
def open_pages(address: str, count: int) -> Iterator[list[Any]]:
    """Open pages in a Chromium without a screen and wait until they are drawn.

    Raises ConfigError without playwright.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise ConfigError("--browsers drives Chromium by playwright: pip install playwright") from None
    with sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS, headless=True)
        try:
            pages = []
            for _ in range(count):
                page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
                page.set_default_timeout(180_000.0)
                page.goto(address)
                page.locator("canvas").first.wait_for()
                pages.append(page)
            time.sleep(SETTLE_S)
            yield pages
        finally:
            browser.close()


def summarize_turns(turns: list[TurnResult]) -> dict[str, Any]:
    late, busy = (np.concatenate([turn.ticks[:, column] for turn in turns]) for column in (0, 1))
    missed = [float(turn.ticks[-1, 2] - turn.ticks[0, 2]) for turn in turns]
    frames = [rate for turn in turns for rate in turn.frames]
    return {
        "ticks": len(late),
        "missed_of_1000": 1e3 * sum(missed) / (sum(missed) + len(late)),
        "late": compute_quantiles(late, 1000),
        "busy": compute_quantiles(busy, 1000),
        "viewer_load": float(np.mean([turn.load for turn in turns])),
        "frames_per_s": {"least": min(frames), "median": float(np.median(frames))} if frames else None,
    }


def format_table(result: dict[str, dict[str, Any]]) -> list[str]:
    lines = [
        "viewers             missed of 1000   late p50        p99   busy p50        p99   a viewer   frames a second"
    ]
    for name, case in result.items():
        cells = "".join(
            format_microseconds(case[quantity]["blocks"][q]) + "  "
            for quantity in ("late", "busy")
            for q in ("p50", "p99")
        )
        frames = case["frames_per_s"]
        frames_text = f"{frames['median']:.0f}, least {frames['least']:.0f}" if frames else ""
        load = f"{100.0 * case['viewer_load']:5.1f} %" if case["viewer_load"] else ""
        lines.append(f"  {name:<18} {case['missed_of_1000']:12.2f}   {cells}   {load:<8}   {frames_text}")
    return [*lines, "  us; medians over blocks of 1000 ticks; a viewer: its share of one processor"]
