"""Run the suite in concurrent parts. Arguments are passed to pytest, except the first if it is one of these:

    --system    tests that need Debian packages: emulated USB devices, a browser
    --rest      tests of `make test-all` that `make test` skips
    --coverage  `make test` with coverage of lines and branches

Parts:

    logic       marked `plain`: kernels as plain Python, which builds a scene in a millisecond instead of compiling for
                seconds; `make test-all` runs the same tests compiled, with the same results
    compiled    all others
    rt server   marked `real_time`, in tests/server
    rt others   marked `real_time`, in other folders; these two mostly wait for the clock, so they share the processors
                with the other parts, which have a lower priority
    put off     failed tests of the last two, repeated at the end without other load

Each process imports the tests that it runs, 4 to 8 CPU s, so each part is one process with separate files.
"""

import contextlib
import json
import os
import queue
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

HERE: Final = Path(__file__).parent
NICE: Final = 7
"""Niceness of computing parts: real-time code runs first when it wakes, and so do the kernel threads that pass on the
bytes of a pseudo terminal. With 19, other programs on the machine would leave these parts 1.5 % of a processor. Linux
compares sessions before the niceness within one (`autogroup` in sched(7)), so each of these parts is a session."""
LESS_NICE: Final = 5
"""Niceness of the part that would otherwise run last, on one of two processors."""
WELL: Final = (0, 5)
"""Exit codes of pytest without a failed test; 5: no test was selected."""

ENVIRONMENT: Final = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
"""Some build machines disable bytecode; the tests start hundreds of programs, each of which would compile its
modules."""

CPU_FOLDER: Final = HERE.parent / "build" / "cpu-seconds"
"""Folder with a JSON file per part: CPU seconds of each test of the last run."""
MOST_EXPENSIVE: Final = 20

HANG_S: Final = 300.0
SAMPLE_S: Final = 0.3
"""CPU seconds of the measurement of `hang_limit`: three periods of a Linux quota of 0.1 s."""

LOOPS: Final = """
from softfinger.config.load import load_scene
from softfinger.server.cli import main
from softfinger.server.driver_contract import PULL
from softfinger.server.services.compilation import compile_loop
main(["warmup", "--quiet", "paper-plane"])
compile_loop(load_scene(PULL))
"""
"""Program that compiles the loops of the default scene and of the driver tests."""
DRIVERS: Final = (("serial",), ("falcon", "forcedimension", "haply", "hid", "openhaptics", "simulated", "spacemouse"))
"""Drivers whose exchanges would otherwise be compiled by two processes at about the same time."""

Lines = queue.SimpleQueue[tuple[Any, str | None]]
"""Output lines, each with the part that wrote it; None at its end."""


class Part(NamedTuple):
    """One run of pytest: its name, marks of its tests, further arguments, environment, niceness."""

    name: str
    marks: str
    words: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] = ()
    nice: int = NICE


PLAIN_VARIABLE: Final = "SOFTFINGER_TESTS_ARE_PLAIN"
"""Set in the logic part, where `tests/proxy/test_plain_python.py` checks that kernels are plain Python."""
BY_FILE: Final = ("--max-worker-restart=0", "--dist", "loadfile", "-n")
"""Distribute files to this many processes. A process that dies is not replaced: the run would never end (pytest-xdist
3.8, issue 1378). Its current test fails, and the other processes run the remaining tests."""
QUICKLY: Final = "not exhaustive and not system"
QUICK: Final = (
    Part("logic", f"plain and {QUICKLY}", environment=(("NUMBA_DISABLE_JIT", "1"), (PLAIN_VARIABLE, "1"))),
    Part("compiled", f"not plain and not real_time and {QUICKLY}", nice=LESS_NICE),
)
REAL_TIME: Final = tuple(
    Part(f"rt {files}", f"real_time and {QUICKLY}", (f"--files={files}",), nice=0) for files in ("server", "others")
)
"""Run concurrently with the parts above and each other. Real-time tests wait two thirds of the time, so two processes
take half of it."""
PUT_OFF: Final = Part("put off", "real_time", nice=0)
"""Run afterwards: the failed tests of the real-time parts."""

SYSTEM: Final = (Part("system", "system and not exhaustive", nice=0),)
"""Run separately: a browser that renders without a graphics card needs both processors."""

MORE: Final = ("--exhaustive", "--hypothesis-profile=full")
REST: Final = (
    Part("compiled", "(plain or exhaustive or scaled) and not real_time", (*MORE, *BY_FILE, "logical")),
    Part("real time", "(exhaustive or scaled) and real_time", MORE, nice=0),
)
"""Run sequentially: the first part uses all processors."""


class Running:
    """Process of a part. Its lines are put into a queue, followed by None."""

    def __init__(self, part: Part, words: Sequence[str], lines: Lines, covered: bool = False) -> None:
        self.part = part
        self.cpu_file = CPU_FOLDER / f"{part.name.replace(' ', '-')}.json"
        self.cpu_file.unlink(missing_ok=True)
        self.report: list[str] = []
        """All lines from the first section heading."""
        self.other_lines: list[str] = []
        """Other lines except progress: headings, and output of a crashed process."""
        pytest = [*(["coverage", "run", "-m"] if covered else []), "pytest"]
        self.process = subprocess.Popen(
            [sys.executable, "-m", *pytest, "-m", part.marks, f"--cpu-report={self.cpu_file}", *part.words, *words],
            cwd=HERE.parent,
            env=ENVIRONMENT | dict(part.environment),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        if part.nice:
            os.setpriority(os.PRIO_PROCESS, self.process.pid, part.nice)
            with contextlib.suppress(OSError):  # a kernel without autogroups compares single threads
                Path(f"/proc/{self.process.pid}/autogroup").write_text(str(part.nice))
        threading.Thread(target=self._read, args=(lines,), daemon=True).start()

    def interrupt(self) -> None:
        """Interrupt like Ctrl-C, which reaches only one session."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGINT)

    def _read(self, lines: Lines) -> None:
        for line in self.process.stdout:
            lines.put((self, line.rstrip("\n")))
        lines.put((self, None))


def run(parts: Sequence[Part], words: Sequence[str], covered: bool = False) -> list[Running]:
    """Run parts concurrently; print their progress immediately, and the report of each when it ends."""
    lines = Lines()
    running = [Running(part, words, lines, covered) for part in parts]
    going = len(running)
    while going:
        try:
            part, line = lines.get()
        except KeyboardInterrupt:
            for part in running:
                print(f"\n--- {part.part.name}, interrupted ---", *part.other_lines, sep="\n", flush=True)
                part.interrupt()
            continue
        if line is None:
            if part.process.wait() not in WELL:
                print(f"\n--- {part.part.name}, before ---", *part.other_lines, sep="\n", flush=True)
            going -= 1
            print(f"\n--- {part.part.name} ---", *part.report, sep="\n", flush=True)
        elif part.report or (line.startswith("=") and "test session starts" not in line):
            part.report.append(line)
        elif line.endswith("%]"):
            print(f"{part.part.name:>9} | {line}", flush=True)
        else:
            part.other_lines.append(line)
    return running


def hang_limit() -> str:
    """Return pytest's option for the time after which a test counts as hung.

    It is five minutes times the seconds that a CPU second takes here: 3 under a quota of 35 %.
    """
    wall, cpu = time.monotonic(), time.process_time()
    while time.process_time() - cpu < SAMPLE_S:
        pass
    seconds_per_cpu_second = max((time.monotonic() - wall) / SAMPLE_S, 1.0)
    return f"-o faulthandler_timeout={HANG_S * seconds_per_cpu_second:.0f}"


def compile_kernels() -> None:
    """Compile kernels that several processes would otherwise compile concurrently: drivers, and the most used loops."""
    programs = ["; ".join(f"import softfinger.drivers.{name}.device" for name in names) for names in DRIVERS]
    compiling = [subprocess.Popen([sys.executable, "-c", program], env=ENVIRONMENT) for program in programs]
    for process in compiling:
        process.wait()  # the tests report import errors
    subprocess.run([sys.executable, "-c", LOOPS], env=ENVIRONMENT, stdout=subprocess.DEVNULL, check=False)


def quick(words: Sequence[str], covered: bool) -> list[Running]:
    """Run `make test`; finally repeat failed real-time tests without other load."""
    compile_kernels()
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / part.name for part in REAL_TIME]
        parts = zip(REAL_TIME, files, strict=True)
        real_time = [part._replace(words=(*part.words, f"--put-off={file}")) for part, file in parts]
        ended = run([*QUICK, *real_time], words, covered)
        if named := tuple(f"@{file}" for file in files if file.exists() and file.stat().st_size):
            ended += run([PUT_OFF._replace(words=named)], (), covered)
    return ended


def outcome(ended: Sequence[Running]) -> tuple[dict[str, int], bool]:
    """Return the numbers of passed, failed and skipped tests, and whether all parts succeeded."""
    counts = {"passed": 0, "failed": 0, "skipped": 0}
    for part in ended:
        for number, word in re.findall(r"(\d+) (\w+)", part.report[-1] if part.report else ""):
            name = "failed" if word.startswith("error") else word
            counts[name] = counts.get(name, 0) + int(number)
    return counts, all(part.process.returncode in WELL for part in ended)


def print_cpu_table(ended: Sequence[Running]) -> None:
    """Print the CPU seconds of the run, and the most expensive tests."""
    tests: list[tuple[list[float], str, str]] = []
    for part in ended:
        if part.cpu_file.exists():
            cpu = json.loads(part.cpu_file.read_text("utf-8"))
            tests += [(seconds, part.part.name, test) for test, seconds in cpu.items()]
    used = os.times()
    total = used.children_user + used.children_system
    process, compile, programs = (sum(seconds[i] for seconds, _, _ in tests) for i in range(3))
    print("\nCPU seconds:")
    print(f"{total:8.1f}  in all")
    print(f"{process - compile:8.1f}  tests in their own process, without compiling")
    print(f"{compile:8.1f}  compiling in that process")
    print(f"{programs:8.1f}  programs that tests started")
    print(f"{total - process - programs:8.1f}  starting pytest, collecting")
    print(f"\nThe {MOST_EXPENSIVE} most expensive tests: process, of which compiling, programs (all: {CPU_FOLDER}):")
    for seconds, part_name, test in sorted(tests, key=lambda row: -row[0][0] - row[0][2])[:MOST_EXPENSIVE]:
        print("".join(f"{value:7.1f}" for value in seconds), f" {part_name:>9} | {test}")


def main(words: list[str]) -> int:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    CPU_FOLDER.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    ENVIRONMENT["PYTEST_ADDOPTS"] = f"{os.environ.get('PYTEST_ADDOPTS', '')} {hang_limit()}".strip()
    wanted = words.pop(0) if words and words[0] in ("--rest", "--system", "--coverage") else ""
    if wanted in ("--rest", "--system"):
        ended = [part for separate in (REST if wanted == "--rest" else SYSTEM) for part in run([separate], words)]
    else:
        ended = quick(words, covered=wanted == "--coverage")
    counts, well = outcome(ended)
    print_cpu_table(ended)
    print(f"\nin {time.monotonic() - began:.0f} s:")
    print(f"{counts['passed']} passed, {counts['failed']} failed, {counts['skipped']} skipped")
    return 0 if well else 1


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
