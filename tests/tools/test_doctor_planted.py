"""`doctor` detects planted problems of a machine, and its remedies solve them."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import zmq

from softfinger.config.load import load_rig, load_scene
from softfinger.config.schema import Rig
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.proxy.kernels.jit.cache import Folder
from softfinger.tools.doctor import attached, loop, machine
from softfinger.tools.doctor.check import Check

Look = Callable[[], Check]


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        Path(name).chmod(0o755)
        yield Path(name)


def system(folder: Path, **files: str) -> Path:
    for name, text in files.items():
        path = folder / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return folder


@contextmanager
def as_nobody() -> Iterator[None]:
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)


def device(rig: Rig, node: Path) -> Check:
    (check,) = attached.devices(rig, [SystemDevice("hid", 0x046D, 0xC626, "Puck", "", str(node))])
    return check


def of_settings(**servo: object) -> Check:
    rig = load_rig("replay", {f"servo.{key}": value for key, value in servo.items()})
    (check,) = (one for one in loop.settings(rig) if one.name == "real time, affinity")
    return check


def figures(missed: int, late_s: float) -> dict[str, object]:
    return {"rate_hz": 1000.0, "servo": {"ticks": 1000, "missed": missed, "late": {"p99": late_s}}}


def sound_and_planted(problem: str, folder: Path, keep: ExitStack, patch: pytest.MonkeyPatch) -> tuple[Look, Look]:
    well, ill = folder / "well", folder / "ill"
    cpu = "sys__devices__system__cpu__cpu0__cpufreq__scaling_governor"
    clock = "sys__devices__system__clocksource__clocksource0__current_clocksource"
    of_machine: dict[str, tuple[Callable[[Path], Check], dict[str, str], dict[str, str]]] = {
        "no real-time kernel": (machine.kernel, {"sys__kernel__realtime": "1"}, {"sys__kernel__realtime": "0"}),
        "governor that saves power": (machine.frequency, {cpu: "performance"}, {cpu: "powersave"}),
        "slow clock": (machine.clock, {clock: "tsc"}, {clock: "hpet"}),
        "virtual machine": (machine.virtual, {"proc__cpuinfo": "flags : fpu"}, {"proc__cpuinfo": "flags : hypervisor"}),
        "container": (machine.virtual, {"proc__1__cgroup": "0::/"}, {"proc__1__cgroup": "0::/docker/1"}),
    }
    if problem in of_machine:
        look, good, bad = of_machine[problem]
        return lambda: look(system(well, **good)), lambda: look(system(ill, **bad))
    if problem == "package that is missing":
        without = ["numpy>=2.0", "no-such-package>=1"]

        def lacking() -> Check:
            patch.setattr(machine.metadata, "requires", lambda _: without)
            return machine.packages()

        return machine.packages, lacking
    if problem == "processor that is not there":
        return lambda: of_settings(cpu=min(os.sched_getaffinity(0))), lambda: of_settings(cpu=1023, realtime="require")
    if problem == "cache that others may write":
        ill.mkdir()
        ill.chmod(0o777)
        well.mkdir()

        def cache(path: Path) -> Check:
            patch.setattr(loop, "KEPT", Folder(path))
            return loop.cache(load_rig("replay"), "frictionless-plane", load_scene("frictionless-plane"))

        return lambda: cache(well), lambda: cache(ill)
    if problem == "endpoint in use":
        context = keep.enter_context(zmq.Context())
        port = keep.enter_context(context.socket(zmq.PUB)).bind_to_random_port("tcp://127.0.0.1")
        rigs = [load_rig("replay", {"telemetry.endpoint": f"tcp://127.0.0.1:{at}"}) for at in ("*", port)]
        return lambda: loop.endpoint(rigs[0]), lambda: loop.endpoint(rigs[1])
    if problem in ("ticks that are missed", "late wake-ups"):
        number = 0 if problem.startswith("ticks") else 1
        return (lambda: loop.judge_loop(figures(0, 5e-5))[number], lambda: loop.judge_loop(figures(50, 6e-4))[number])
    if problem == "library that is missing":
        for name in ("FDSDK", "FORCEDIM_SDK"):
            patch.delenv(name, raising=False)
        patch.setenv("HOME", str(folder))
        return lambda: attached.maker_library(load_rig("replay"), "forcedimension"), lambda: attached.maker_library(
            load_rig("omega-3"), "forcedimension"
        )
    rig, node = load_rig("spacemouse"), folder / "hidraw5"
    node.write_bytes(b"")
    node.chmod(0o666)

    def planted() -> Check:
        if problem == "device that is not plugged in":
            return attached.devices(rig, [])[0]
        if problem == "device without rights":
            node.chmod(0o600)
            if os.geteuid() != 0:
                node.chmod(0)
            with as_nobody():
                return device(rig, node)
        fcntl.flock(keep.enter_context(node.open("rb")), fcntl.LOCK_EX)
        return device(rig, node)

    return lambda: device(rig, node), planted


@pytest.mark.parametrize(
    ("problem", "state", "seen", "remedy"),
    [
        ("package that is missing", "bad", "MISSING", "pip install no-such-package"),
        ("no real-time kernel", "could be better", "not PREEMPT_RT", "linux-image-rt"),
        ("virtual machine", "could be better", "virtual machine", "on the machine itself"),
        ("container", "could be better", "container", "docs/operate/docker.md"),
        ("governor that saves power", "could be better", "powersave", "cpupower frequency-set -g performance"),
        ("slow clock", "could be better", "hpet", "echo tsc"),
        ("processor that is not there", "bad", "processor 1023", "servo.cpu"),
        ("cache that others may write", "bad", "can be written by other users", "SOFTFINGER_CACHE_DIR"),
        ("endpoint in use", "bad", "tcp://127.0.0.1:", "end the program that uses it"),
        ("ticks that are missed", "bad", "50 of 1000 missed", "isolcpus"),
        ("late wake-ups", "bad", "p99 600 us", "servo.cpu"),
        ("library that is missing", "bad", "is not on this machine", "export FDSDK="),
        ("device that is not plugged in", "bad", "nothing that driver spacemouse", "plug it in"),
        ("device without rights", "bad", "may not write to", "install --system"),
        ("device that is in use", "bad", "is used by process", "kill "),
    ],
)
def test_a_planted_problem_is_found(
    problem: str, state: str, seen: str, remedy: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ExitStack() as keep:
        sound, planted = sound_and_planted(problem, folder, keep, monkeypatch)
        before = sound()
        found = planted()
    assert before.state == "good" or "was cold" in before.seen, before
    assert found.state == state, found
    assert seen in found.seen and remedy in found.remedy, found
