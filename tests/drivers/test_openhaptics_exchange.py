"""Callback of 3D Systems' library and the servo's side, call by call, on a scripted library and clock."""

import ctypes
from math import inf, nan
from typing import Any

import numpy as np
import pytest
from helpers.plain_by_call import BY_CALL, MS, START_NS, FarEnd, GuardedBlock, by_call, matrix, turned

from softfinger.drivers.base import FORCE_OFF, HELD, LOST, OK, PROTOCOL, STALE, TIMEOUT, WITHHELD
from softfinger.drivers.openhaptics import exchange
from softfinger.drivers.openhaptics.block import AT

pytestmark = BY_CALL

DEVICE, OTHER, NOBODY = 17, 42, 0xFFFFFFFF
LIBRARY_FUNCTIONS = (
    "begin_frame", "end_frame", "get_doubles", "get_integers", "get_booleans", "set_doubles", "get_error", "enable",
    "disable", "is_enabled",
)  # fmt: skip
BUTTONS, INKWELL, POSITION, TRANSFORM, TEMPERATURE = 0x2000, 0x2002, 0x2050, 0x2052, 0x2605
FORCE, TORQUE, OUTPUT = 0x2700, 0x2701, 0x4000
"""Constants of the library's header."""
INVALID_ENUM, INVALID_VALUE, INVALID_OPERATION, INVALID_INPUT_TYPE = 0x100, 0x101, 0x102, 0x103
BAD_HANDLE, WARM_MOTORS, FORCE_ERROR, DEVICE_FAULT, COMM_ERROR, COMM_CONFIG_ERROR = (
    0x104, 0x200, 0x204, 0x300, 0x302, 0x303,
)  # fmt: skip
AGE_MAX = 5 * MS
TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From the library's frame (x right, y up, z towards the user) to the world's (x right, y away from the user, z up)."""
ZERO = (0.0,) * 6
PULL = (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
OVER, AGAIN = 0, 1


class Library(FarEnd):
    exchange = exchange

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.clock = by_call(patch, exchange)
        patch.setattr(exchange, "call_void", self._call)
        patch.setattr(exchange, "call_int32", self._call)
        patch.setattr(exchange, "call_two_int64", self._call)
        self.block = GuardedBlock(AT)
        word = self.block.word
        for number, name in enumerate(LIBRARY_FUNCTIONS, 100):
            word[getattr(AT, name)] = number
        word[AT.device], word[AT.has_torque], word[AT.age_max] = DEVICE, 1, AGE_MAX
        word[AT.started_at] = START_NS - 2000 * MS
        word[AT.open] = word[AT.armed] = word[AT.has_inkwell] = word[AT.has_temperature] = word[AT.switch] = 1
        word[AT.output], word[AT.read_at], word[AT.framed_at] = -1, START_NS, START_NS
        self.place, self.rotation, self.buttons, self.switch = np.array([11.0, 22.0, -33.0]), np.eye(3), 0, 1
        self.temperatures = [0.05] * 6
        self.output, self.refuses = 0, False
        self.errors: list[tuple[int, int, int]] = []
        """(code, internal, device), the last is popped first."""
        self.calls: list[Any] = []

    def _call(self, address: int, arguments: tuple[Any, ...]) -> Any:
        name = LIBRARY_FUNCTIONS[int(address) - 100]
        parameter = int(arguments[0]) if arguments else 0
        assert all(isinstance(argument, np.int32) for argument in arguments[:1])
        self.calls.append((name, parameter) if arguments else name)
        if name == "get_error":
            code, internal, device = self.errors.pop() if self.errors else (0, 0, NOBODY)
            return code | internal << 32, device | 0x5A << 32  # unused parts of the struct are undefined
        if name == "get_doubles":
            given_to = {POSITION: self.place, TRANSFORM: self._columns(), TEMPERATURE: self.temperatures}[parameter]
            (ctypes.c_double * len(given_to)).from_address(arguments[1])[:] = list(given_to)
        elif name == "get_integers":
            ctypes.c_int32.from_address(arguments[1]).value = self.buttons
        elif name == "get_booleans":
            ctypes.c_uint8.from_address(arguments[1]).value = self.switch
        elif name == "set_doubles":
            self.calls[-1] = (name, parameter, tuple((ctypes.c_double * 3).from_address(arguments[1])))
        elif name in ("enable", "disable") and not self.refuses:
            self.output = int(name == "enable")
        return 0x5A00 | self.output if name == "is_enabled" else None  # a char, in an int

    def _columns(self) -> list[float]:
        whole = np.eye(4)
        whole[:3, :3], whole[:3, 3] = self.rotation, self.place
        return [float(v) for v in whole.T.ravel()]

    def frame(self, after: int = MS) -> int:
        self.clock.now += after
        self.clock.room = {self.block.handle + 8 * AT.frame_timespec}
        self.block.fixed = [
            (AT.reads, AT.frame_timespec), (AT.servo_timespec, AT.position), (AT.read_pose, AT.read_wrench)
        ]  # fmt: skip
        self.calls.clear()
        return self.block.call(exchange.run_frame)

    def read(self) -> tuple[int, np.ndarray]:
        self.clock.room = {self.block.handle + 8 * AT.servo_timespec}
        self.block.fixed = [(0, AT.reads), (AT.position, AT.read_pose), (AT.wrench, len(self.word))]
        return super().read()

    def write(self, *wrench: float) -> int:
        self.clock.room = {self.block.handle + 8 * AT.servo_timespec}
        self.block.fixed = [(0, AT.reads), (AT.position, AT.wrench), (AT.read_wrench, len(self.word))]
        return super().write(*wrench)

    def displayed_force(self, parameter: int = FORCE) -> list[float]:
        """Return the vector that the last frame wrote to the motors, in the world frame (N, mN m)."""
        (vector,) = [call[2] for call in self.calls if call[:2] == ("set_doubles", parameter)]
        return [float(v) for v in TURN @ vector]

    def displays(self, *wrench: float) -> bool:
        self.frame()
        return self.displayed_force() == list(wrench[:3]) and np.allclose(
            self.displayed_force(TORQUE), 1000.0 * np.array(wrench[3:])
        )

    def warmed_up(self) -> None:
        for _ in range(exchange.PROBES + 1):
            assert self.frame() == AGAIN
        assert self.read()[0] == OK


@pytest.fixture
def opening(monkeypatch: pytest.MonkeyPatch) -> Library:
    return Library(monkeypatch)


@pytest.fixture
def library(opening: Library) -> Library:
    opening.warmed_up()
    return opening


# --- frames ---


def test_the_order_of_a_frame(library: Library) -> None:
    library.frame()
    assert [call if isinstance(call, str) else call[:2] for call in library.calls] == [
        ("begin_frame", DEVICE), ("get_doubles", POSITION), ("get_doubles", TRANSFORM), ("get_integers", BUTTONS),
        ("get_booleans", INKWELL), ("set_doubles", FORCE), ("set_doubles", TORQUE), ("end_frame", DEVICE), "get_error",
    ]  # fmt: skip
    library.word[AT.has_torque] = library.word[AT.has_inkwell] = 0
    library.frame()
    assert not {TORQUE, INKWELL} & {call[1] for call in library.calls}


def test_the_motors_are_switched_on_changes_only(opening: Library) -> None:
    on, off = ["enable", "is_enabled"], ["disable", "is_enabled"]
    for armed, refuses, switched in ((1, False, [on, []]), (0, False, [off, []]), (1, True, [on, on])):
        opening.word[AT.armed], opening.refuses = armed, refuses
        for expected in switched:
            opening.frame()
            assert [call[0] for call in opening.calls if call[1:] == (OUTPUT,)] == expected


def test_a_frame_is_a_pose_in_the_world(library: Library) -> None:
    library.rotation, library.buttons = turned(2, 0.3) @ turned(0, 0.7) @ turned(1, -1.1), -2
    library.frame()
    status, sample = library.read()
    assert status == OK
    np.testing.assert_allclose(sample[:3], TURN @ library.place / 1000.0, atol=1e-15)
    np.testing.assert_allclose(matrix(sample[3:7]), TURN @ library.rotation @ TURN.T, atol=1e-12)
    assert sample[7] == (library.word[AT.framed_at] - library.word[AT.started_at]) / 1e9
    assert sample[8:].tolist() == [2.0**32 - 2.0, 0.0]
    for bits in (1, 10, 0x7FFFFFFF):
        library.buttons = bits
        library.frame()
        assert library.read()[1][8] == bits


def test_the_temperature_is_read_each_hundredth_frame(opening: Library) -> None:
    frames, inkwell = [], []
    for number in range(301):
        opening.frame()
        frames += [number] if ("get_doubles", TEMPERATURE) in opening.calls else []
        inkwell += [] if ("get_booleans", INKWELL) in opening.calls else [number]
    assert frames == [1, 99, 199, 299] and inkwell == [1]
    for temperatures, wanted in (([nan, 0.5, inf, -inf, 0.25, 0.0], 500), ([1e300] + [0.0] * 5, 10000), ([nan] * 6, 0)):
        opening.temperatures, opening.word[AT.frames] = temperatures, 99
        opening.frame()
        assert opening.word[AT.temperature] == wanted


# --- forces ---


def test_a_wrench_is_written_in_the_librarys_frame(library: Library) -> None:
    for wrench in (PULL, ZERO):
        assert library.write(*wrench) == OK
        assert library.displays(*wrench) and library.displays(*wrench)
    assert [library.word[at] for at in (AT.has_force, AT.lapses, AT.writes)] == [0, 0, 2]


def test_a_wrench_being_written_is_used_in_the_next_frame(library: Library) -> None:
    library.write(*PULL)
    library.frame()
    library.write(2.0, 2.0, 2.0, 0.0, 0.0, 0.0)
    library.word[AT.wrench] -= 1
    assert library.displays(*PULL)
    library.word[AT.wrench] += 1
    assert library.displays(2.0, 2.0, 2.0, 0.0, 0.0, 0.0)


def test_a_force_that_is_too_old_is_ended(library: Library) -> None:
    library.write(*PULL)
    for _ in range(5):
        assert library.displays(*PULL)
    assert library.displays(*ZERO) and library.displays(*ZERO)
    for status, displayed in ((WITHHELD, ZERO), (OK, PULL)):
        assert library.write(*PULL) == status and library.displays(*displayed)
        assert library.counts()["lapses"] == 1


def test_a_pause_of_the_librarys_thread_ends_the_force(library: Library) -> None:
    library.write(*PULL)
    library.frame()
    library.clock.now += AGE_MAX
    library.write(*PULL)
    library.frame(1)
    assert library.displayed_force() == [0.0, 0.0, 0.0] and library.counts()["lapses"] == 1
    library.frame()
    assert library.displayed_force() == [0.0, 0.0, 0.0]  # written before the servo detected it
    assert library.write(*PULL) == WITHHELD and library.write(*PULL) == OK
    assert library.displays(*PULL)


def test_late_frames_withhold_the_force(library: Library) -> None:
    statuses = []
    for _ in range(5):
        for _ in range(6):
            library.clock.now += MS
            statuses.append(library.write(*PULL))
        library.frame(0)
        assert library.displayed_force() == [0.0, 0.0, 0.0] and library.displayed_force(TORQUE) == [0.0, 0.0, 0.0]
    assert statuses == [OK] * 5 + [WITHHELD] * 25  # in the first 5 ms no frame was late
    library.frame()
    assert library.write(*PULL) == OK and library.displays(*PULL)


def test_a_force_that_never_reaches_the_motors_is_a_lapse(library: Library) -> None:
    assert library.write(*PULL) == OK
    for _ in range(3):
        library.frame(AGE_MAX + 1)
        assert library.displayed_force() == [0.0, 0.0, 0.0]
    assert library.counts()["lapses"] == 1
    library.frame()
    assert library.write(*PULL) == WITHHELD and library.displays(*ZERO)
    assert library.write(*PULL) == OK and library.displays(*PULL)


def test_writes_while_frames_have_stopped(library: Library) -> None:
    library.write(*PULL)
    library.frame()
    library.clock.now += AGE_MAX
    assert library.write(*PULL) == OK
    library.clock.now += 1
    assert [library.write(*PULL), library.write(*ZERO)] == [HELD, HELD]
    library.frame(0)
    assert library.displayed_force() == [0.0, 0.0, 0.0]
    library.clock.now += AGE_MAX + 1
    assert [library.write(*PULL), library.write(*ZERO)] == [WITHHELD, OK]


@pytest.mark.parametrize("place", range(6))
def test_a_wrench_of_one_component_can_lapse_and_be_withheld(place: int, library: Library) -> None:
    wrench = [0.0] * 6
    wrench[place] = 1.0
    library.write(*wrench)
    assert library.displays(*wrench)
    library.word[AT.armed] = 0
    assert library.displays(*ZERO)
    assert library.word[AT.has_force] == 0 and library.counts()["lapses"] == 1
    assert library.write(*wrench) == WITHHELD


@pytest.mark.parametrize(("name", "value"), [("armed", 0), ("stopped", 1), ("is_leaving", 1), ("status", LOST)])
def test_no_force_unless_armed_and_running(name: str, value: int, library: Library) -> None:
    library.write(*PULL)
    library.frame()
    library.word[getattr(AT, name)] = value
    assert library.frame() == (OVER if name == "is_leaving" else AGAIN)
    assert library.displayed_force() == [0.0, 0.0, 0.0] and library.displayed_force(TORQUE) == [0.0, 0.0, 0.0]
    assert library.output == 0 and library.word[AT.has_sent_zero] == (name == "stopped")
    assert library.word[AT.has_left] == (name == "is_leaving")


def test_a_stop_during_a_frame_is_confirmed_by_the_next(library: Library) -> None:
    call = library._call

    def meanwhile(address: int, arguments: tuple[Any, ...]) -> Any:
        if LIBRARY_FUNCTIONS[address - 100] == "end_frame":
            library.word[AT.stopped] = library.word[AT.is_leaving] = 1
        return call(address, arguments)

    exchange.call_void = meanwhile
    assert library.frame() == AGAIN and [library.word[at] for at in (AT.has_sent_zero, AT.has_left)] == [0, 0]
    exchange.call_void = call
    assert library.frame() == OVER and [library.word[at] for at in (AT.has_sent_zero, AT.has_left)] == [1, 1]


def test_a_closed_device_is_not_called(library: Library) -> None:
    library.word[AT.open] = 0
    assert library.frame() == OVER and library.calls == []
    assert library.read()[0] == LOST


def test_no_force_in_the_inkwell(library: Library) -> None:
    library.write(*PULL)
    library.frame()
    library.switch = 0
    assert library.displays(*ZERO)
    assert library.word[AT.docked] == 1 and library.output == 1
    assert [library.write(*PULL) for _ in range(3)] == [WITHHELD] * 3
    assert library.write(*ZERO) == OK and library.write(nan, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD
    assert library.displays(*ZERO)
    library.switch = 1
    assert library.displays(*ZERO)  # wrenches written while it was docked are not used
    assert library.word[AT.docked] == 0 and library.write(*PULL) == OK
    assert library.displays(*PULL)
    library.switch = library.word[AT.has_inkwell] = 0
    library.word[AT.switch] = 0
    library.frame()
    assert library.word[AT.docked] == 0


def test_a_zero_after_a_lapse_is_ok(library: Library) -> None:
    library.write(*PULL)
    library.frame()
    library.word[AT.armed] = 0
    library.frame()
    assert library.write(*ZERO) == OK
    library.word[AT.armed] = 1
    assert library.write(*PULL) == OK


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("place", range(6))
def test_a_wrench_that_is_no_number_is_zero(place: int, bad: float, library: Library) -> None:
    wrench = list(PULL)
    wrench[place] = bad
    assert library.write(*wrench) == WITHHELD and library.displays(*ZERO)
    assert library.write(*PULL) == OK


@pytest.mark.parametrize(("armed", "stopped"), [(0, 0), (1, 1), (0, 1)])
def test_a_device_that_is_not_armed_withholds(armed: int, stopped: int, library: Library) -> None:
    library.word[AT.armed], library.word[AT.stopped] = armed, stopped
    assert library.write(*PULL) == WITHHELD and library.write(*ZERO) == OK
    library.write(*PULL)
    library.word[AT.armed], library.word[AT.stopped] = 1, 0
    assert library.displays(*ZERO)


# --- errors ---


@pytest.mark.parametrize(
    ("code", "status"),
    [
        (BAD_HANDLE, LOST), (DEVICE_FAULT, LOST), (COMM_ERROR, LOST), (COMM_CONFIG_ERROR, LOST),
        (WARM_MOTORS, FORCE_OFF), (WARM_MOTORS + 1, FORCE_OFF), (FORCE_ERROR, FORCE_OFF),
        (FORCE_ERROR + 1, PROTOCOL), (WARM_MOTORS - 1, PROTOCOL),
        (INVALID_ENUM, PROTOCOL), (0x402, PROTOCOL), (1, PROTOCOL),
    ],
)  # fmt: skip
def test_an_error_ends_the_run_with_its_status(code: int, status: int, library: Library) -> None:
    library.write(*PULL)
    library.frame()
    library.read()
    library.errors = [(code, 7, DEVICE)]
    library.frame()
    assert library.calls[-2:] == ["get_error"] * 2
    assert [library.word[at] for at in (AT.status, AT.error, AT.internal)] == [status, code, 7]
    assert library.read()[0] == status and library.counts()["errors"] == 1
    sequence = int(library.word[AT.pose])
    library.frame()
    assert library.displayed_force() == [0.0, 0.0, 0.0] and library.output == 0
    assert library.word[AT.pose] == sequence


def test_the_most_severe_error_is_reported(library: Library) -> None:
    """An error that ended the device precedes a misuse; otherwise the first is reported, also from an earlier frame."""
    library.errors = [(COMM_ERROR, 1, DEVICE), (WARM_MOTORS, 2, DEVICE), (0x402, 3, DEVICE), (0x401, 4, DEVICE)]
    for later_errors in ([], [(DEVICE_FAULT, 5, DEVICE)]):
        library.errors += later_errors
        library.frame()
        assert [library.word[at] for at in (AT.status, AT.error, AT.internal)] == [FORCE_OFF, WARM_MOTORS, 2]
    assert library.counts()["errors"] == 5


def test_errors_of_other_devices_are_ignored(library: Library) -> None:
    library.errors = [(COMM_ERROR, 1, OTHER)] * 2
    library.frame()
    assert library.read()[0] == OK and library.counts()["errors"] == 2
    library.errors = [(COMM_ERROR, 1, NOBODY)]
    library.frame()
    assert library.read()[0] == LOST


@pytest.mark.parametrize("code", [INVALID_ENUM, INVALID_VALUE, INVALID_OPERATION, INVALID_INPUT_TYPE])
def test_a_rejected_first_query_disables_the_feature(code: int, opening: Library) -> None:
    for expected in ([0, 1, OK], [0, 0, OK], [0, 0, PROTOCOL]):
        opening.errors = [(code, 0, DEVICE)]
        opening.frame()
        assert [opening.word[at] for at in (AT.has_inkwell, AT.has_temperature, AT.status)] == expected


# --- reads ---


def test_a_frame_is_read_once_and_then_repeated(library: Library) -> None:
    library.frame()
    first = library.read()[1].tolist()
    status, sample = library.read()
    assert (status, sample.tolist()) == (STALE, first)
    library.place += 1.0
    library.frame()
    library.word[AT.pose] -= 1
    assert library.read()[1].tolist() == first
    library.word[AT.pose] += 1
    status, sample = library.read()
    assert status == OK and sample[0] != first[0]
    assert (library.counts()["reads"], library.counts()["repeated"]) == (5, 2)


def test_a_silent_library_counts_as_lost(library: Library) -> None:
    library.read()
    for pause in (10 * MS, 50 * MS):  # a longer pause of the loop counts as 10 ms
        library.frame(0)
        assert library.read()[0] == OK
        for _ in range(10):
            library.clock.now += pause
            assert library.read()[0] == STALE
    library.clock.now += 1
    assert library.read()[0] == TIMEOUT
