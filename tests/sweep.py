"""A sweep: mistakes planted by rule in what keeps a hand safe, each of which a test has to catch.

    python tests/mutants.py --sweep [--count N] [--seed S] [--only TEXT] [--json FILE]

Everything is imported once, with kernels as plain Python and the drivers' exchanges too (helpers/plain_exchange.py).
The tests are run once without a mistake, which tells what each of them calls, and which fail here, as those that look
at machine code do: they count for nothing. Then each mistake has a process of its own, a fork, which runs the tests
that call the function, the quickest first, until one fails: the mistake is caught. So it is where the process crashes
or uses up its time of the processor. Where the wall clock ends the process, or it says nothing, the mistake is
undecided: not caught, and not kept in the file of --json, with which a sweep goes on where it was ended. What needs the
clock is asked again without the mistake: a test that fails then, too, has caught nothing.

`[[equivalent]]` of mutants.toml lists what no test can tell, each with its reason.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import os
import random
import resource
import signal
import sys
import threading
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, Final, NamedTuple

ROOT: Final = Path(__file__).resolve().parents[1]


class Part(NamedTuple):
    """A part of the program: its files, and those of the tests that concern it. Of them those that call what a mistake
    is in are run."""

    files: tuple[str, ...]
    tests: tuple[str, ...]


PARTS: Final = {
    "guard": Part(("server/loop/guard.py",), ("server/test_guard",)),
    "limits": Part(("server/loop/limits.py", "server/loop/output.py"), ("server/test_limits",)),
    "shutdown": Part(
        ("server/closing.py", "drivers/open_devices.py", "server/loop/shutdown.py"),
        ("server/test_shutdown", "server/test_supervisor"),
    ),
    "supervisor": Part(("server/services/supervisor.py",), ("server/test_supervisor",)),
    "states": Part(("server/states.py",), ("server/test_states",)),
    "arming": Part(("server/services/arming.py",), ("server/test_arming_by_record",)),
    "conversation": Part(
        ("drivers/board_exchange.py",),
        (
            "drivers/test_board_exchange",
            "drivers/test_serial_device",
            "drivers/test_hid_device",
            "drivers/test_withheld",
        ),
    ),
    "serial": Part(
        ("drivers/serial/exchange.py",),
        ("drivers/test_serial_exchange", "drivers/test_serial_device", "drivers/test_serial_boards"),
    ),
    "hid": Part(
        ("drivers/hid/exchange.py",),
        ("drivers/test_hid_exchange", "drivers/test_hid_device", "drivers/test_hid_threads"),
    ),
    "haply": Part(("drivers/haply/exchange.py",), ("drivers/test_haply_exchange", "drivers/test_haply_device")),
    "falcon": Part(
        ("drivers/falcon/exchange.py",),
        ("drivers/test_falcon_exchange", "drivers/test_falcon_stub", "drivers/test_falcon_withheld"),
    ),
    "forcedimension": Part(
        ("drivers/forcedimension/exchange.py",), ("drivers/test_forcedimension_exchange", "drivers/test_forcedimension")
    ),
    "openhaptics": Part(
        ("drivers/openhaptics/exchange.py",), ("drivers/test_openhaptics_exchange", "drivers/test_openhaptics")
    ),
}
COMPILED: Final = ("arming_is_the_last_act", "after_a_servo", "ends_with_a_failing", "allocates_nothing")
"""Words in the names of tests that need machine code; without these a sweep begins minutes earlier."""
CPU_S: Final = 60
"""Of the processor, for the tests of one mistake: it may make a loop endless, and a busy machine makes none."""
WALL_S: Final = 600.0
CRASHES: Final = (signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGXCPU)
"""What a mistake can end its process by, the last at its limit of the processor. Other signals are from outside."""
CAUGHT, SURVIVED, EQUIVALENT, UNDECIDED = "caught", "SURVIVED", "equivalent", "UNDECIDED"


class Ended(Enum):
    """How a fork ended that returned nothing."""

    CRASHED = "by a signal of its own, or at its limit of the processor"
    LATE = "ended by the wall clock, or from outside"
    NOTHING = "without a word: what it was to do was not done to the end"


class Seen(NamedTuple):
    """What a test called, `file function`, and how long it took (s)."""

    calls: list[str]
    seconds: float


def in_fork(do: Callable[[], Any], limit_s: int = 0) -> Any:
    """What `do` returns in a fork of this process, through JSON; how the fork ended where it returned nothing."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        os.close(reading)
        if limit_s:
            resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s + 5))  # SIGXCPU, SIGKILL
        with contextlib.suppress(BaseException), open(os.devnull, "r+") as nowhere:
            for stream in (0, 1, 2):
                os.dup2(nowhere.fileno(), stream)
            os.write(writing, json.dumps(do()).encode())
        os._exit(0)
    os.close(writing)
    ender = threading.Timer(WALL_S * (1 if limit_s else 10), os.kill, (child, signal.SIGKILL))
    ender.start()
    with open(reading, "rb") as pipe:
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        ender.cancel()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # what a test of it has started
        said = pipe.read()
    if code < 0:
        return Ended.CRASHED if -code in CRASHES else Ended.LATE
    return json.loads(said) if said else Ended.NOTHING


class Sweep:
    """A plugin of pytest: in the place of running the tests it plants mistakes."""

    def __init__(self, mistakes: list[Any], args: argparse.Namespace) -> None:
        self.mistakes, self.args = mistakes, args
        self.failed = False
        self.results: dict[str, str] = {}

    def pytest_configure(self) -> None:
        from hypothesis import Phase, settings

        settings.register_profile("sweep", settings.get_profile("suite"), phases=[Phase.explicit, Phase.generate])
        settings.load_profile("sweep")  # the smallest example of a failure is of no interest

    def pytest_runtest_logreport(self, report: Any) -> None:
        self.failed |= report.failed

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items[:] = [item for item in items if not any(word in item.name for word in COMPILED)]
        for item in items:  # of conftest.py: with kernels as plain Python there is no servo; but there is an exchange
            item.own_markers[:] = [mark for mark in item.own_markers if "DISABLE_JIT" not in str(mark.kwargs)]

    def pytest_runtestloop(self, session: Any) -> bool:
        from helpers import planting

        files = {mistake.file for mistake in self.mistakes}
        self.items = {item.nodeid: item for item in session.items}
        self.functions = planting.functions_of(ROOT, files)
        gc.collect()
        gc.freeze()
        seen = self.baseline(files)
        for number, mistake in enumerate(self.mistakes, 1):
            if mistake.name not in self.results:
                begun = time.monotonic()
                word = self.try_out(mistake, seen)
                self.results[mistake.name] = word
                print(
                    f"[{number}/{len(self.mistakes)}] {word:<9} {time.monotonic() - begun:5.1f} s  {mistake.name}",
                    flush=True,
                )
                if self.args.json:
                    decided = {name: how for name, how in self.results.items() if not how.startswith(UNDECIDED)}
                    self.args.json.write_text(json.dumps(decided, indent=0), "utf-8")
        return True

    def passes(self, item: Any) -> bool:
        self.failed = False
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=None)
        return not self.failed

    def baseline(self, files: set[str]) -> dict[str, Seen]:
        """What the tests call that pass without a mistake."""
        from helpers import planting

        def traced(item: Any) -> Any:
            calls = set[str]()

            def note(frame: Any, what: str, argument: Any) -> None:
                if what == "call" and (file := planting.file_of(ROOT, frame.f_code)) in files:
                    calls.add(f"{file} {frame.f_code.co_qualname}")

            begun = time.monotonic()
            threading.setprofile(note)
            sys.setprofile(note)
            passed = self.passes(item)
            sys.setprofile(None)
            return [sorted(calls), time.monotonic() - begun] if passed else None

        seen: dict[str, Seen] = {}
        for name, item in self.items.items():
            found = in_fork(lambda item=item: traced(item), CPU_S)
            if isinstance(found, list):
                seen[name] = Seen(*found)
            elif found is Ended.LATE:
                print(f"without a mistake the wall clock ended it here: {name}", flush=True)
            else:
                print(f"without a mistake it does not pass here: {name}", flush=True)
        print(f"{len(seen)} of {len(self.items)} tests pass without a mistake", flush=True)
        return seen

    def try_out(self, mistake: Any, seen: dict[str, Seen]) -> str:
        from helpers import planting

        function = f"{mistake.file} {mistake.function}"
        constant = mistake.function.isupper()  # which any test may look at
        tests = [name for name, one in seen.items() if constant or function in one.calls]
        tests.sort(key=lambda name: seen[name].seconds)

        def planted() -> str:
            planting.plant(ROOT, mistake, self.functions)
            return next((name for name in tests if not self.passes(self.items[name])), "")

        while True:
            by = in_fork(planted, CPU_S) if tests else ""
            if by is Ended.CRASHED:
                return f"{CAUGHT} by a crash or an endless loop"
            if isinstance(by, Ended):
                return f"{UNDECIDED}: {by.value}"
            if not by:
                return SURVIVED
            if not self.items[by].get_closest_marker("real_time"):
                return f"{CAUGHT} by {by}"
            passed = in_fork(lambda by=by: self.passes(self.items[by]), CPU_S)
            if passed in (Ended.LATE, Ended.NOTHING):
                return f"{UNDECIDED}: {by} without the mistake: {passed.value}"
            if passed is True:
                return f"{CAUGHT} by {by}"
            tests.remove(by)


def tell(mistakes: Sequence[Any], results: dict[str, str], excused: set[tuple[str, str, str]]) -> int:
    """A table by part; the survivors that are not listed, and the undecided. Returns how many those are."""
    rows, survivors = {name: Counter[str]() for name in PARTS}, []
    for mistake in mistakes:
        row = next(rows[name] for name, part in PARTS.items() if mistake.file in part.files)
        word = results[mistake.name].partition(" ")[0].rstrip(":")
        if word == SURVIVED:
            word = EQUIVALENT if (mistake.file, mistake.line, mistake.wrong) in excused else SURVIVED
        row[word] += 1
        if word in (SURVIVED, UNDECIDED):
            survivors.append(f"{word} {mistake.name}")
    print(f"\n{'part':<14}{'planted':>8}{'caught':>8}{'equivalent':>12}{'undecided':>11}{'survived':>10}")
    for part, row in [*rows.items(), ("all", sum(rows.values(), Counter()))]:
        if row.total():
            counts = f"{row[CAUGHT]:>8}{row[EQUIVALENT]:>12}{row[UNDECIDED]:>11}{row[SURVIVED]:>10}"
            print(f"{part:<14}{row.total():>8}{counts}")
    print(*survivors, sep="\n")
    return len(survivors)


def main(words: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="mutants.py --sweep", description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=0, help="so many, drawn by --seed; 0: all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", metavar="TEXT", help="those whose file, line or mistake has this in it")
    parser.add_argument("--json", type=Path, metavar="FILE", help="what became of each; what is there already is kept")
    args = parser.parse_args(words)
    os.environ["NUMBA_DISABLE_JIT"] = "1"  # before numba reads it
    from helpers import plain_exchange, planting

    plain_exchange.install()
    files = [file for part in PARTS.values() for file in part.files]
    mistakes = [each for file in files for each in planting.mistakes_in(ROOT, file) if args.only in each.name]
    if args.count:
        mistakes = sorted(random.Random(args.seed).sample(mistakes, min(args.count, len(mistakes))))
    if not mistakes:
        raise SystemExit(f"--only {args.only}: no mistake has this in its name")
    sweep = Sweep(mistakes, args)
    if args.json and args.json.exists():
        sweep.results = json.loads(args.json.read_text("utf-8"))
    import pytest

    parts = [part for part in PARTS.values() if any(each.file in part.files for each in mistakes)]
    tests = sorted({f"tests/{name}.py" for part in parts for name in part.tests})
    # the package is imported already, for the exchanges; it has no assertions that pytest would write anew
    options = ["-q", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
    pytest.main([*options, "-m", "not exhaustive", *tests], [sweep])
    listed = tomllib.loads((ROOT / "tests" / "mutants.toml").read_text("utf-8")).get("equivalent", [])
    excused = {(one["file"], one["line"], one["mistake"]) for one in listed}
    survived = tell(mistakes, sweep.results, excused)
    return 0 if survived <= 0.05 * len(mistakes) else 1


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
