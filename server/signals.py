"""Signal handling: the first signal ends the program in an orderly way within a second; Ctrl-Z removes all forces.

`cli.main` installs these handlers for every signal that would end the process. Their effect depends on the context:

    during imports    the process exits at once, because nothing is open yet
    in any verb       `Interrupted` is raised in the main thread, once, and contexts close their resources
    inside `asked`    a function is called and nothing is raised: a servo or a recording ends in an orderly way
    inside `held`     the signal is only stored: closing is not interrupted

A main thread inside a compiler may not raise the exception for half a minute. In that case another thread closes the
devices and exits the process.
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

STOPPING: Final = frozenset({signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU})
"""Signals that stop the process until SIGCONT."""
_HARMLESS: Final = frozenset({signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH})
_NOT_CAUGHT: Final = frozenset({signal.SIGKILL, signal.SIGSTOP})
_FAULTS: Final = frozenset({signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGTRAP})
"""A handler would return to the instruction that failed."""
ENDING: Final = frozenset(signal.valid_signals()) - STOPPING - _HARMLESS - _NOT_CAUGHT - _FAULTS
"""All signals that end the process and can be caught."""
USUAL: Final = frozenset({signal.SIGINT, signal.SIGTERM})
"""Normal requests to stop a daemon; they give exit code 0."""

GRACE_S: Final = 0.5
"""Time for the main thread to handle a signal. Python code does so within one switch interval."""


class Interrupted(KeyboardInterrupt):
    """A signal requested the end. As for KeyboardInterrupt, `except Exception` does not catch it."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class _State:
    def __init__(self) -> None:
        self.number = 0
        """First signal that requested the end; 0 if there is none."""
        self.importing = False
        self.held = 0
        self.stop: Callable[[], None] | None = None
        self.pause: Callable[[], Callable[[], None]] | None = None
        self.arrived = threading.Event()


_state = _State()


def named(number: int) -> str:
    """Return the name of a signal; real-time signals other than the first and last have none."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def code_of(number: int) -> int:
    """Return the exit code that shells use for a process killed by a signal."""
    return 128 + number


def code_of_stop() -> int:
    """Return the exit code after an orderly stop: 0 without a signal and after the usual ones."""
    return 0 if _state.number in USUAL else code_of(_state.number) if _state.number else 0


@contextmanager
def handled(to_the_end: bool = False) -> Iterator[None]:
    """Handle signals in the block as described above; has no effect outside the main thread.

    Parameters
    ----------
    to_the_end
        The process exits after the block: ignore signals from there on, so that none changes the exit code.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    global _state
    outer, _state = _state, _State()
    _state.importing = True
    receiver, sender = os.pipe()
    os.set_blocking(sender, False)
    hook, sys.unraisablehook = sys.unraisablehook, _unraisable(sys.unraisablehook)
    wakeup = signal.set_wakeup_fd(sender, warn_on_full_buffer=False)
    before = {}
    for number in sorted(ENDING | STOPPING):
        # nohup and shells set some signals to ignored for background processes, and Python ignores SIGPIPE.
        if number in USUAL or signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, _pause if number in STOPPING else _end)
    watch = threading.Thread(target=_watch_main, args=(receiver, _state), name="signals", daemon=True)
    watch.start()
    try:
        yield
    finally:
        with held():
            _stop_all()  # devices opened by an interrupted call, before their context started
            for number, handler in before.items():
                signal.signal(number, signal.SIG_IGN if to_the_end else handler)
        signal.set_wakeup_fd(wakeup)
        os.close(sender)
        watch.join()
        os.close(receiver)
        sys.unraisablehook = hook
        _state = outer


def imported() -> None:
    """Mark the imports as complete: signals raise `Interrupted` from now on."""
    _state.importing = False


@contextmanager
def asked(stop: Callable[[], None], pause: Callable[[], Callable[[], None]] | None = None) -> Iterator[None]:
    """Call `stop` on each signal in the block instead of raising an exception.

    Parameters
    ----------
    stop
        Requests the end; may be called repeatedly, from a signal handler or another thread.
    pause
        Called before the process is stopped (Ctrl-Z): removes the force and returns a function that restores it.
    """
    state = _state
    before = state.stop, state.pause
    state.stop, state.pause = stop, pause
    if state.number:  # the exception was swallowed: some libraries ignore every exception of an optional import
        stop()
    try:
        yield
    finally:
        state.stop, state.pause = before


@contextmanager
def held() -> Iterator[None]:
    """Store signals during the block without acting on them."""
    state = _state
    state.held += 1
    try:
        yield
    finally:
        state.held -= 1


def _end(number: int, _: FrameType | None) -> None:
    state = _state
    state.arrived.set()
    first = not state.number
    state.number = state.number or number
    if state.stop is not None:
        state.stop()
    elif state.importing:
        _leave(number)
    elif first and not state.held:
        raise Interrupted(number)


def _pause(number: int, _: FrameType | None) -> None:
    """Remove all forces before the process is stopped; a verb without `pause` exits after it resumes."""
    state = _state
    if state.held:
        return
    devices = [] if state.pause is not None else list(open_devices.devices)
    go_on = None if state.pause is None else state.pause()
    if devices:
        _stop_all()
    # The system's own action, so that shells notice the stop and an orphaned process group continues.
    signal.signal(number, signal.SIG_DFL)
    signal.raise_signal(number)
    signal.signal(number, _pause)
    if go_on is not None:
        go_on()
    if devices:
        _end(number, None)


def _watch_main(receiver: int, state: _State) -> None:
    """End the process if the main thread has not handled a signal within GRACE_S."""
    while numbers := os.read(receiver, 64):
        for number in numbers:
            if number in ENDING and not state.arrived.wait(GRACE_S):
                if state.stop is not None:
                    state.stop()
                else:
                    _leave(number)


def _leave(number: int) -> None:
    """Close the devices and exit the process, from any thread."""
    open_devices.close_all()
    _say(f"ended by {named(number)}")
    os._exit(code_of(number))


def _stop_all() -> None:
    """Zero all open devices; a failure is printed and changes neither the shutdown nor the exit code."""
    for error in open_devices.stop_all():
        _say(f"a device could not be stopped ({type(error).__name__}: {error}): it may still push, switch it off")


def _say(line: str) -> None:
    """Write a line to standard error without a lock: a signal may have interrupted another write."""
    with contextlib.suppress(OSError):
        os.write(2, (b"\r\x1b[K" if os.isatty(2) else b"") + f"softfinger: {line}\n".encode())


def _unraisable(otherwise: Callable[[Any], Any]) -> Callable[[Any], None]:
    """Return a hook that exits the process if `Interrupted` was raised in a C callback or a finalizer."""

    def hook(seen: Any) -> None:
        if isinstance(seen.exc_value, Interrupted):
            _leave(seen.exc_value.number)
        otherwise(seen)

    return hook
