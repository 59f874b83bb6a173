"""Real-time settings, read back from the kernel in separate processes, with and without privilege."""

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from helpers.programs import run_program

from softfinger.server.loop.realtime import LATENCY_DEVICE, REQUIRED

pytestmark = pytest.mark.real_time

# Runs in a child: reduces privileges as argv[1] specifies, applies the settings in a thread and prints the kernel's
# values.
CHILD = """
import ctypes, json, mmap, os, resource, sys, threading
from softfinger.config.errors import RealtimeError
from softfinger.server.loop import realtime

wish = json.loads(sys.argv[1])
for name, value in wish["limits"].items():
    resource.setrlimit(getattr(resource, name), (value, value))
libc = ctypes.CDLL(None)
if wish["drop"] and wish["root"]:
    os.setgroups([])
    os.setgid(65534)
    libc.prctl(8, 1, 0, 0, 0)  # PR_SET_KEEPCAPS: permitted, though no longer effective
    os.setuid(65534)
    kept = sum(1 << bit for bit in wish["keep"])
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # _LINUX_CAPABILITY_VERSION_3, this thread
    libc.capset(header, (ctypes.c_uint32 * 6)(kept, kept, 0, 0, 0, 0))
    libc.prctl(4, 1, 0, 0, 0)  # PR_SET_DUMPABLE, lost with the user: without it /proc/self/fd is closed to us
told = {"latency_device": os.access(realtime.LATENCY_DEVICE, os.W_OK)}

def status(key):
    lines = open("/proc/thread-self/status").read().splitlines()
    return int(next(line for line in lines if line.startswith(key + ":")).split()[1])

def faults():
    return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt

def look():
    links = [os.path.join("/proc/self/fd", fd) for fd in os.listdir("/proc/self/fd")]
    held = sum(os.path.lexists(link) and os.readlink(link) == realtime.LATENCY_DEVICE for link in links)
    return {
        "policy": os.sched_getscheduler(0), "priority": os.sched_getparam(0).sched_priority,
        "slack": libc.prctl(30, 0, 0, 0, 0), "cpus": sorted(os.sched_getaffinity(0)), "locked": status("VmLck"),
        "held": held,
    }

def touch(area):
    before = faults()
    for at in range(0, len(area), 4096):
        area[at] = 1
    return faults() - before

def nested():
    inner = []
    for _ in range(800):
        inner = [inner]
    return inner

def servo():
    early, large = mmap.mmap(-1, 2 << 20), mmap.mmap(-1, 64 << 20)
    one, other = nested(), nested()
    told["before"] = look()
    try:
        applied = realtime.apply(wish["mode"], wish["priority"], wish["cpu"])
    except RealtimeError as error:
        told["error"] = str(error)
        told["after"] = look()
        return
    told["settings"] = [s._asdict() for s in applied.settings]
    told["during"] = look()
    if told["during"]["held"]:
        with open(realtime.LATENCY_DEVICE, "rb") as device:
            told["latency_us"] = int.from_bytes(device.read(4), sys.byteorder, signed=True)
    before = faults()
    assert one == other  # goes down the stack, and nowhere else
    told["stack_faults"] = faults() - before
    told["early_faults"] = touch(early)
    told["large_faults"] = touch(memoryview(large)[: 1 << 20])
    resident = status("VmRSS")
    late = mmap.mmap(-1, 64 << 20)
    told["late_locked"] = status("VmLck") - told["during"]["locked"]
    told["late_resident"] = status("VmRSS") - resident
    told["late_faults"] = touch(memoryview(late)[: 1 << 20])
    applied.undo()
    applied.undo()
    told["after"] = look()

failed = []
threading.excepthook = failed.append
thread = threading.Thread(target=servo)
thread.start()
thread.join()
if failed:
    raise failed[0].exc_value
told["main_policy"] = os.sched_getscheduler(0)
print(json.dumps(told))
"""

UNPRIVILEGED = {"RLIMIT_RTPRIO": 0, "RLIMIT_MEMLOCK": 65536}


def run_child(mode: str = "auto", **changes: Any) -> dict[str, Any]:
    """Return the settings' effect in a new process with `limits`, without root if `drop`, but what to `keep`."""
    wish = {"mode": mode, "priority": 80, "cpu": None, "limits": {}, "drop": False, "keep": ()} | changes
    words = [sys.executable, "-c", CHILD, json.dumps(wish | {"root": has_capabilities(SETUID)})]
    report: dict[str, Any] = json.loads(run_program(words, check=True).stdout)
    report["by_name"] = {s["name"]: s for s in report.get("settings", [])}
    return report


def has_capabilities(*bits: int) -> bool:
    """Return True if this process has these capabilities."""
    with open("/proc/self/status", encoding="ascii") as file:
        line = next(line for line in file if line.startswith("CapEff:"))
    return all(int(line.split()[1], 16) >> bit & 1 for bit in bits)


SETUID, IPC_LOCK, SYS_NICE, SYS_RESOURCE = 7, 14, 23, 24
privileged = pytest.mark.skipif(
    not has_capabilities(SETUID, IPC_LOCK, SYS_NICE), reason="needs root with SETUID, SYS_NICE and IPC_LOCK"
)
raises_limits = pytest.mark.skipif(
    not has_capabilities(SETUID, SYS_RESOURCE),
    reason="needs root with SYS_RESOURCE and SETUID, to give a user higher limits",
)


def test_off_changes_nothing() -> None:
    report = run_child("off", cpu=0)
    assert [(s["name"], s["ok"]) for s in report["settings"]] == [("off", True)]
    assert report["during"] == report["before"]


@privileged
def test_everything_is_granted_to_root() -> None:
    cpu = max(os.sched_getaffinity(0))
    report = run_child(priority=71, cpu=cpu)
    refused = {s["name"] for s in report["settings"] if not s["ok"]}
    assert refused == (set() if report["latency_device"] else {"cpu_dma_latency"})
    assert [s["name"] for s in report["settings"]] == [
        "timer_slack", "sched_fifo", "mlockall", "cpu_dma_latency", "affinity",
    ]  # fmt: skip
    during = report["during"]
    assert (during["policy"], during["priority"], during["cpus"]) == (os.SCHED_FIFO, 71, [cpu])
    # Newer kernels have no slack for SCHED_FIFO threads (0), older ones use the requested one (1).
    assert during["slack"] in (0, 1) and during["locked"] > 10_000
    assert during["held"] == (0 if refused else 1) and report.get("latency_us", 0) == 0
    assert report["main_policy"] == os.SCHED_OTHER and report["after"] == report["before"]


@privileged
def test_memory_of_a_tick_is_loaded_and_the_rest_locked_on_touch() -> None:
    report, free = run_child(), run_child("off")
    # 2 MB are 512 pages, fewer with huge pages, hence the comparison with an unlocked child.
    assert report["early_faults"] == 0 < free["early_faults"]
    assert report["stack_faults"] == 0 < free["stack_faults"]
    assert report["during"]["locked"] > 64 * 1024 == report["late_locked"]
    assert report["large_faults"] > 0 and report["late_faults"] > 0
    # Some pages of the interpreter may be loaded in between.
    assert report["late_resident"] < 4 * 1024


MAPPED = """
import mmap, os, sys
from softfinger.server.loop import realtime

with open(os.fsencode(sys.argv[1]) + bytes([47, 255]), "wb+") as file:
    file.write(bytes(4096))
    file.flush()
    with mmap.mmap(file.fileno(), 4096):
        print([setting.name for setting in realtime.apply("auto", 80, None).settings])
"""


def test_a_mapped_file_may_have_any_name(tmp_path: Path) -> None:
    process = run_program([sys.executable, "-c", MAPPED, str(tmp_path)])
    assert "mlockall" in process.stdout, process.stderr


@raises_limits
def test_under_a_finite_limit_later_pages_are_not_locked() -> None:
    report = run_child(drop=True, limits={"RLIMIT_RTPRIO": 0, "RLIMIT_MEMLOCK": 8 << 30})
    assert report["by_name"]["mlockall"]["ok"] and "later is not" in report["by_name"]["mlockall"]["detail"]
    assert report["early_faults"] == report["late_locked"] == 0


@raises_limits
def test_limits_grant_without_root() -> None:
    limits = {"RLIMIT_RTPRIO": 50, "RLIMIT_MEMLOCK": -1}
    granted = run_child(priority=50, drop=True, limits=limits)
    assert granted["by_name"]["sched_fifo"]["ok"]
    assert (granted["during"]["policy"], granted["during"]["priority"]) == (os.SCHED_FIFO, 50)
    assert granted["late_locked"] == 64 * 1024
    refused = run_child(priority=80, drop=True, limits=limits)["by_name"]["sched_fifo"]
    assert not refused["ok"] and "priority is 50" in refused["advice"]


REFUSALS = {
    "sched_fifo": (("priority 80", "EPERM"), ("usermod -aG softfinger", "LimitRTPRIO", "--cap-add=SYS_NICE")),
    "mlockall": (("ENOMEM", "limit 64 kB"), ("ulimit -l", "LimitMEMLOCK", "--cap-add=IPC_LOCK")),
    "cpu_dma_latency": ((LATENCY_DEVICE,), ()),
}
"""Parts of the reason and of the remedy of each setting, besides `install --system`."""


def test_refusals_have_reason_and_remedy() -> None:
    report = run_child(drop=True, limits=UNPRIVILEGED)
    refused = {name: setting for name, setting in report["by_name"].items() if not setting["ok"]}
    assert refused.keys() == REFUSALS.keys() - ({"cpu_dma_latency"} if report["latency_device"] else set())
    for name, setting in refused.items():
        reasons, remedies = REFUSALS[name]
        assert all(part in setting["detail"] for part in reasons), setting
        assert all(part in setting["advice"] for part in ("install --system", *remedies)), setting
    assert (report["during"]["policy"], report["during"]["slack"], report["during"]["locked"]) == (os.SCHED_OTHER, 1, 0)
    assert report["after"] == report["before"]


def test_require_refuses_to_start_and_restores_everything() -> None:
    report = run_child("require", cpu=1023, drop=True, limits=UNPRIVILEGED)
    optional = [] if report["latency_device"] else ["cpu_dma_latency (not required)"]
    for part in (*(f"\n  {name}: " for name in REQUIRED), "--realtime auto", *optional):
        assert part in report["error"]
    assert report["after"] == report["before"]


@privileged
def test_require_starts_without_optional_settings() -> None:
    report = run_child("require", drop=True, keep=(SYS_NICE, IPC_LOCK))
    assert "error" not in report
    assert [s["name"] for s in report["settings"] if s["ok"] and s["name"] in REQUIRED] == ["sched_fifo", "mlockall"]
    assert report["by_name"]["cpu_dma_latency"]["ok"] == report["latency_device"]
    assert report["during"] != report["before"] == report["after"]


def test_a_missing_processor_is_refused() -> None:
    setting = run_child(cpu=1023)["by_name"]["affinity"]
    assert not setting["ok"] and "1023" in setting["detail"]
    assert str(min(os.sched_getaffinity(0))) in setting["advice"]
