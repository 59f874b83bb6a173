"""Real-time settings of the servo thread: scheduler, memory, timers, processor.

The servo thread makes all of them before it arms the device. Each is optional: a refused setting is reported with its
reason and a remedy, and the servo runs without it. Effects: the scheduler prevents other work from delaying a tick;
locked memory prevents a tick from waiting for a page; timer slack delays wake-ups by up to 50 us without SCHED_FIFO; a
processor that avoids deep sleep wakes about 10 us sooner; a fixed processor avoids migrations.
"""

from __future__ import annotations

import ctypes
import errno
import os
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

from softfinger.config.errors import RealtimeError
from softfinger.drivers.system.rules import GROUP, install_command

Mode = Literal["auto", "require", "off"]

LATENCY_DEVICE: Final = "/dev/cpu_dma_latency"
RT_RUNTIME: Final = "/proc/sys/kernel/sched_rt_runtime_us"
RT_PERIOD: Final = "/proc/sys/kernel/sched_rt_period_us"

REQUIRED: Final = ("sched_fifo", "mlockall", "affinity")
"""Settings required in mode `require`: the two that bound the worst tick, and a processor selected by number. Timer
slack does not act under SCHED_FIFO, and sleep states cost microseconds; their refusal is only reported."""

SLACK_NS: Final = 1  # 0 would mean the default of 50 us

# From <linux/prctl.h>, <asm-generic/mman.h>, <linux/capability.h>.
PR_SET_TIMERSLACK: Final = 29
PR_GET_TIMERSLACK: Final = 30
MCL_CURRENT: Final = 1
MCL_FUTURE: Final = 2
MCL_ONFAULT: Final = 4
MADV_DONTNEED: Final = 4
CAP_IPC_LOCK: Final = 14

LOCKED_MAPPING_MAX_BYTES: Final = 4 << 20
"""Largest mapping locked completely, in bytes: a driver's library is smaller, a stack and the compiler are larger."""
STACK_BYTES: Final = 1 << 20
"""Locked part of the servo thread's stack, from its top: the loop uses some kB, the library of a device some more."""
PTHREAD_ATTR_BYTES: Final = 64  # size of a pthread_attr_t: 56 on x86-64, 64 on aarch64


class Setting(NamedTuple):
    """Outcome of one setting; `detail` is the value set or the reason of a refusal, `advice` the remedy."""

    name: str
    ok: bool
    detail: str
    advice: str


@dataclass
class AppliedSettings:
    """Settings made by `apply`, and how to undo them."""

    settings: list[Setting]
    thread: int = field(default_factory=threading.get_native_id)
    _undo_thread: list[Callable[[], object]] = field(default_factory=list)
    _undo_process: list[Callable[[], object]] = field(default_factory=list)

    def undo(self) -> None:
        """Undo the settings in reverse order; may be called repeatedly.

        Scheduler, timer slack and processor belong to the thread that called `apply`; another thread does not undo
        them, because they end with their thread. Memory is unlocked for the process.
        """
        if threading.get_native_id() == self.thread:
            while self._undo_thread:
                self._undo_thread.pop()()
        while self._undo_process:
            self._undo_process.pop()()


def apply(mode: Mode, priority: int, cpu: int | None) -> AppliedSettings:
    """Make the real-time settings for the calling thread, which must be the servo thread.

    mode      auto: use the settings that are granted; require: RealtimeError unless all of REQUIRED are; off: none
    priority  of SCHED_FIFO, 1 to 99
    cpu       processor to run on, None for any

    In mode `require`, granted settings are undone before RealtimeError is raised; its message lists every refusal.
    """
    applied = AppliedSettings([])
    if mode == "off":
        applied.settings.append(Setting("off", True, "as requested: the servo has normal priority", ""))
        return applied
    # Timer slack first: a SCHED_FIFO thread has none, and the kernel ignores its request.
    applied.settings.append(_set_timer_slack(applied))
    applied.settings.append(_set_fifo(applied, priority))
    applied.settings.append(_lock_memory(applied))
    applied.settings.append(_limit_latency(applied))
    if cpu is not None:
        applied.settings.append(_set_affinity(applied, cpu))
    if mode == "require":
        _check_required(applied)
    return applied


def raise_priority(name: str, thread: int | None, priority: int) -> Setting:
    """Set the priority of another thread of this process, by its native id; it ends with the thread.

    The supervisor must run when the servo hangs, and the relay must wake readers of ticks while the processor is busy
    with other work.
    """
    setting = f"sched_fifo_{name}"
    if thread is None:
        return Setting(setting, False, "the thread does not run", "start the program again")
    lowest, highest = os.sched_get_priority_min(os.SCHED_FIFO), os.sched_get_priority_max(os.SCHED_FIFO)
    clamped = max(lowest, min(priority, highest))
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(clamped))
    except OSError as error:
        return Setting(
            setting, False, f"priority {clamped}: {_format_reason(error.errno)}", _advise_on_fifo(error.errno)
        )
    return Setting(setting, True, f"priority {clamped}", "")


def _check_required(applied: AppliedSettings) -> None:
    refused = [s for s in applied.settings if not s.ok]
    if any(s.name in REQUIRED for s in refused):
        applied.undo()
        lines = [
            f"  {s.name}{'' if s.name in REQUIRED else ' (not required)'}: {s.detail}; {s.advice}" for s in refused
        ]
        raise RealtimeError(
            "real time was required and this machine refused it; --realtime auto runs without:\n" + "\n".join(lines)
        )


def _set_timer_slack(applied: AppliedSettings) -> Setting:
    before = _call_libc("prctl", PR_GET_TIMERSLACK, 0, 0, 0, 0)
    if before.result < 0 or (call := _call_libc("prctl", PR_SET_TIMERSLACK, SLACK_NS, 0, 0, 0)).result < 0:
        error = before.error or call.error
        return Setting("timer_slack", False, _format_reason(error), "allow prctl in the container's seccomp profile")
    applied._undo_thread.append(lambda: _call_libc("prctl", PR_SET_TIMERSLACK, before.result, 0, 0, 0))
    return Setting("timer_slack", True, f"{SLACK_NS} ns (was {before.result} ns)", "")


def _set_fifo(applied: AppliedSettings, priority: int) -> Setting:
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        refusal = f"priority {priority}: {_format_reason(error.errno)}"
        return Setting("sched_fifo", False, refusal, _advise_on_fifo(error.errno))
    applied._undo_thread.append(lambda: os.sched_setscheduler(0, policy, parameters))
    # The kernel's limit for a thread that never sleeps; it does not affect a servo that meets its deadlines.
    runtime = _read(RT_RUNTIME)
    note = "" if runtime in ("", "-1") else f", paused if busy for {runtime} us of {_read(RT_PERIOD)} us"
    return Setting("sched_fifo", True, f"priority {priority}{note}", "")


def _advise_on_fifo(number: int | None) -> str:
    if number == errno.EINVAL:
        low, high = os.sched_get_priority_min(os.SCHED_FIFO), os.sched_get_priority_max(os.SCHED_FIFO)
        return f"set servo.priority between {low} and {high}"
    advice = (
        f"this user's highest priority is {_format_limit('RLIMIT_RTPRIO')}: {_advise_on_group()}; under systemd "
        "LimitRTPRIO=95; in Docker --cap-add=SYS_NICE or --ulimit rtprio=95"
    )
    if _read(RT_RUNTIME) == "0":
        advice += f"; {RT_RUNTIME} is 0, which forbids it to everyone: write 950000"
    return advice


def _advise_on_group() -> str:
    """Return how a user obtains both limits (priority and locked memory) and access to the latency device."""
    join = f"join that (sudo usermod -aG {GROUP} $USER) and log in again"
    return f"`{install_command()}` gives it to the group {GROUP}: {join}"


def _lock_memory(applied: AppliedSettings) -> Setting:
    """Lock present pages now and others on first touch, and load the pages that a tick may touch."""
    for mapping in _list_mappings():
        # Drop the code of large libraries, such as the compiler. It is mapped from a file and never written: if it is
        # called again, it is read from there. Kernels are code too, but without a file.
        if mapping.size > LOCKED_MAPPING_MAX_BYTES and mapping.permissions == "r-xp" and mapping.inode != 0:
            _call_libc("madvise", mapping.begin, mapping.size, MADV_DONTNEED)
    # Under a finite limit, locking future mappings would make a later malloc fail.
    capabilities = int(_read_status("CapEff") or "0", 16)
    has_no_limit = capabilities >> CAP_IPC_LOCK & 1 or _format_limit("RLIMIT_MEMLOCK") == "unlimited"
    later = MCL_FUTURE if has_no_limit else 0
    call = _call_libc("mlockall", MCL_CURRENT | MCL_ONFAULT | later)
    if call.result < 0:
        required, limit = _read_status("VmSize"), _format_limit("RLIMIT_MEMLOCK", 1024, " kB")
        advice = (
            f"{_advise_on_group()} (ulimit -l shows it); under systemd LimitMEMLOCK=infinity; in Docker "
            "--cap-add=IPC_LOCK or --ulimit memlock=-1"
        )
        return Setting("mlockall", False, f"{_format_reason(call.error)}: {required} to lock, limit {limit}", advice)
    applied._undo_process.append(lambda: _call_libc("munlockall"))
    _load_small_mappings()
    locked = f"{_read_status('VmLck')} locked, {_read_status('VmRSS')} of it in memory"
    note = "memory mapped later is also locked" if later else "memory mapped later is not locked because of a limit"
    return Setting("mlockall", True, f"{locked}; {note}", "")


def _load_small_mappings() -> None:
    """Load this thread's stack and all small mappings.

    The large ones are the compiler, which no tick calls, the stacks of other threads, which no tick writes, and arrays:
    arrays written by a tick were already written when they were created.
    """
    for mapping in _list_mappings():
        if mapping.permissions.startswith("r") and mapping.size <= LOCKED_MAPPING_MAX_BYTES:
            _call_libc(
                "mlock", mapping.begin, mapping.size
            )  # refused for pages of the kernel, which are always present
    attributes = ctypes.create_string_buffer(PTHREAD_ATTR_BYTES)
    lowest, size = ctypes.c_size_t(), ctypes.c_size_t()
    if _call_libc("pthread_getattr_np", threading.get_ident(), ctypes.addressof(attributes)).result == 0:
        _call_libc("pthread_attr_getstack", *map(ctypes.addressof, (attributes, lowest, size)))
        _call_libc("pthread_attr_destroy", ctypes.addressof(attributes))
        used = min(size.value, STACK_BYTES)
        _call_libc("mlock", lowest.value + size.value - used, used)


def _limit_latency(applied: AppliedSettings) -> Setting:
    """Request wake-ups without delay, for the entire machine as long as the file remains open."""
    name = "cpu_dma_latency"
    try:
        fd = os.open(LATENCY_DEVICE, os.O_WRONLY | os.O_CLOEXEC)
    except OSError as error:
        advice = f"{_advise_on_group()}; in Docker --device={LATENCY_DEVICE} for a user that may write it"
        return Setting(name, False, f"{LATENCY_DEVICE}: {_format_reason(error.errno)}", advice)
    try:
        os.write(fd, struct.pack("i", 0))
    except OSError as error:
        os.close(fd)
        refusal = f"writing {LATENCY_DEVICE}: {_format_reason(error.errno)}"
        return Setting(name, False, refusal, "see the kernel's log: the device exists but accepts no value")
    applied._undo_process.append(lambda: os.close(fd))
    return Setting(name, True, "0 us: processors stay out of deep sleep while the servo runs", "")


def _set_affinity(applied: AppliedSettings, cpu: int) -> Setting:
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {cpu})
    except OSError as error:
        allowed = ", ".join(str(number) for number in sorted(before))
        advice = f"set servo.cpu to one this process may use: {allowed}; in Docker --cpuset-cpus decides"
        return Setting("affinity", False, f"processor {cpu}: {_format_reason(error.errno)}", advice)
    applied._undo_thread.append(lambda: os.sched_setaffinity(0, before))
    return Setting("affinity", True, f"processor {cpu}", "")


class _Outcome(NamedTuple):
    result: int
    error: int


def _call_libc(name: str, *arguments: int) -> _Outcome:
    """Call a libc function with C longs; the error is 0 on success."""
    function = getattr(ctypes.CDLL(None, use_errno=True), name)
    ctypes.set_errno(0)
    result = function(*(ctypes.c_long(argument) for argument in arguments))
    return _Outcome(result, ctypes.get_errno() if result < 0 else 0)


def _format_reason(number: int | None) -> str:
    return f"{os.strerror(number or 0)} ({errno.errorcode.get(number or 0, number)})"


def _format_limit(name: str, unit: int = 1, suffix: str = "") -> str:
    import resource

    soft, _ = resource.getrlimit(getattr(resource, name))
    return "unlimited" if soft == resource.RLIM_INFINITY else f"{soft // unit}{suffix}"


class _Mapping(NamedTuple):
    """Address and size in bytes; permissions such as `r-xp`; inode of its file, 0 for none."""

    begin: int
    size: int
    permissions: str
    inode: int


def _list_mappings() -> list[_Mapping]:
    mappings = []
    for line in _read("/proc/self/maps").splitlines():
        span, permissions, _, _, inode, *_ = line.split()
        begin, end = (int(address, 16) for address in span.split("-"))
        mappings.append(_Mapping(begin, end - begin, permissions, int(inode)))
    return mappings


def _read_status(key: str) -> str:
    """Return one line of this thread's /proc status, empty if it is missing."""
    for line in _read("/proc/thread-self/status").splitlines():
        if line.startswith(f"{key}:"):
            return " ".join(line.split()[1:])
    return ""


def _read(path: str) -> str:
    try:
        with open(path, encoding="utf-8", errors="replace") as file:  # file names may contain any bytes
            return file.read().strip()
    except OSError:
        return ""
