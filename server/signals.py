"""Signal handling: the first signal ends the program in an orderly way within a second; Ctrl-Z removes all forces.

`cli.main` installs these handlers for every signal that would end the process. Their effect depends on the context:

    during imports            the process exits at once, because nothing is open yet
    in any verb               `Interrupted` is raised in the main thread, once, and contexts close their resources
    inside `stop_on_signal`   a function is called and nothing is raised: a servo or a recording ends in an orderly way
    inside `defer_signals`    the signal is only stored: closing is not interrupted

A main thread inside a compiler may not raise the exception for half a minute. In that case another thread closes the
devices and exits the process. No thread of Python runs while a library holds the interpreter lock, for example for
seconds while it parses a large mesh. The system therefore writes the number of each signal directly into the switch of
the force, which the loop reads in every tick.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final

from softfinger.drivers import open_devices
from softfinger.server.loop.switch_fields import SIGNAL
from softfinger.server.standard_error import LAST_WAIT_S, is_writable

STOPPING_SIGNALS: Final = frozenset({signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU})
"""Signals that stop the process until SIGCONT."""
_HARMLESS_SIGNALS: Final = frozenset({signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH})
_UNCATCHABLE_SIGNALS: Final = frozenset({signal.SIGKILL, signal.SIGSTOP})
_FAULT_SIGNALS: Final = frozenset({signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGTRAP})
"""A handler would return to the instruction that failed."""
ENDING_SIGNALS: Final = (
    frozenset(signal.valid_signals()) - STOPPING_SIGNALS - _HARMLESS_SIGNALS - _UNCATCHABLE_SIGNALS - _FAULT_SIGNALS
)
"""All signals that end the process and can be caught."""
STOP_REQUESTS: Final = frozenset({signal.SIGINT, signal.SIGTERM})
"""Normal requests to stop a daemon; they give exit code 0."""

SIGNAL_AT: Final = 8 * SIGNAL
"""Place of the number of a signal in the file of the force switch, its lowest byte."""
GRACE_S: Final = 0.5
"""Time for the main thread to handle a signal. Python code does so within one switch interval."""


def call_at_end_of_input(action: Callable[[], None]) -> None:
    """Start a thread that calls a function at the end of standard input, which is the end of the parent process."""

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 64):
            pass
        action()

    threading.Thread(target=wait, daemon=True).start()


class Interrupted(KeyboardInterrupt):
    """A signal requested the end. As for KeyboardInterrupt, `except Exception` does not catch it."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class _SignalState:
    def __init__(self) -> None:
        self.number = 0
        """First signal that requested the end; 0 if there is none."""
        self.importing = False
        self.deferrals = 0
        self.stop: Callable[[], None] | None = None
        self.pause: Callable[[], Callable[[], None]] | None = None
        self.was_handled = threading.Event()
        self.sender = -1
        """Pipe into which Python's handler in C writes each signal, for `_watch_main`."""
        self.switch_files: list[int] = []
        """Files of the force switch; the last one is in use."""
        self.uses_switch = threading.Event()


_state = _SignalState()


def name_signal(number: int) -> str:
    """Return the name of a signal; real-time signals other than the first and last have none."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def compute_exit_code(number: int) -> int:
    return 128 + number


def stop_exit_code() -> int:
    """Return the exit code after an orderly stop: 0 without a signal and after the usual ones."""
    return 0 if _state.number in STOP_REQUESTS else compute_exit_code(_state.number) if _state.number else 0


@contextmanager
def handle_signals(ignore_after: bool = False) -> Iterator[None]:
    """Handle signals in the block as described above; has no effect outside the main thread.

    Parameters
    ----------
    ignore_after
        The process exits after the block: ignore signals from there on, so that none changes the exit code.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    global _state
    state = _SignalState()
    state.importing = True
    receiver, sender = os.pipe()
    os.set_blocking(sender, False)
    state.sender = sender
    watch = threading.Thread(target=_watch_main, args=(receiver, state), name="signals", daemon=True)
    watch.start()  # first, because the system may have no thread left
    outer, _state = _state, state
    hook, sys.unraisablehook = sys.unraisablehook, _make_unraisable_hook(sys.unraisablehook)
    wakeup = signal.set_wakeup_fd(sender, warn_on_full_buffer=False)
    previous_handlers = {}
    for number in sorted(ENDING_SIGNALS | STOPPING_SIGNALS):
        # nohup and shells set some signals to ignored for background processes, and Python ignores SIGPIPE.
        if number in STOP_REQUESTS or signal.getsignal(number) is not signal.SIG_IGN:
            previous_handlers[number] = signal.signal(
                number, _handle_stop if number in STOPPING_SIGNALS else _handle_end
            )
    try:
        yield
    finally:
        with defer_signals():
            _stop_all()  # devices opened by an interrupted call, before their context started
            for number, handler in previous_handlers.items():
                signal.signal(number, signal.SIG_IGN if ignore_after else handler)
        signal.set_wakeup_fd(wakeup)
        os.close(sender)
        watch.join()
        for file in (receiver, *_state.switch_files):
            os.close(file)
        sys.unraisablehook = hook
        _state = outer


def mark_imported() -> None:
    """Mark the imports as complete: signals raise `Interrupted` from now on."""
    _state.importing = False


@contextmanager
def stop_on_signal(
    stop: Callable[[], None], pause: Callable[[], Callable[[], None]] | None = None, switch_file: int | None = None
) -> Iterator[None]:
    """Call `stop` on each signal in the block instead of raising an exception.

    Parameters
    ----------
    stop
        Requests the end; may be called repeatedly, from a signal handler or another thread.
    pause
        Called before the process is stopped (Ctrl-Z): removes the force and returns a function that restores it.
    switch_file
        File of the force switch, into which a signal is written even while no thread of Python runs.
    """
    state = _state
    before = state.stop, state.pause
    state.stop, state.pause = stop, pause
    if switch_file is not None and state.sender >= 0:
        state.switch_files.append(os.dup(switch_file))
        os.write(state.sender, b"\0")
        state.uses_switch.wait(GRACE_S)
    if state.number:  # the exception was swallowed: some libraries ignore every exception of an optional import
        stop()
    try:
        yield
    finally:
        state.stop, state.pause = before


@contextmanager
def defer_signals() -> Iterator[None]:
    """Store signals during the block without acting on them."""
    state = _state
    state.deferrals += 1
    try:
        yield
    finally:
        state.deferrals -= 1


def _handle_end(number: int, _: FrameType | None) -> None:
    state = _state
    state.was_handled.set()
    first = not state.number
    state.number = state.number or number
    if state.stop is not None:
        state.stop()
    elif state.importing:
        _close_and_exit(number)
    elif first and not state.deferrals:
        raise Interrupted(number)


def _handle_stop(number: int, _: FrameType | None) -> None:
    """Remove all forces before the process is stopped; a verb without `pause` exits after it resumes."""
    state = _state
    if state.deferrals:
        return
    devices = [] if state.pause is not None else list(open_devices.devices)
    restore_force = None if state.pause is None else state.pause()
    if devices:
        _stop_all()
    # The system's own action, so that shells notice the stop and an orphaned process group continues.
    signal.signal(number, signal.SIG_DFL)
    signal.raise_signal(number)
    signal.signal(number, _handle_stop)
    if restore_force is not None:
        restore_force()
    if devices:
        _handle_end(number, None)


def _watch_main(receiver: int, state: _SignalState) -> None:
    """End the process if the main thread has not handled a signal within GRACE_S."""
    while (number := _read_signal(receiver, state)) is not None:
        if not number:  # from `stop_on_signal`
            state.uses_switch.set()
        if number in ENDING_SIGNALS and not state.was_handled.wait(GRACE_S):
            if state.stop is not None:
                state.stop()
            else:
                _close_and_exit(number)


def _read_signal(receiver: int, state: _SignalState) -> int | None:
    """Wait for the number of a signal, or 0; return None at the end of the pipe.

    The system moves the number from the pipe into the force switch. If it ends the run, it remains there.
    """
    if not state.switch_files:
        numbers = os.read(receiver, 1)
        return numbers[0] if numbers else None
    file = state.switch_files[-1]
    try:
        if not os.splice(receiver, file, 1, offset_dst=SIGNAL_AT):
            return None
    except OSError:  # refused by a sandbox
        os.close(state.switch_files.pop())
        return 0
    (number,) = os.pread(file, 1, SIGNAL_AT)
    if number not in ENDING_SIGNALS:
        os.pwrite(file, b"\0", SIGNAL_AT)
    return number


def _close_and_exit(number: int) -> None:
    """Close the devices and exit the process, from any thread."""
    open_devices.close_all()
    _print(f"ended by {name_signal(number)}")
    os._exit(compute_exit_code(number))


def _stop_all() -> None:
    """Zero all open devices; a failure is printed and changes neither the shutdown nor the exit code."""
    for error in open_devices.stop_all():
        why = f"{type(error).__name__}: {error}"
        _print(f"a device could not be stopped ({why}): it may still apply a force: switch it off")


def _print(line: str) -> None:
    """Write a line to standard error without a lock: a signal may have interrupted another write."""
    if not is_writable(LAST_WAIT_S):
        return
    with contextlib.suppress(OSError):
        os.write(2, (b"\r\x1b[K" if os.isatty(2) else b"") + f"softfinger: {line}\n".encode())


def _make_unraisable_hook(default_hook: Callable[[Any], Any]) -> Callable[[Any], None]:
    """Return a hook that exits the process if `Interrupted` was raised in a C callback or a finalizer."""

    def hook(unraisable: Any) -> None:
        if isinstance(unraisable.exc_value, Interrupted):
            _close_and_exit(unraisable.exc_value.number)
        default_hook(unraisable)

    return hook
