"""Helpers for tests in the guest: gadgets in separate processes, the program in a fork of this one.

An emulated processor takes half a minute to import the program. So this process imports it once, and every run of the
program is a fork of it, with separate exit code and streams.
"""

import ctypes
import json
import logging
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.closed_loop import records_of_daemon
from helpers.remote_bench import SOCKET

from softfinger.config.load import load_rig, load_scene
from softfinger.drivers.registry import open_device
from softfinger.server import cli
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.services import monitoring
from softfinger.server.verbs import devices as _devices  # noqa: F401  (imported here, once)
from softfinger.server.verbs import run as _run  # noqa: F401
from vm.warm import SCENES

if "SOFTFINGER_VM" not in os.environ:
    raise RuntimeError("these tests make USB devices in the kernel that they run on: make test-vm")

GADGETS = Path(__file__).with_name("gadgets")
START_S = 30.0
ANSWER_S = 60.0
TEST_S, CONTRACT_S = 120, 600
"""Time for one test of a contract, after which it ends with all stacks, and for all of them."""
RATE_HZ = 100.0
"""Rate of the loops here: a tick takes a millisecond on an emulated processor, which also emulates the device."""
TRIES = 3
NOBODY = 65534
PR_SET_KEEPCAPS, CAPABILITY_VERSION, DAC_OVERRIDE, DAC_READ_SEARCH = 8, 0x20080522, 1, 2
ALL_CAPABILITIES = (1 << 41) - 1

Wanted = Callable[[dict[str, Any]], bool]

_libc = ctypes.CDLL(None, use_errno=True)


class Gadget(AbstractContextManager[Any]):
    """A gadget's process, which answers lines."""

    def __init__(self, name: str, case: dict[str, Any]) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self.path = f"{self._folder.name}/gadget"
        self._process = subprocess.Popen([sys.executable, "-S", GADGETS / f"{name}.py", self.path, json.dumps(case)])
        try:
            until = time.monotonic() + START_S
            while not os.path.exists(self.path):
                assert self._process.poll() is None, f"{name} has ended"
                assert time.monotonic() < until, f"{name} does not come up"
                time.sleep(0.02)
        except BaseException:
            self._process.kill()
            self._process.wait()
            self._folder.cleanup()
            raise

    def ask(self, line: str) -> Any:
        with socket.socket(socket.AF_UNIX) as end:
            end.settimeout(ANSWER_S)
            end.connect(self.path)
            end.sendall(line.encode() + b"\n")
            with end.makefile() as stream:
                reply = stream.readline()
        assert reply or line == "quit", f"the gadget ended at {line}"
        answer = json.loads(reply or "null")
        assert not isinstance(answer, str), answer
        return answer

    def seen(self) -> dict[str, Any]:
        answer: dict[str, Any] = self.ask("seen")
        return answer

    def __exit__(self, *_: object) -> None:
        try:
            if self._process.poll() is None:
                self.ask("quit")
            self._process.wait(START_S)
        finally:
            self._process.kill()
            self._folder.cleanup()


def keep_capabilities(mask: int) -> None:
    """Drop every capability except these (bits of <linux/capability.h>)."""
    header = struct.pack("<Ii", CAPABILITY_VERSION, 0)
    low, high = mask & 0xFFFFFFFF, mask >> 32
    if _libc.capset(header, struct.pack("<6I", low, low, 0, high, high, 0)):
        raise OSError(ctypes.get_errno(), "capset")


def become(user: int) -> None:
    """Become this user, who can still read the program at any path, and write only world-writable files."""
    if _libc.prctl(PR_SET_KEEPCAPS, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl")
    os.setgroups([])
    os.setgid(user)
    os.setuid(user)
    keep_capabilities(1 << DAC_READ_SEARCH)


class Run(AbstractContextManager[Any]):
    """A function in a fork with separate streams, run by `user`; None: root, who may access any file."""

    def __init__(self, work: Callable[[], int], user: int | None = None) -> None:
        self._files = [tempfile.TemporaryFile("w+") for _ in range(2)]  # noqa: SIM115  (closed at its end)
        sys.stdout.flush()
        sys.stderr.flush()
        self._texts: list[str] = []
        self.code: int | None = None
        self.pid = os.fork()
        if self.pid == 0:
            os._exit(self._child(work, user))

    def _child(self, work: Callable[[], int], user: int | None) -> int:
        try:
            logging.root.handlers.clear()  # pytest's; the program installs another one
            for number, file in enumerate(self._files, 1):
                os.dup2(file.fileno(), number)
            sys.stdout, sys.stderr = os.fdopen(1, "w", buffering=1), os.fdopen(2, "w", buffering=1)
            if user is not None:
                become(user)
            code = work()
        except BaseException:
            traceback.print_exc()
            code = 70
        sys.stdout.flush()
        sys.stderr.flush()
        return code

    def _text(self, number: int) -> str:
        if self._texts:
            return self._texts[number]
        file = self._files[number].fileno()
        return os.pread(file, os.fstat(file).st_size, 0).decode()

    @property
    def out(self) -> str:
        return self._text(0)

    @property
    def err(self) -> str:
        return self._text(1)

    def says(self, text: str, seconds: float = 60.0) -> None:
        """Wait until its standard error contains `text`."""
        until = time.monotonic() + seconds
        while text not in self.err:
            assert not self._ended(), f"ended with {self.code}:\n{self.err}"
            assert time.monotonic() < until, f"does not say {text!r}:\n{self.err}"
            time.sleep(0.05)

    def until(self, device: Gadget, wanted: Wanted, seconds: float = 60.0) -> bool:
        """Wait until the device's state meets `wanted`; return False if the processor starved the loop instead."""
        until = time.monotonic() + seconds
        while not wanted(saw := device.seen()):
            if self._ended():
                assert self.starved, f"ended with {self.code}:\n{self.err}"
                return False
            assert time.monotonic() < until, f"in {seconds} s the device saw {saw}"
            time.sleep(0.05)
        return True

    @property
    def starved(self) -> bool:
        """True if the run timed out, as on a slow processor; a device that hangs does so in each of TRIES runs."""
        return self.code != 0 and any(text in self.err for text in ("no answer to a", "no tick for"))

    def end(self, seconds: float = 60.0) -> int:
        """Wait for the end, and return the exit code."""
        until = time.monotonic() + seconds
        while not self._ended():
            if time.monotonic() > until:
                self.kill()
                raise AssertionError(f"still there after {seconds} s:\n{self.out}\n{self.err}")
            time.sleep(0.05)
        assert self.code is not None
        return self.code

    def stop(self) -> int:
        """End it with Ctrl-C, and return the exit code."""
        os.kill(self.pid, signal.SIGINT)
        return self.end()

    def kill(self) -> None:
        """Kill it if it is still running; may be called repeatedly."""
        if not self._ended():
            os.kill(self.pid, signal.SIGKILL)
            self._gone(os.waitpid(self.pid, 0)[1])

    def _ended(self) -> bool:
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self._gone(status)
        return self.code is not None

    def _gone(self, status: int) -> None:
        self._texts = [self._text(number) for number in range(2)]
        for file in self._files:
            file.close()
        self.code = os.waitstatus_to_exitcode(status)

    def __exit__(self, *_: object) -> None:
        self.kill()


def softfinger(*words: str, user: int | None = None) -> Run:
    return Run(lambda: cli.main(list(words)), user)


def daemon(rig: str, *words: str, user: int | None = None) -> Run:
    fixed = ("--scene", "frictionless-plane", "--endpoint", "tcp://127.0.0.1:*", "--realtime", "off")
    fixed = (*fixed, "--rate", str(RATE_HZ))
    return softfinger("run", "--rig", rig, *fixed, *words, user=user)


def other_daemon() -> Run:
    """Run a daemon on another device, which detects the hot-plug events of the guest's devices."""
    running = daemon("replay")
    running.says("real time")
    time.sleep(monitoring.HOTPLUG_PERIOD_S)
    return running


@contextmanager
def pushing(rig: str, device: Gadget, wanted: Wanted) -> Iterator[Run]:
    """Run a daemon until the device's state meets `wanted`; restart it if it starved."""
    for _ in range(TRIES):
        with daemon(rig) as running:
            if running.until(device, wanted):
                yield running
                return
    raise AssertionError(f"starved {TRIES} times:\n{running.err}")


def keep(rig: str, scene: str, ticks: int, path: Path) -> None:
    """Run the daemon for `ticks`, and save all of them as received by a subscriber to `path` (.npy)."""
    changes = {"telemetry.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off", "servo.rate_hz": RATE_HZ}

    def work() -> int:
        np.save(path, records_of_daemon(load_rig(rig, changes), load_scene(scene), ticks))
        return 0

    for _ in range(TRIES):
        with Run(work) as running:
            if running.end(120) == 0:
                return
        assert running.starved, running.err
    raise AssertionError(f"starved {TRIES} times:\n{running.err}")


def attached(user: int | None = None, rig: str | None = None) -> list[dict[str, Any]]:
    """Return the devices of `softfinger devices --json`."""
    listing = softfinger("devices", "--json", *(() if rig is None else ("--rig", rig)), user=user)
    assert listing.end() == 0, listing.err
    devices: list[dict[str, Any]] = json.loads(listing.out)["devices"]
    return devices


def contract(module: Path, device: Gadget) -> tuple[str, int]:
    """Run the tests of a contract on a device, found by the same variable as with umockdev."""

    def work() -> int:
        # Root may open any node, and one of the tests forbids one.
        keep_capabilities(ALL_CAPABILITIES & ~(1 << DAC_OVERRIDE | 1 << DAC_READ_SEARCH))
        os.environ[SOCKET] = device.path
        options = ("-q", "-p", "no:cacheprovider", "-o", f"faulthandler_timeout={TEST_S}")
        return int(pytest.main([*options, str(module)]))

    with Run(work) as tests:
        code = tests.end(CONTRACT_S)
    return tests.out + tests.err, code


@pytest.fixture(scope="session", autouse=True)
def loaded() -> None:
    """Load the servo's compiled code here, so that no fork has to."""
    rig = load_rig("replay")
    with open_device(rig.device, rig.servo.rate_hz) as device:
        for scene in SCENES:
            servo = ServoThread([device], make_tuning(load_scene(scene), rig.guard, [device.info]), rig.servo.rate_hz)
            servo.compile()
            servo.close()


@contextmanager
def gadget(name: str, **case: Any) -> Iterator[Gadget]:
    """A device of the guest, plugged in; see gadgets/`name`.py for its case."""
    with Gadget(name, case) as opened:
        yield opened
