"""Times of drivers on test doubles: `python tests/driver_times.py cost` and `... age`.

cost (`make exchange-cost`): time of a driver's tick in addition to its C calls. A compiled loop times read and write of
the driver, called like in the servo, alternating with the same C calls without the driver, with the same arguments on
the same double, so that the caches are warm. The driver's own time is the difference of the medians; its range is that
over twenty parts of the run. The time of the double is part of both.

age (`make handover-age`): age of a pose when the servo reads it, and of a force when the device has it, for drivers
that exchange both with a thread or a vendor's library. The double's pose contains the time at which it was made, by a
clock that all processes share, and its log has the arrival time of each force. Both ages therefore include messages,
sockets, threads and their delays.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numba
import numpy as np
from helpers.c_stub import COMPILER, NO_COMPILER
from helpers.timed_drivers import AGE_CASES, BUFFER, COST_CASES, ON_STUBS, Array, Case, End

from softfinger.config.errors import DeviceTimeout, HapticError
from softfinger.drivers.base import OK, SAMPLE_SIZE, DeviceIO
from softfinger.drivers.system.libc import read_fd, write_fd
from softfinger.proxy.kernels.jit.atomics import call_device
from softfinger.proxy.kernels.jit.decorators import OPTIONS
from softfinger.server.driver_contract import RATE_HZ
from softfinger.server.loop.clock import read_clock_ns, sleep_until
from softfinger.tools import measure
from softfinger.tools.options import add_output_options

PARTS: Final = 20
TRIES: Final = 100
WARM_TICKS: Final = 200
"""Left out at the beginning of a measurement of ages."""
LOWEST_N: Final = 0.1
STEP_N: Final = 1e-4
FORCES: Final = 1000
"""Number of distinct forces: LOWEST_N and steps above it, in turn; a force is never older than a second."""


@numba.njit(**OPTIONS)
def _tick(io: DeviceIO, sample: Any, wrench: Any, timespec: Any) -> tuple[int, int]:
    """Time (ns) and status of one tick: OK after a new sample and a complete write, negative after an error."""
    begun = read_clock_ns(timespec)
    status = call_device(io.read, io.handle, sample)
    written = call_device(io.write, io.handle, wrench)
    return read_clock_ns(timespec) - begun, status if status < 0 else max(status, written)


@numba.njit(**OPTIONS)
def _measure_cost(calls: Any, peer: int, wait_ns: int, report: Any, memory: Any, out: Any, whole: Any) -> int:
    """Measure driver and direct `calls` alternately into `out` (n, 2) ns; return n, or the tick of a failure."""
    sample, wrench, timespec, buffer = memory
    io, bare = calls
    for n in range(len(out)):
        for series in range(2):
            if peer >= 0:
                while read_fd(peer, buffer.ctypes.data, BUFFER) > 0:
                    pass
                write_fd(peer, report.ctypes.data, len(report))
            if wait_ns > 0:
                sleep_until(read_clock_ns(timespec) + wait_ns, timespec)
            out[n, series], status = _tick(io if series == 0 else bare, sample, wrench, timespec)
            if series == 0:
                whole[n] = status == OK
                if status < 0:
                    return n
    return len(out)


@numba.njit(**OPTIONS)
def _measure_age(ios: Any, period_ns: int, times: Any, places: Any, fresh: Any, memory: Any) -> int:
    """Read and write every device in each tick; return the negative status that ended it, or 0.

    times   (n, devices, 2) int64 ns    out: after the read, before the write
    places  (n, devices) float64 m      out: x of the sample
    fresh   (n, devices) bool           out: whether the sample is new
    memory  sample, wrench, timespec
    """
    sample, wrench, timespec = memory
    deadline = read_clock_ns(timespec)
    for n in range(len(times)):
        deadline += period_ns
        sleep_until(deadline, timespec)
        wrench[2] = LOWEST_N + STEP_N * (n % FORCES)
        for k in range(len(ios)):
            io = ios[k]
            status = call_device(io.read, io.handle, sample)
            times[n, k, 0] = read_clock_ns(timespec)
            if status < 0:
                return status
            places[n, k], fresh[n, k] = sample[0], status == OK
            times[n, k, 1] = read_clock_ns(timespec)
            call_device(io.write, io.handle, wrench)
    return 0


def find_cost(case: Case, args: argparse.Namespace) -> dict[str, float]:
    """Return medians, their difference with its range over the run, s, and the fraction of complete ticks."""
    out, whole = np.zeros((args.ticks, 2), np.int64), np.zeros(args.ticks, np.bool_)
    wrench = np.array([0.1, -0.2, 0.3, 0.0, 0.0, 0.0])
    memory = (np.zeros(SAMPLE_SIZE), wrench, np.zeros(2, np.int64), np.zeros(BUFFER, np.uint8))
    report = np.frombuffer(case.answer, np.uint8).copy()
    calls = (case.io, case.bare)
    for many in (1, args.ticks):  # the first call compiles
        count, tries = 0, 0
        while count < many:
            case.wake()
            count += _measure_cost(calls, case.peer, case.wait_ns, report, memory, out[count:many], whole[count:many])
            tries += 1
            if tries > TRIES:
                raise DeviceTimeout(f"the driver failed in {tries} ticks of {count}: is this machine busy?")
    return summarize_cost(out * 1e-9) | {"whole": float(np.mean(whole))}


def summarize_cost(seconds: Array) -> dict[str, float]:
    """Return the figures of the times (n, 2), s, of a driver and of the bare calls."""
    parts = [np.median(part, axis=0) for part in np.array_split(seconds, min(PARTS, len(seconds)))]
    between = [float(driver - bare) for driver, bare in parts]
    driver, bare = (float(value) for value in np.median(seconds, axis=0))
    return {"driver": driver, "bare": bare, "own": driver - bare, "least": min(between), "most": max(between)}


def find_ages(ends: list[End], args: argparse.Namespace) -> dict[str, Any]:
    """Return ages (s) of the poses that were new and of the forces that arrived, and the shares of both."""
    time.sleep(0.1)
    count, whole = len(ends), args.ticks + WARM_TICKS
    times, places = np.zeros((whole, count, 2), np.int64), np.zeros((whole, count))
    fresh = np.zeros((whole, count), np.bool_)
    memory = (np.zeros(SAMPLE_SIZE), np.zeros(6), np.zeros(2, np.int64))
    ios = tuple(end.device.io() for end in ends)
    period_ns = round(1e9 / RATE_HZ)
    _measure_age(ios, period_ns, times[:0], places[:0], fresh[:0], memory)  # compiles
    for end in ends:
        end.device.arm()
    status = _measure_age(ios, period_ns, times, places, fresh, memory)
    if status < 0:
        raise DeviceTimeout(f"a device failed with status {status} ({ends[0].device.reason()}): is this machine busy?")
    for end in ends:
        end.device.stop()
    keep = slice(WARM_TICKS, None)
    poses = ((times[keep, :, 0] * 1e-9 - places[keep]) % 1.0)[fresh[keep]]
    forces = np.concatenate(
        [force_ages(end.received_forces(), times[:, k, 1] * 1e-9)[keep] for k, end in enumerate(ends)]
    )
    arrived = np.isfinite(forces)
    shares = {"new": float(np.mean(fresh[keep])), "arrived": float(np.mean(arrived))}
    return {"pose": find_quantiles(poses), "force": find_quantiles(forces[arrived])} | shares


def force_ages(arrivals: Array, written: Array) -> Array:
    """Return the time (s) from each write (n,) until the double first had its force; NaN if a newer one replaced it."""
    ages_s = np.full(len(written), np.nan)
    ticks = np.arange(len(written))
    for at, force in arrivals[arrivals[:, 1] > 0.5 * LOWEST_N]:
        kind = round((force - LOWEST_N) / STEP_N)
        before = ticks[(ticks % FORCES == kind) & (written <= at)]
        if len(before) and np.isnan(ages_s[before[-1]]):
            ages_s[before[-1]] = at - written[before[-1]]
    return ages_s


def find_quantiles(values: Array) -> dict[str, float]:
    if not len(values):
        raise DeviceTimeout("nothing was handed over: is this machine busy?")
    return {name: float(np.quantile(values, q)) for name, q in (("p50", 0.5), ("p99", 0.99), ("most", 1.0))}


def cost_bars(costs: dict[str, Any]) -> dict[str, float]:
    """Return the medians of driver and bare calls, and their difference, us."""
    return {f"{name}, {key}": cost[key] * 1e6 for name, cost in costs.items() for key in ("driver", "bare", "own")}


def age_bars(ages: dict[str, Any]) -> dict[str, float]:
    """Return median and 99th percentile of each age, us."""
    return {
        f"{name}, {quantity}, {key}": age[quantity][key] * 1e6
        for name, age in ages.items()
        for quantity in ("pose", "force")
        for key in ("p50", "p99")
    }


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    measurements = parser.add_subparsers(dest="measurement", required=True)
    kinds: dict[str, Any] = {
        "cost": (COST_CASES, find_cost, cost_bars, "us a tick", 100_000),
        "age": (AGE_CASES, find_ages, age_bars, "age, us", 10_000),
    }
    for kind, (cases, *_, ticks) in kinds.items():
        options = measurements.add_parser(kind)
        options.add_argument("--driver", choices=cases, action="append", help="measure this one; any number of times")
        options.add_argument("--ticks", type=int, default=ticks, metavar="N", help="(default: %(default)s)")
        add_output_options(options)
    args = parser.parse_args(words)
    if args.ticks < 1:
        parser.error("--ticks must be 1 or more")
    cases, find, bars, unit, _ = kinds[args.measurement]
    results = {}
    try:
        for name in args.driver or cases:
            if COMPILER is None and name in ON_STUBS:
                print(f"{name}: left out: {NO_COMPILER}", file=sys.stderr)
                continue
            with tempfile.TemporaryDirectory() as folder, cases[name](Path(folder)) as case:
                results[name] = find(case, args)
    except HapticError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    values = bars(results)
    lines = [f"{name:28}{value:9.2f} {unit}" for name, value in values.items()]
    result = {"ticks": args.ticks, "seconds": results}
    return measure.show_and_draw(args, result, lines, lambda path: measure.draw_bars(path, values, unit))


if __name__ == "__main__":
    sys.exit(main())
