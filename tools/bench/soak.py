"""`bench soak`: long run of a daemon with all its services, to find growth and losses.

One daemon at 1 kHz on the simulated device is recorded. It has four subscribers, a viewer, a client that changes a
parameter ten times a second, and a program that is busy a third of the time. A client of the viewer's socket receives
everything that a browser would, and draws nothing. If there is a compiler, the C loop of `bench loop` runs in parallel:
deadlines that it also misses are caused by the machine. Ctrl-C ends the run and prints the results so far.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from urllib.parse import urlsplit

import numpy as np

from softfinger.config.errors import Unfit
from softfinger.config.load import load_rig
from softfinger.config.schema import Rig
from softfinger.server import signals
from softfinger.server.progress import show_progress
from softfinger.server.remote import Client
from softfinger.server.wire.client import subscribe
from softfinger.tools.bench.loop import SOURCE, run_reference
from softfinger.tools.bench.telemetry import run_source
from softfinger.tools.bench.view import run_viewer
from softfinger.tools.measure import Array, compile_c, draw_lines, show_and_draw

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

SUBSCRIBERS: Final = 4
CHANGE_S: Final = 0.1
SAMPLE_S: Final = 1.0
ROLES: Final = ("telemetry", "commands", "view")
"""Words of the command lines of child processes that name them."""
C_TURN_S: Final = 10.0
"""The C loop stores its measurements in memory until the end of a turn."""
WARM_S: Final = 600.0
"""Allocators and caches fill in the first minutes. In a run below half an hour, the first third is ignored."""
GROWTH_MAX: Final = {"resident_mb": 1.0, "descriptors": 1.0, "threads": 1.0}
"""Allowed growth per hour; less cannot be distinguished from the steps of an allocator."""
GAIN_MAX: Final = {"resident_mb": 0.5, "descriptors": 1.0, "threads": 1.0}
"""Allowed growth in the complete run, however short; a page of memory is not a leak."""
BLOCKS: Final = 120
"""Number of medians that the samples are reduced to."""
NORMAL_95: Final = 1.645
"""Normal quantile of a one-sided 95 % bound."""
FIELDS: Final = tuple(GROWTH_MAX)

BUSY: Final = """
import time
while True:
    until = time.monotonic() + 0.003
    while time.monotonic() < until:
        pass
    time.sleep(0.006)
"""


Sizes = dict[str, tuple[float, ...]]
"""MB, descriptors and threads of processes, by name."""


class SoakResult(NamedTuple):
    """Results of a run.

    times      (n,) s         of the samples
    processes                 for each, (n, 3) MB, descriptors, threads
    ticks                     of the servo
    missed                    its deadlines, and the deadlines of the C loop (None without one)
    lost                      ticks that subscribers did not receive
    """

    times: Array
    processes: dict[str, Array]
    ticks: int
    missed: int
    missed_c: int | None
    lost: int


def run(args: argparse.Namespace) -> int:
    """Measure and print; raises Unfit if something grows or a tick was lost."""
    rig = load_rig("simulated", {"servo.realtime": args.realtime})
    soaked = run_soak(rig, 60.0 * args.minutes)
    result = evaluate(soaked)
    lines = {name: (soaked.times / 60.0, values[:, 0]) for name, values in soaked.processes.items()}
    draw = partial(draw_lines, lines=lines, x="time, minutes", y="resident memory, MB")
    show_and_draw(args, result, format_table(result), draw)
    if result["faults"]:
        raise Unfit("; ".join(result["faults"]))
    return 0


def run_soak(rig: Rig, seconds: float) -> SoakResult:
    """Run everything for `seconds` and sample it once a second."""
    with tempfile.TemporaryDirectory() as folder_name, ExitStack() as running:
        folder = Path(folder_name)
        endpoint, commands = (f"ipc://{folder}/{name}" for name in ("telemetry", "commands"))
        words = ["run", "--rig", "simulated", "--realtime", rig.servo.realtime, "--record", str(folder / "soak.mcap")]
        words += ["--endpoint", endpoint, "--commands", commands]
        daemon = running.enter_context(run_source([sys.executable, "-m", "softfinger.server.cli", *words], endpoint))
        page, address = running.enter_context(run_viewer("--endpoint", endpoint, "--commands", commands))
        running.enter_context(run_helper("--page", address))
        readers = [running.enter_context(run_helper(endpoint)) for _ in range(SUBSCRIBERS)]
        running.enter_context(end_after([sys.executable, "-c", BUSY]))
        client = running.enter_context(Client(endpoint, commands, timeout_s=30.0))
        c_loop = running.enter_context(run_c_loop(rig, folder))
        trees = {"daemon": daemon.pid, "page": page.pid}
        trees |= {f"subscriber {number}": reader.pid for number, reader in enumerate(readers, 1)}
        first = find_newest(endpoint)
        times, processes = watch_processes(trees, lambda number: change(client, number), seconds)
        last = find_newest(endpoint)
        for reader in readers:
            reader.send_signal(signal.SIGTERM)
        lost_ticks = sum(int(reader.communicate(timeout=30.0)[0]) for reader in readers)
        return SoakResult(times, processes, last[0] - first[0], last[1] - first[1], c_loop(), lost_ticks)


def watch_processes(
    trees: dict[str, int], act: Callable[[int], None], seconds: float
) -> tuple[Array, dict[str, Array]]:
    """Sample every process and its children, and call `act` ten times a second, until the end or a signal.

    Returns the times (n,) s and, by process, samples (n, 3), NaN if the process did not exist. A process that existed
    for less than half of the time is left out.
    """
    begun, passed, number = time.monotonic(), 0.0, 0
    times, samples = list[float](), list[Sizes]()
    stopped = threading.Event()
    with show_progress("soaking", round(seconds)) as advance, signals.stop_on_signal(stopped.set):
        while passed < seconds and not stopped.is_set():
            act(number)
            if passed >= SAMPLE_S * len(times):
                times.append(passed)
                samples.append({})
                for name, pid in trees.items():
                    samples[-1] |= measure_sizes(name, pid)
                advance(int(passed))
            number += 1
            stopped.wait(max(0.0, begun + CHANGE_S * number - time.monotonic()))
            passed = time.monotonic() - begun
    nothing = (np.nan,) * len(FIELDS)
    names = dict.fromkeys(name for sample in samples for name in sample)
    by_process = {name: np.array([sample.get(name, nothing) for sample in samples]) for name in names}
    return np.array(times), {name: rows for name, rows in by_process.items() if np.isfinite(rows[:, 0]).mean() > 0.5}


def measure_sizes(name: str, pid: int) -> Sizes:
    """Return resident memory (MB), descriptors and threads of a process and of its children, by name."""
    process = Path(f"/proc/{pid}")
    try:
        status = dict(line.split(":\t", 1) for line in (process / "status").read_text().splitlines() if ":\t" in line)
        result: Sizes = {
            name: (
                float(status["VmRSS"].split()[0]) / 1024.0,
                float(len(list((process / "fd").iterdir()))),
                float(status["Threads"]),
            )
        }
        children = " ".join(path.read_text() for path in process.glob("task/*/children")).split()
        for child in map(int, children):
            words = Path(f"/proc/{child}/cmdline").read_text().split("\0")
            role = next((word for word in words if word in ROLES), "child")
            result |= measure_sizes(f"{name}: {role}", child)
    except (OSError, KeyError):  # the process does not exist any more
        return {}
    return result


def change(client: Client, number: int) -> None:
    """Set one of three stiffnesses."""
    client.set_params({"object.table.material.stiffness_n_per_m": 900.0 + 100.0 * (number % 3)})


def find_newest(endpoint: str) -> tuple[int, int]:
    """Return the latest tick and the deadlines missed until then."""
    with subscribe(endpoint, timeout_s=30.0) as samples:
        tick = next(iter(samples))
        return tick.tick, tick.servo.missed


@contextmanager
def end_after(words: list[str]) -> Iterator[subprocess.Popen[str]]:
    """Run a process until the block ends, and kill it with all processes that it has started."""
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@contextmanager
def run_helper(*words: str) -> Iterator[subprocess.Popen[str]]:
    """Run this file as a process until the block ends; yields it once it is at work."""
    with end_after([sys.executable, "-m", "softfinger.tools.bench.soak", *words]) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield process


@contextmanager
def run_c_loop(rig: Rig, folder: Path) -> Iterator[Callable[[], int | None]]:
    """Run the C loop in turns.

    Yields a function that ends the loop and returns its missed deadlines, None without a compiler.
    """
    program = compile_c(SOURCE, folder, "-pthread")
    if program is None:
        yield lambda: None
        return
    priority = "off" if rig.servo.realtime == "off" else "on"
    with run_helper("--c", str(program), repr(rig.servo.rate_hz), priority, str(rig.servo.priority)) as process:

        def missed() -> int:
            process.send_signal(signal.SIGTERM)
            return int(process.communicate(timeout=C_TURN_S + 60.0)[0])

        yield missed


def evaluate(soaked: SoakResult) -> dict[str, Any]:
    """Return the growth of every process per hour with its lower bound, and the faults."""
    hours = soaked.times / 3600.0
    faults, processes = list[str](), dict[str, Any]()
    for name, values in soaked.processes.items():
        processes[name] = {}
        warm = (soaked.times >= min(WARM_S, soaked.times[-1] / 3.0)) & np.isfinite(values[:, 0])
        for column, field in enumerate(FIELDS):
            column = values[warm, column]
            slope, at_least = compute_growth(hours[warm], column)
            gained = at_least * (hours[warm][-1] - hours[warm][0])
            processes[name][field] = {"last": float(column[-1]), "an_hour": slope, "an_hour_at_least": at_least}
            if at_least > GROWTH_MAX[field] and gained > GAIN_MAX[field]:
                faults.append(f"{name}: {field} grows by {slope:.2f} an hour, at least {at_least:.2f}")
    if soaked.lost:
        faults.append(f"subscribers did not get {soaked.lost} ticks")
    return {
        "minutes": float(soaked.times[-1] / 60.0),
        "ticks": soaked.ticks,
        "missed": soaked.missed,
        "missed_c": soaked.missed_c,
        "lost": soaked.lost,
        "processes": processes,
        "faults": faults,
    }


def compute_growth(hours: Array, values: Array) -> tuple[float, float]:
    """Return the slope per hour and the lower end of its one-sided 95 % interval.

    They are the median of the slopes of all pairs, and the order statistic below it. Both ignore single steps and a
    stall.

    Source: Sen (1968), Estimates of the regression coefficient based on Kendall's tau.
    """
    parts = min(BLOCKS, len(values))
    x, y = (np.array([np.median(part) for part in np.array_split(column, parts)]) for column in (hours, values))
    first, second = np.triu_indices(parts, 1)
    if len(first) == 0:
        return 0.0, 0.0
    slopes = np.sort((y[second] - y[first]) / (x[second] - x[first]))
    spread = NORMAL_95 * np.sqrt(parts * (parts - 1) * (2 * parts + 5) / 18.0)
    lower = int(max(0.0, (len(slopes) - spread) / 2.0))
    return float(np.median(slopes)), float(slopes[lower])


def format_table(result: dict[str, Any]) -> list[str]:
    reference = "no C compiler" if result["missed_c"] is None else f"reference loop in C {result['missed_c']}"
    lines = [
        f"{result['minutes']:.1f} minutes, {result['ticks']} ticks: {result['missed']} deadlines missed ({reference}), "
        f"{result['lost']} ticks lost by {SUBSCRIBERS} subscribers",
        f"  {'':<40}{'MB':>8}{'an hour':>10}{'descriptors':>13}{'threads':>9}",
    ]
    for name, statistics in result["processes"].items():
        memory = statistics["resident_mb"]
        counts = f"{statistics['descriptors']['last']:>13.0f}{statistics['threads']['last']:>9.0f}"
        lines.append(f"  {name:<40}{memory['last']:>8.1f}{memory['an_hour']:>+10.2f}{counts}")
    return lines + [f"  {fault}" for fault in result["faults"]]


def stop_on_sigterm() -> threading.Event:
    """Return an event that SIGTERM sets, and print that the process is at work."""
    stopped = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopped.set())
    print("at work", flush=True)
    return stopped


def receive(endpoint: str) -> None:
    """Run a subscriber that counts the ticks it did not receive and prints them on SIGTERM."""
    stopped, lost_ticks = stop_on_sigterm(), 0
    with subscribe(endpoint) as samples:
        while not stopped.is_set():
            if (sample := samples.receive(0.1)) is not None:
                lost_ticks += sample.lost
    print(lost_ticks)


def connect_to_page(address: str) -> ClientConnection:
    """Open the socket of the page at an address, as a browser does."""
    import viser
    from websockets.sync.client import connect
    from websockets.typing import Origin, Subprotocol

    url = urlsplit(address)
    return connect(
        f"ws://{url.netloc}{url.path}",
        origin=Origin(f"http://{url.netloc}"),
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        max_size=None,
    )


def look_on(address: str) -> None:
    """Run a client of the page's socket that receives everything a browser would, and answers nothing."""
    with connect_to_page(address) as page:
        print("at work", flush=True)
        for _ in page:
            pass


def repeat_in_c(program: str, rate_hz: str, realtime: str, priority: str) -> None:
    """Run the C loop in turns; print the deadlines that it missed on SIGTERM."""
    setting = {"servo.realtime": "off"} if realtime == "off" else {"servo.priority": int(priority)}
    rig = load_rig("simulated", {"servo.rate_hz": float(rate_hz), **setting})
    stopped, missed = stop_on_sigterm(), 0
    while not stopped.is_set():
        rows = run_reference(Path(program), rig, round(C_TURN_S * rig.servo.rate_hz))
        missed += int(np.floor(rows[:, 0] * rig.servo.rate_hz).sum())
    print(missed)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["--c", program, rate_hz, realtime, priority]:
            repeat_in_c(program, rate_hz, realtime, priority)
        case ["--page", address]:
            look_on(address)
        case [endpoint]:
            receive(endpoint)
