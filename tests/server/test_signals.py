"""Signals that end or stop a program with a device: no force remains, and the program ends in order."""

import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from emulators.serialboard import Board, Cable
from helpers.called import called
from helpers.processes import COMMAND, find_child, read_state
from helpers.programs import Program, run_program
from helpers.rig_files import write_rig
from helpers.serial_devices import PLACE, RIG
from helpers.waits import until

from softfinger.config.errors import DeviceError
from softfinger.server import signals

pytestmark = pytest.mark.real_time

ZERO = (0.0, 0.0, 0.0)
FORCE_N = 0.5
"""Below the force of the hand's spring at this depth, so it can only be a contact force."""
START_S = 120.0
"""A cold start compiles."""
END_S = 20.0
"""An end takes far less than a second, more on a busy machine."""


@contextmanager
def pressing(
    tmp_path: Path, *words: str, environment: dict[str, str] | None = None
) -> Iterator[tuple[Board, subprocess.Popen[str]]]:
    """Run a daemon, with more `environment`, on a board with a hand that presses into the plane."""
    board = Board(lambda _: (*PLACE[:2], 0.006))
    with Cable(board) as cable:
        rig = write_rig(tmp_path, RIG, path=cable.path, quiet_s=0.1, timeout_s=2.0)
        command = [*COMMAND, "run", "--rig", str(rig), "--realtime", "off", "--scene", "paper-plane"]
        command += ["--endpoint", f"ipc://{tmp_path}/t", *words]
        # Without a parent in its session (process_group), as under a service manager, Ctrl-Z has no effect.
        more = {"env": os.environ | (environment or {}), "process_group": 0, "kill_at_end": True}
        with Program(command, stderr=subprocess.PIPE, text=True, **more) as process:
            until(lambda: board.force[2] > FORCE_N or process.poll() is not None, START_S, "a force")
            assert process.poll() is None, process.communicate()[1]
            yield board, process


FATAL = """
import os, signal

for number in sorted(signal.valid_signals()):
    pid = os.fork()
    if pid == 0:
        if number not in (signal.SIGKILL, signal.SIGSTOP):
            signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        os._exit(0)
    _, status = os.waitpid(pid, os.WUNTRACED)
    if os.WIFSTOPPED(status):
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    elif os.WIFSIGNALED(status):
        print(number)
"""
"""Small program, because a fork of the test process takes 40 ms."""


def test_every_signal_that_ends_a_process_is_handled() -> None:
    completed = run_program([sys.executable, "-S", "-c", FATAL], check=True)
    fatal = set(map(int, completed.stdout.split()))
    helpless = {signal.SIGKILL, signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGTRAP}
    assert fatal - helpless == signals.ENDING_SIGNALS


def find_watcher(process: subprocess.Popen[str]) -> int:
    return find_child(process.pid, b"watcher.py\0")


def wait_for_zero(board: Board) -> None:
    until(lambda: board.force == ZERO, END_S, "the zero")


def end_by_signal(process: subprocess.Popen[str], board: Board, number: int) -> None:
    """End a daemon by a signal, of which all share a handler; others during its shutdown have no effect."""
    process.send_signal(number)
    wait_for_zero(board)  # of pending signals Python takes the lowest number first
    for another in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, number):
        time.sleep(0.01)
        process.send_signal(another)
    stderr = process.communicate(timeout=END_S)[1]
    assert process.returncode == 128 + number, stderr
    assert "force is zero" in stderr and "Traceback" not in stderr and "has died" not in stderr
    wait_for_zero(board)
    assert board.faults == []


OTHERS = (signal.SIGQUIT, signal.SIGUSR1, signal.SIGALRM, signal.SIGXCPU, signal.SIGABRT, signal.SIGRTMIN + 3)


@pytest.mark.exhaustive
@pytest.mark.parametrize("number", OTHERS)
def test_signal_ends_the_daemon_without_force(number: int, tmp_path: Path) -> None:
    with pressing(tmp_path) as (board, process):
        end_by_signal(process, board, number)


def test_no_force_while_the_process_is_stopped(tmp_path: Path) -> None:
    with pressing(tmp_path) as (board, process):
        watcher = find_watcher(process)
        process.send_signal(signal.SIGTSTP)
        until(lambda: read_state(process.pid) == "T" or process.poll() is not None, END_S, "the stop")
        assert process.poll() is None, process.communicate()[1]
        wait_for_zero(board)
        count = len(board.sent)
        time.sleep(0.2)
        assert not any(any(frame[:3]) for frame in board.sent[count:])
        process.send_signal(signal.SIGCONT)
        until(lambda: board.force[2] > FORCE_N, END_S, "the force")
        forces = [frame[2] for frame in board.sent[count:]]
        first = next(force for force in forces if force > 0)
        assert first < 0.1 * 1e3 * FORCE_N  # start of a ramp
        end_by_signal(process, board, signal.SIGHUP)
        assert not Path(f"/proc/{watcher}").exists()


def test_a_killed_watcher_is_restarted(tmp_path: Path) -> None:
    with pressing(tmp_path) as (board, process):
        os.kill(find_watcher(process), signal.SIGKILL)
        assert process.stderr is not None
        assert any("ended unexpectedly (-9) and was restarted" in line for line in process.stderr)
        process.kill()
        wait_for_zero(board)


@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGSEGV, marks=pytest.mark.exhaustive)])
def test_watcher_takes_the_force_off_a_killed_daemon(number: int, tmp_path: Path) -> None:
    with pressing(tmp_path) as (board, process):
        watcher = find_watcher(process)
        os.kill(watcher, signal.SIGTERM)
        process.send_signal(number)
        stderr = process.communicate(timeout=END_S)[1]
        assert process.returncode == -number
        assert "the daemon has died: zero force was written to /dev/pts/" in stderr
        wait_for_zero(board)
        assert board.sent[-1] == (0, 0, 0, 2, 0, 0, 0)
    refused = called("run", "--watcher", "--endpoint", f"ipc://{tmp_path}/t")
    assert refused.returncode == 2 and "no other process can remove the force of replay" in refused.stderr


SIMULATE = "simulate --scene paper-plane --poses tap --out FOLDER/out.csv"


@pytest.mark.parametrize(
    ("line", "number", "last_kernel"),
    [
        ("run --endpoint ipc://FOLDER/t --realtime off", signal.SIGINT, "run_servo_loop"),
        ("warmup", signal.SIGTERM, "run_servo_loop"),
        pytest.param(SIMULATE, signal.SIGINT, "run_ticks", marks=pytest.mark.exhaustive),
    ],
)
def test_a_compilation_is_interrupted(line: str, number: int, last_kernel: str, tmp_path: Path) -> None:
    words = [word.replace("FOLDER", str(tmp_path)) for word in line.split()]
    environment = os.environ | {"SOFTFINGER_CACHE_DIR": str(tmp_path / "cache")}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with Program([*COMMAND, *words], env=environment, **pipes) as process:
        for line in process.stderr:
            if "compiling kernel" in line:  # logged after half a second
                break
        process.send_signal(number)
        output = process.communicate(timeout=END_S)[1]
    assert process.returncode == 128 + number and "Traceback" not in output, output
    assert output.splitlines()[-1] == f"softfinger: ended by {signal.Signals(number).name}"
    assert not list((tmp_path / "cache").rglob(f"{last_kernel}-*.kernel")), "it ended after the compilation"


STUCK = """
import ctypes, hashlib, os, signal, sys, threading, time
from softfinger.drivers import open_devices
from softfinger.server import signals
class Device:
    def stop(self): pass
    def close(self): print("closed", flush=True)
device = Device()
def soon():
    time.sleep(0.3)
    os.kill(os.getpid(), signal.SIGTERM)
def callback(a, b):
    signal.raise_signal(signal.SIGTERM)
    for _ in range(1000): pass
    return 0
with signals.handle_signals():
    signals.mark_imported()
    open_devices.devices.add(device)
    threading.Thread(target=soon if sys.argv[1] != "callback" else time.time).start()
    try:
        if sys.argv[1] == "native":
            hashlib.pbkdf2_hmac("sha512", b"x", b"y", 1 << 30)
        elif sys.argv[1] == "callback":
            kind = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
            ctypes.CDLL(None).qsort((ctypes.c_int * 4)(4, 3, 2, 1), 4, 4, kind(callback))
            time.sleep(60)
        else:
            time.sleep(60)
    except signals.Interrupted as error:
        device.close()
        sys.exit(signals.compute_exit_code(error.number))
"""


@pytest.mark.parametrize("where", ["python", "native", "callback"])
def test_a_signal_ends_the_process_wherever_the_main_thread_is(where: str) -> None:
    """In Python, in native code and in a callback that cannot raise, the device is closed and the process ends."""
    completed = run_program([sys.executable, "-c", STUCK, where], timeout=END_S)
    assert completed.returncode == 128 + signal.SIGTERM, completed.stderr
    assert completed.stdout == "closed\n" and "Traceback" not in completed.stderr


REFUSING = """
import os, signal, sys, threading
from softfinger.drivers import open_devices
from softfinger.server import cli
class Device:
    def stop(self): raise OSError("the port has gone")
    def close(self): pass
device = Device()
open_devices.devices.add(device)
if sys.argv[1] == "TSTP":
    from softfinger.server import signals
    os.setsid()  # nobody there who would stop us: the system leaves an orphaned group running
    with signals.handle_signals():
        signals.mark_imported()
        try:
            signal.raise_signal(signal.SIGTSTP)
        except signals.Interrupted as error:
            sys.exit(signals.compute_exit_code(error.number))
sys.argv = ["softfinger", *sys.argv[1:]]
sys.exit(cli.main())
"""


@pytest.mark.parametrize(
    ("words", "code"), [(["scenes"], 0), (["check", "no-such.toml"], 2), (["TSTP"], 128 + signal.SIGTSTP)]
)
def test_a_device_that_cannot_be_stopped_is_reported(words: list[str], code: int) -> None:
    result = run_program([sys.executable, "-c", REFUSING, *words], timeout=END_S, start_new_session=words != ["TSTP"])
    assert result.returncode == code, result.stderr
    assert "could not be stopped (OSError: the port has gone): it may still apply a force" in result.stderr
    assert "Traceback" not in result.stderr


SWALLOWED = """
import signal, sys, threading
from softfinger.server import signals
with signals.handle_signals():
    signals.mark_imported()
    try:
        signal.raise_signal(signal.SIGTERM)
    except BaseException:
        pass  # as a library does that imports another one
    stop = threading.Event()
    with signals.stop_on_signal(stop.set):
        sys.exit(signals.stop_exit_code() if stop.wait(30.0) else 1)
"""


def test_a_swallowed_signal_is_not_lost() -> None:
    run_program([sys.executable, "-c", SWALLOWED], timeout=END_S, check=True)


def test_a_second_signal_raises_nothing() -> None:
    before = signal.getsignal(signal.SIGINT)
    with signals.handle_signals():
        signals.mark_imported()
        with pytest.raises(signals.Interrupted) as interrupted:
            signal.raise_signal(signal.SIGTERM)
        try:
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.raise_signal(number)
        except signals.Interrupted as second:  # which would end the test program, as Ctrl-C does
            pytest.fail(f"{signals.name_signal(second.number)} was raised besides")
        assert interrupted.value.number == signal.SIGTERM and signals.stop_exit_code() == 0
    assert signal.getsignal(signal.SIGINT) is before


JOB = """
import os, signal, sys, time
from softfinger.drivers import open_devices
from softfinger.server import signals
def say(word): os.write(1, word.encode() + b"\\n")  # print() has a lock, which whom a signal holds up may have
class Device:
    def stop(self): say("zero")
    def close(self): say("closed")
device = Device()
with signals.handle_signals():
    signals.mark_imported()
    open_devices.devices.add(device)
    try:
        say("ready")
        time.sleep(60)
    except signals.Interrupted as error:
        device.close()
        open_devices.devices.discard(device)
        sys.exit(signals.compute_exit_code(error.number))
"""

SHELL = """
import fcntl, os, signal, subprocess, sys, termios
os.setsid()
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
way = termios.tcgetattr(0)
way[3] &= ~termios.ECHO
termios.tcsetattr(0, termios.TCSANOW, way)
signal.signal(signal.SIGTTOU, signal.SIG_IGN)
job = subprocess.Popen([sys.executable, "-c", sys.argv[1]], process_group=0)
os.tcsetpgrp(0, job.pid)
_, status = os.waitpid(job.pid, os.WUNTRACED)
print("stopped" if os.WIFSTOPPED(status) else "ended", flush=True)
os.kill(job.pid, signal.SIGCONT)
_, status = os.waitpid(job.pid, 0)
print("left with", os.waitstatus_to_exitcode(status), flush=True)
"""
"""Shell with a job in the foreground: it continues the job when that stops."""


def test_ctrl_z_on_a_terminal_zeroes_devices_that_do_not_pause() -> None:
    ours, theirs = pty.openpty()
    words, output = [sys.executable, "-c", SHELL, JOB], b""
    with Program(words, stdin=theirs, stdout=theirs, stderr=theirs, kill_at_end=True), open(ours, "r+b", 0) as terminal:
        os.close(theirs)
        while b"ready\r\n" not in output:
            output += terminal.read(4096)
        terminal.write(b"\x1a")
        while not output.endswith(b"\n") or b"left with" not in output:
            output += terminal.read(4096)
    lines = output.decode().split("\r\n")
    assert lines[:4] == ["ready", "zero", "stopped", "closed"], output
    assert lines[-2:] == [f"left with {128 + signal.SIGTSTP}", ""], output


HANGING = """
import sys, time
from softfinger.drivers.simulated.device import SimulatedDevice
from softfinger.server import cli
SimulatedDevice.stop = SimulatedDevice.close = lambda device: time.sleep(3600.0)
sys.exit(cli.main(sys.argv[1:]))
"""


def test_a_hanging_device_does_not_block_the_exit(tmp_path: Path) -> None:
    words = ["run", "--rig", "simulated", "--realtime", "off", "--endpoint", f"ipc://{tmp_path}/t"]
    result = run_program([sys.executable, "-c", HANGING, *words, "--duration", "0.2"], timeout=START_S)
    assert result.returncode == DeviceError.exit_code, result.stderr
    assert "could not be stopped (the call has not returned for 2 s): it may still apply a force" in result.stderr
    assert "Traceback" not in result.stderr
