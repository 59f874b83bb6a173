"""How a program ends by a signal: in order, by the first one, within a second; and how Ctrl-Z leaves no force behind.

`cli.main` has every signal that would end the process handled here. What becomes of one depends on what is going on:

    while modules are imported    the process leaves at once: nothing is open yet
    in any verb                   `Interrupted` is raised in the main thread, once: contexts close what they opened
    inside `asked`                a function is called and nothing raised: a servo or a recording ends in order
    inside `held`                 it is only noted: a closing is not interrupted

A main thread that is in a compiler of half a minute takes no exception. Then the devices are closed from another
thread and the process leaves from there.
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

from softfinger.drivers import opened

STOPPING: Final = frozenset({signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU})
"""Stop the process until SIGCONT."""
_HARMLESS: Final = frozenset({signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH})
_NOT_CAUGHT: Final = frozenset({signal.SIGKILL, signal.SIGSTOP})
_FAULTS: Final = frozenset({signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGTRAP})
"""A handler of these would return to the instruction that failed."""
ENDING: Final = frozenset(signal.valid_signals()) - STOPPING - _HARMLESS - _NOT_CAUGHT - _FAULTS
"""Every signal that would end the process and can be caught."""
USUAL: Final = frozenset({signal.SIGINT, signal.SIGTERM})
"""The ways of asking a daemon to stop, so no failure."""

GRACE_S: Final = 0.5
"""How long the main thread has to take a signal. Python's own code takes it in a switch interval."""


class Interrupted(KeyboardInterrupt):
    """A signal asks for the end. As with KeyboardInterrupt, `except Exception` does not catch it."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class _State:
    def __init__(self) -> None:
        self.number = 0
        """The first signal that asked for the end; 0 before there is one."""
        self.importing = False
        self.held = 0
        self.stop: Callable[[], None] | None = None
        self.pause: Callable[[], Callable[[], None]] | None = None
        self.arrived = threading.Event()


_state = _State()


def named(number: int) -> str:
    """Name of a signal; the real-time ones between the first and the last have none."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def code_of(number: int) -> int:
    """Exit code of a process that a signal ended, as a shell has it."""
    return 128 + number


def code_of_stop() -> int:
    """Exit code of what was asked to stop and did in order: 0 after the usual signals and after none."""
    return 0 if _state.number in USUAL else code_of(_state.number) if _state.number else 0


@contextmanager
def handled(to_the_end: bool = False) -> Iterator[None]:
    """Signals are handled as this module says. Where they cannot be, outside the main thread, nothing changes.

    to_the_end  the process ends behind the block: signals are ignored from there on, and change no exit code
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
        # nohup, and a shell in the background, have had some ignored for us; Python itself SIGPIPE.
        if number in USUAL or signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, _pause if number in STOPPING else _end)
    watch = threading.Thread(target=_watch_main, args=(receiver, _state), name="signals", daemon=True)
    watch.start()
    try:
        yield
    finally:
        with held():
            _stop_all()  # what an interrupt left between its opening and its context
            for number, handler in before.items():
                signal.signal(number, signal.SIG_IGN if to_the_end else handler)
        signal.set_wakeup_fd(wakeup)
        os.close(sender)
        watch.join()
        os.close(receiver)
        sys.unraisablehook = hook
        _state = outer


def imported() -> None:
    """Imports are done: from here on a signal raises `Interrupted`."""
    _state.importing = False


@contextmanager
def asked(stop: Callable[[], None], pause: Callable[[], Callable[[], None]] | None = None) -> Iterator[None]:
    """Inside, a signal calls `stop`, as often as one comes, and raises nothing.

    pause  called before the process stops (Ctrl-Z): takes the force off, and returns what puts it back
    """
    state = _state
    before = state.stop, state.pause
    state.stop, state.pause = stop, pause
    if state.number:  # what it raised was swallowed: some libraries import others and take whatever comes of it
        stop()
    try:
        yield
    finally:
        state.stop, state.pause = before


@contextmanager
def held() -> Iterator[None]:
    """Inside, a signal is noted and nothing else."""
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
    """No force while the process is stopped. What does not pause is ended after it, in order."""
    state = _state
    if state.held:
        return
    devices = [] if state.pause is not None else list(opened.devices)
    go_on = None if state.pause is None else state.pause()
    if devices:
        _stop_all()
    # The system's own action, so that shells see what they know, and a group of processes without a shell goes on.
    signal.signal(number, signal.SIG_DFL)
    signal.raise_signal(number)
    signal.signal(number, _pause)
    if go_on is not None:
        go_on()
    if devices:
        _end(number, None)


def _watch_main(receiver: int, state: _State) -> None:
    """See to it that a signal is taken, wherever the main thread is."""
    while numbers := os.read(receiver, 64):
        for number in numbers:
            if number in ENDING and not state.arrived.wait(GRACE_S):
                if state.stop is not None:
                    state.stop()
                else:
                    _leave(number)


def _leave(number: int) -> None:
    """End the process from any thread, with the devices closed."""
    opened.close_all()
    _say(f"ended by {named(number)}")
    os._exit(code_of(number))


def _stop_all() -> None:
    """Zero what is open. One that refuses is named and changes nothing else: not the shutdown, not the exit code."""
    for error in opened.stop_all():
        _say(f"a device could not be stopped ({type(error).__name__}: {error}): it may still push, switch it off")


def _say(line: str) -> None:
    """A line on standard error from wherever this is: a signal may have come while another was being written."""
    with contextlib.suppress(OSError):
        os.write(2, (b"\r\x1b[K" if os.isatty(2) else b"") + f"softfinger: {line}\n".encode())


def _unraisable(otherwise: Callable[[Any], Any]) -> Callable[[Any], None]:
    """An `Interrupted` that was raised where nothing can be, in a callback of C or a finalizer, ends the process."""

    def hook(seen: Any) -> None:
        if isinstance(seen.exc_value, Interrupted):
            _leave(seen.exc_value.number)
        otherwise(seen)

    return hook
