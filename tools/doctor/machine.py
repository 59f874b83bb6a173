"""Result of a check, and checks of system information without a measurement: Python, packages, processors, clock.

System files are read below `root`, so that a test can use the files of another machine.
"""

from __future__ import annotations

import os
import platform
import re
import time
from importlib import metadata
from pathlib import Path
from typing import Final, Literal, NamedTuple

State = Literal["good", "could be better", "bad"]
STATES: Final[tuple[State, ...]] = ("good", "could be better", "bad")


class Check(NamedTuple):
    """Observation, expectation, and the command or setting as the remedy; a good state has no remedy."""

    name: str
    state: State
    seen: str
    wanted: str
    remedy: str = ""


def grade(value: float, fair: float, bad: float) -> State:
    """Return the state of a number that is good up to `fair` and bad above `bad`."""
    return STATES[(value > fair) + (value > bad)]


def format_lines(checks: list[Check]) -> list[str]:
    text = []
    for check in checks:
        text.append(f"  {check.state:<16}{check.name}: {check.seen}")
        if check.state != "good":
            text.append(f"  {'':<16}  wanted: {check.wanted}")
            if check.remedy:
                text.append(f"  {'':<16}  remedy: {check.remedy}")
    return text


ROOT: Final = Path("/")
CPUS: Final = Path("sys/devices/system/cpu")
CLOCK: Final = Path("sys/devices/system/clocksource/clocksource0/current_clocksource")

FAST_CLOCKS: Final = ("tsc", "kvm-clock", "hyperv_clocksource_tsc_page", "arch_sys_counter")
"""Clock sources that the C library reads without a system call; the loop reads the clock three times a tick."""
RESOLUTION_S: Final = 1e-6
"""A coarser resolution means no high-resolution timers: sleeps then end on the scheduler's tick, 1 to 10 ms apart."""
PROCESSORS: Final = 2
"""One for the servo and one for other threads: on a single processor, every message delays a tick."""
CONTAINER_WORDS: Final = re.compile(r"docker|containerd|kubepods|libpod|lxc")


def list_checks(root: Path = ROOT) -> list[Check]:
    return [
        check_python(),
        check_packages(),
        check_kernel(root),
        check_virtual(root),
        check_processors(root),
        check_frequency(root),
        check_clock(root),
    ]


def read_system_file(path: Path) -> str:
    """Return the stripped contents of a system file, empty if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip("\0\n ")
    except OSError:
        return ""


def check_python() -> Check:
    expected = metadata.metadata("softfinger")["Requires-Python"]
    return Check("Python", "good", f"{platform.python_implementation()} {platform.python_version()}", expected)


def list_versions() -> dict[str, str]:
    """Return the version of every package that softfinger needs, empty if it is not installed; without extras."""
    result = {}
    for requirement in metadata.requires("softfinger") or []:
        name, _, condition = requirement.partition(";")
        if "extra" in condition:
            continue
        name = (re.match(r"[A-Za-z0-9_.-]+", name) or [name])[0]
        try:
            result[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            result[name] = ""
    return result


def check_packages() -> Check:
    installed = list_versions()
    missing = [name for name, version in installed.items() if not version]
    state = ", ".join(f"{name} {version or 'MISSING'}" for name, version in installed.items())
    return Check(
        "packages", "bad" if missing else "good", state, "every one installed", f"pip install {' '.join(missing)}"
    )


def check_kernel(root: Path = ROOT) -> Check:
    is_realtime = read_system_file(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in platform.version()
    return Check(
        "system",
        "good" if is_realtime else "could be better",
        f"{platform.system()} {platform.release()}, {'' if is_realtime else 'not '}PREEMPT_RT",
        "Linux with PREEMPT_RT, which bounds the worst tick",
        ""
        if is_realtime
        else "apt install linux-image-rt-amd64, or your distribution's PREEMPT_RT kernel, and boot it",
    )


def check_virtual(root: Path = ROOT) -> Check:
    """Check for a virtual machine, which its host may stall, and for a container, which may lack rights and nodes."""
    remedies: dict[str, str] = {}
    machine = " ".join(
        filter(None, (read_system_file(root / "sys/class/dmi/id" / key) for key in ("sys_vendor", "product_name")))
    )
    if re.search(r"^flags\s*:.*\bhypervisor\b", read_system_file(root / "proc/cpuinfo"), re.MULTILINE):
        guest = f"virtual machine{f' ({machine})' if machine else ''}, {measure_stolen_share(root)}"
        remedies[guest] = "run on the machine itself: a host stalls its guests for milliseconds"
    if (
        (root / ".dockerenv").exists()
        or (root / "run/.containerenv").exists()
        or CONTAINER_WORDS.search(read_system_file(root / "proc/1/cgroup"))
    ):
        remedies["container"] = "give the container the options in docs/operate/docker.md"
    expected = "neither virtual machine nor container"
    state: State = "could be better" if remedies else "good"
    return Check("bare machine", state, "; ".join(remedies) or expected, expected, "; ".join(remedies.values()))


def measure_stolen_share(root: Path = ROOT) -> str:
    """Return the share of time that the host has taken from this machine since its start."""
    words = read_system_file(root / "proc/stat").partition("\n")[0].split()[1:9]
    if len(words) < 8 or not sum(map(int, words)):
        return "time taken by its host unknown"
    return f"{int(words[7]) / sum(map(int, words)):.2%} of its time taken by its host"


def check_processors(root: Path = ROOT) -> Check:
    usable = os.sched_getaffinity(0)
    state = f"{len(usable)} of {os.cpu_count()} may be used"
    if read_system_file(root / CPUS / "smt" / "active") == "1":
        state += ", two threads to a core"
    if isolated := read_system_file(root / CPUS / "isolated"):
        state += f", isolated: {isolated}"
    return Check(
        "processors",
        "good" if len(usable) >= PROCESSORS else "could be better",
        state,
        f"{PROCESSORS} or more",
        "give this process another processor: taskset, or --cpus and --cpuset-cpus of a container",
    )


def check_frequency(root: Path = ROOT) -> Check:
    """Check the governor of every processor; power saving makes a processor wake slowly and run at a low clock."""
    governors = {read_system_file(path) for path in (root / CPUS).glob("cpu[0-9]*/cpufreq/scaling_governor")} - {""}
    return Check(
        "processor frequency",
        "good" if governors <= {"performance"} else "could be better",
        f"governor {', '.join(sorted(governors))}" if governors else "no frequency scaling found",
        "governor performance, or no scaling",
        "sudo cpupower frequency-set -g performance",
    )


def check_clock(root: Path = ROOT) -> Check:
    source, resolution = read_system_file(root / CLOCK), time.get_clock_info("monotonic").resolution
    state = f"{source or 'source unknown'}, resolution {resolution * 1e9:.0f} ns"
    expected = f"one of {', '.join(FAST_CLOCKS)}; a resolution of {RESOLUTION_S * 1e9:.0f} ns or finer"
    if resolution > RESOLUTION_S:
        return Check("clock", "bad", state, expected, "boot a kernel with CONFIG_HIGH_RES_TIMERS, without highres=off")
    if source and source not in FAST_CLOCKS:
        remedy = f"echo tsc | sudo tee /{CLOCK}   # if available_clocksource in the same folder lists tsc"
        return Check("clock", "could be better", state, expected, remedy)
    return Check("clock", "good", state, expected)
