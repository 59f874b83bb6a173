"""Exchange with Force Dimension's library, call by call: arguments, results, statuses."""

from math import nan
from typing import Any

import numpy as np
import pytest
from helpers.plain_by_call import BY_CALL, MS, START_NS, FarEnd, GuardedBlock, by_call, matrix, turned

from softfinger.drivers.base import FORCE_OFF, HELD, LOST, OK, SAMPLE_SIZE, STALE, TIMEOUT, WITHHELD
from softfinger.drivers.forcedimension import exchange
from softfinger.drivers.forcedimension.exchange import AT, STATUS_WORDS
from softfinger.drivers.forcedimension.library import ERROR_TIMEOUT

pytestmark = BY_CALL

ID = 3
LIBRARY_FUNCTIONS = ("get_frame", "get_position", "get_buttons", "get_gripper", "get_status", "get_error", "set_wrench")
ZERO = (0.0,) * 6
TO_WORLD = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""From the library's frame (x towards the user, y right, z up) to the world's (x right, y away from the user, z up)."""
FORCE, ERROR, CAUSE = 5, 9, 14
"""Indices of the library's status words, by its manual."""
NEARLY_A_ROTATION = turned(2, 0.3) @ np.diag([1.004, 1.004, 1.0])
"""Accepted as a rotation."""
NO_ROTATIONS = {
    "mirror": np.diag([1.0, 1.0, -1.0]),
    "long": np.diag([1.02, 1.0, 1.0]),
    "short": np.diag([1.0, 0.98, 1.0]),
    "last": np.diag([1.0, 1.0, 1.02]),
    "zeros": np.zeros((3, 3)),
    "nan": np.full((3, 3), np.nan),
    "askew": np.array([[1.0, 0.2, 0.0], [0.0, np.sqrt(0.96), 0.0], [0.0, 0.0, 1.0]]),
    # one row is of another length, though the volume is within a hundredth of 1
    **{
        f"row {row} {length}": np.diag(np.where(np.arange(3) == row, length, length**-0.49))
        for row in range(3)
        for length in (0.9891, 1.0109)
    },
}
"""Matrices that are refused as rotations."""


class Library(FarEnd):
    """Scripted library with `results` by name (0 by default), and an armed driver's block that calls it."""

    exchange = exchange

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.clock = by_call(patch, exchange)
        patch.setattr(exchange, "call_int32", self._call)
        self.block = GuardedBlock(AT)
        self.clock.room = {self.block.handle + 8 * AT.timespec}
        for number, name in enumerate(LIBRARY_FUNCTIONS, 100):
            self.word[getattr(AT, name)] = number
        self.word[AT.id], self.word[AT.open], self.word[AT.armed] = ID, 1, 1
        self.word[AT.has_frame] = self.word[AT.gripper_sign] = self.word[AT.has_torque] = 1
        self.word[AT.status_every], self.word[AT.started_at], self.word[AT.cause] = 4, START_NS - 2000 * MS, -1
        self.word[AT.frame + 3 : AT.frame + 12].view(np.float64)[:] = np.eye(3).ravel()
        self.gives: dict[str, int] = {}
        self.place, self.rotation, self.angle = np.array([0.01, 0.02, 0.03]), np.eye(3), 0.25
        self.status = dict.fromkeys(range(STATUS_WORDS), 0) | {FORCE: 1}
        self.calls: list[str] = []
        self.wrenches: list[tuple[float, ...]] = []

    def _call(self, address: int, arguments: tuple[Any, ...]) -> int:
        name = LIBRARY_FUNCTIONS[int(address) - 100]
        self.calls.append(name)
        if name == "get_error":
            assert arguments == ()
        else:
            assert arguments[-1] == ID and arguments[-1].itemsize == 4
        if name in ("get_frame", "get_position"):
            for k in range(3):
                arguments[k][0] = self.place[k]
        if name == "get_frame":
            for k in range(9):
                arguments[3][k] = self.rotation.ravel()[k]
        if name == "get_gripper":
            arguments[0][0] = self.angle
        if name == "get_status":
            for place, value in self.status.items():
                arguments[0][place] = value
        if name == "set_wrench":
            self.wrenches.append(arguments[:-1])
        return self.gives.get(name, 0)

    def read(self) -> tuple[int, np.ndarray]:
        self.calls.clear()
        return super().read()

    def write(self, *wrench: float) -> int:
        self.calls.clear()
        self.wrenches.clear()
        return super().write(*wrench)


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Library:
    return Library(monkeypatch)


# --- samples ---


def test_a_frame_is_a_pose_in_the_world(library: Library) -> None:
    library.rotation = turned(2, 0.3) @ turned(0, 0.7) @ turned(1, -1.1)
    library.gives["get_buttons"] = -2  # an int32 of a mask
    status, sample = library.read()
    assert status == OK
    np.testing.assert_allclose(sample[:3], TO_WORLD @ library.place, atol=1e-15)
    np.testing.assert_allclose(matrix(sample[3:7]), TO_WORLD @ library.rotation @ TO_WORLD.T, atol=1e-12)
    assert sample[7:].tolist() == [2.0, 2.0**32 - 2.0, 0.25]
    assert library.calls == ["get_frame", "get_buttons", "get_gripper"]
    for bits in (1, 6, 0x7FFFFFFF):
        library.gives["get_buttons"] = bits
        assert library.read()[1][8] == bits
    assert library.counts() == {"reads": 4}


@pytest.mark.parametrize(("sign", "angle"), [(-1, -0.25), (0, 0.0)])
def test_a_device_without_a_wrist_has_a_position_and_maybe_a_gripper(sign: int, angle: float, library: Library) -> None:
    library.word[AT.has_frame], library.word[AT.gripper_sign] = 0, sign
    status, sample = library.read()
    assert status == OK and library.calls == ["get_position", "get_buttons", "get_gripper"][: 2 + abs(sign)]
    np.testing.assert_allclose(sample[:3], TO_WORLD @ library.place, atol=1e-15)
    assert sample[3:7].tolist() == [1.0, 0.0, 0.0, 0.0] and sample[9] == angle


@pytest.mark.parametrize("name", NO_ROTATIONS)
def test_a_matrix_that_is_no_rotation_is_an_orientation_of_nan(name: str, library: Library) -> None:
    library.rotation = NO_ROTATIONS[name]
    status, sample = library.read()
    assert status == OK
    assert np.isnan(sample[3:7]).all() and np.isfinite(sample[[0, 1, 2, 7, 8, 9]]).all()
    library.rotation = NEARLY_A_ROTATION
    assert np.isfinite(library.read()[1]).all()


def test_a_repeated_reading_is_stale(library: Library) -> None:
    library.gives["get_frame"] = 1
    assert library.read()[0] == STALE and library.counts() == {"reads": 1, "reads_guarded": 1}


def test_while_the_device_is_being_stopped_the_last_sample_is_repeated(library: Library) -> None:
    _, before = library.read()
    library.place += 1.0
    library.word[AT.lock] = 1
    status, sample = library.read()
    assert (status, sample.tolist(), library.calls) == (STALE, before.tolist(), [])
    assert library.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD
    assert library.calls == [] and library.word[AT.lock] == 1
    library.word[AT.lock] = 0
    assert library.read()[1][0] == before[0] + 1.0 and library.word[AT.lock] == 0


def test_a_device_that_is_closed_is_lost(library: Library) -> None:
    library.word[AT.open] = 0
    assert library.read()[0] == LOST and library.calls == []


# --- failures reported by the library ---


@pytest.mark.parametrize("name", ["get_frame", "get_gripper"])
def test_a_failed_reading_has_a_reason(name: str, library: Library) -> None:
    library.gives |= {name: -1, "get_error": ERROR_TIMEOUT}
    assert library.read()[0] == TIMEOUT
    assert library.word[AT.error] == ERROR_TIMEOUT and library.calls[-1] == "get_error"
    library.gives["get_error"] = 2
    library.status |= {FORCE: 0, CAUSE: 6, ERROR: 7}
    assert library.read()[0] == LOST and library.calls[-2:] == ["get_error", "get_status"]
    assert [library.word[at] for at in (AT.error, AT.cause, AT.faulty)] == [2, 6, 7] and library.counts() == {}
    if name == "get_gripper":
        for code in (0, 1):
            library.gives[name] = code
            assert library.read()[0] == OK


@pytest.mark.parametrize(("code", "status"), [(ERROR_TIMEOUT, TIMEOUT), (2, LOST), (1, LOST)])
def test_a_failed_force_has_a_reason(code: int, status: int, library: Library) -> None:
    library.gives |= {"set_wrench": -1, "get_error": code}
    assert library.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == status and library.word[AT.error] == code


def test_the_status_is_read_periodically(library: Library) -> None:
    """An armed device's status is read every fourth read; before arming its force is off, so it is not read."""
    has_asked = []
    for _ in range(12):
        assert library.read()[0] == OK
        has_asked.append("get_status" in library.calls)
    assert has_asked == 3 * [False, False, False, True]
    library.word[AT.armed] = 0
    for _ in range(8):
        library.read()
        assert "get_status" not in library.calls


@pytest.mark.parametrize(
    ("words", "status"), [({FORCE: 0}, FORCE_OFF), ({ERROR: 9}, FORCE_OFF), ({FORCE: 0, ERROR: 9}, FORCE_OFF), ({}, OK)]
)
def test_a_device_that_turned_its_force_off_ends_the_run(words: dict[int, int], status: int, library: Library) -> None:
    library.word[AT.reads] = 2
    _, before = library.read()
    library.status |= {CAUSE: 4, **words}
    library.place += 1.0
    assert library.read()[0] == status
    sample = library.block.numbers(AT.sample, SAMPLE_SIZE).tolist()
    assert (sample == before.tolist()) is (status == FORCE_OFF)
    expected = (4, words.get(ERROR, 0)) if status == FORCE_OFF else (-1, 0)
    assert (library.word[AT.cause], library.word[AT.faulty]) == expected and "get_error" not in library.calls


def test_a_failed_status_call_is_a_failure(library: Library) -> None:
    library.gives |= {"get_status": -1, "get_error": ERROR_TIMEOUT}
    library.word[AT.reads] = 3
    assert library.read()[0] == TIMEOUT
    library.gives["get_error"], library.word[AT.reads] = 2, 3
    assert library.read()[0] == LOST
    library.gives["get_status"], library.word[AT.reads] = 1, 3
    assert library.read()[0] == OK


# --- forces ---


@pytest.mark.parametrize("has_torque", [0, 1])
def test_a_wrench_is_sent_in_the_librarys_frame(has_torque: int, library: Library) -> None:
    library.word[AT.has_torque] = has_torque
    force, torque = (1.0, 2.0, 3.0), (0.1, 0.2, 0.3)
    assert library.write(*force, *torque) == OK and library.calls == ["set_wrench"]
    ((*sent, gripper),) = library.wrenches
    assert sent == [*TO_WORLD.T @ force, *TO_WORLD.T @ torque * has_torque] and gripper == 0.0


@pytest.mark.parametrize("place", range(6))
def test_a_wrench_that_is_no_number_is_zero(place: int, library: Library) -> None:
    wrench = [1.0] * 6
    wrench[place] = nan
    assert library.write(*wrench) == WITHHELD and library.wrenches == [(0.0,) * 7]
    assert library.counts() == {"writes": 1}


@pytest.mark.parametrize("place", range(6))
def test_a_device_that_is_not_armed_gets_no_wrench(place: int, library: Library) -> None:
    wrench = [0.0] * 6
    wrench[place] = 1.0
    for armed, stopped in ((0, 0), (1, 1), (0, 1)):
        library.word[AT.armed], library.word[AT.stopped] = armed, stopped
        assert library.write(*wrench) == WITHHELD and library.write(*ZERO) == OK
        assert library.calls == []
    assert library.counts() == {}


@pytest.mark.parametrize(
    ("code", "status", "counts"),
    [(0, OK, {}), (1, HELD, {"writes_guarded": 1}), (2, STALE, {"saturated": 1}), (3, STALE, {})],
)
def test_results_of_a_force(code: int, status: int, counts: dict[str, int], library: Library) -> None:
    library.gives["set_wrench"] = code
    assert library.write(1.0, 0.0, 0.0, 0.0, 0.0, 0.0) == status and library.counts() == {"writes": 1, **counts}
    assert library.write(nan, 0.0, 0.0, 0.0, 0.0, 0.0) == WITHHELD
    assert library.counts() == {"writes": 2, **dict.fromkeys(counts, 2)}
