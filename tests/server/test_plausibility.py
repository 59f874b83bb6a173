"""Check of a device's pose before it moves the probe: its numbers, its reach, jumps and standstill."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from softfinger.drivers.base import OK, SAMPLE_SIZE, STALE
from softfinger.proxy.kernels.model import Vec3
from softfinger.server.loop.guard import POSE_FROZEN, POSE_JUMPED, Guard
from softfinger.server.loop.plausibility import check_pose, make_pose_memory
from softfinger.server.loop.tick import POSITION_MAX_M, has_pose

pytestmark = pytest.mark.plain


T = 0.001
NONE = (0.0, 0.0, 0.0)
TILTED = (0.1, -0.2, 0.3, 0.5, -0.5, 0.5, 0.5)
"""A position (m), and a unit quaternion without zeros."""


def make_sample(*numbers: float) -> np.ndarray:
    row = np.zeros(SAMPLE_SIZE)
    row[: len(numbers)] = numbers
    return row


def replace_number(place: int, value: float) -> np.ndarray:
    row = make_sample(*TILTED)
    row[place] = value
    return row


@pytest.mark.parametrize("place", range(7))
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_number_may_be_missing(place: int, value: float) -> None:
    assert has_pose(make_sample(*TILTED)) and not has_pose(replace_number(place, value))


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_reach_ends_on_each_axis_on_both_sides(axis: int, side: float) -> None:
    assert has_pose(replace_number(axis, side * POSITION_MAX_M))
    assert not has_pose(replace_number(axis, side * math.nextafter(POSITION_MAX_M, math.inf)))


@pytest.mark.parametrize("axis", range(4))
def test_a_quaternion_is_about_unit(axis: int) -> None:
    for length, is_accepted in ((0.0, False), (0.499, False), (0.5, True), (1.0, True), (2.0, True), (2.001, False)):
        quaternion = [0.0] * 4
        quaternion[axis] = -length
        assert bool(has_pose(make_sample(0.0, 0.0, 0.0, *quaternion))) == is_accepted


LIMITED = Guard(12.0, 0.3, 2000.0, 50.0, 0.5, 1.0, speed_max=10.0, turn_max=100.0, frozen=0.0105)

Poses = Sequence[Sequence[float]]

PUSH = (0.0, 0.0, 1.0)

UNHELD = LIMITED._replace(speed_max=math.inf, turn_max=math.inf, frozen=0.0)
"""Limits of a device without a hand on it: `test_guard.py`."""


def check(poses: Poses, statuses: Sequence[int] = (), force: Vec3 = NONE, guard: Guard = LIMITED) -> list[int]:
    """Return the result of the check for each pose, one tick apart."""
    memory, pairs = make_pose_memory(), zip(poses, statuses or [OK] * len(poses), strict=True)
    return [int(check_pose(guard, memory, make_sample(*pose), status, force, T)) for pose, status in pairs]


def pose_at(x: float) -> tuple[float, ...]:
    return (x, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def turn_pose(angle: float) -> tuple[float, ...]:
    return (0.0, 0.0, 0.0, math.cos(0.5 * angle), 0.0, math.sin(0.5 * angle), 0.0)


@pytest.mark.parametrize("axis", range(3))
def test_a_pose_faster_than_the_speed_limit_is_a_jump(axis: int) -> None:
    def check_along_axis(*numbers: float) -> list[int]:
        return check([replace_number(axis, number).tolist() for number in numbers])

    assert check_along_axis(5.0, 5.0099, 5.0) == [0, 0, 0]
    assert check_along_axis(0.0, 0.0101, 0.0) == [0, POSE_JUMPED, POSE_JUMPED]


def test_a_rotation_faster_than_the_turn_limit_is_a_jump() -> None:
    doubled = tuple(-2.0 * c if k > 2 else c for k, c in enumerate(turn_pose(0.099)))
    assert check([turn_pose(0.0), turn_pose(0.099), turn_pose(0.0), doubled]) == [0, 0, 0, 0]
    assert check([turn_pose(0.0), turn_pose(0.101), turn_pose(-3.0)]) == [0, POSE_JUMPED, POSE_JUMPED]


def test_a_held_pose_extends_the_time_for_the_next_one() -> None:
    broken = (math.nan,) * 7
    for waiting, status in ((pose_at(0.0), STALE), (broken, OK)):
        for x, expected in ((0.059, 0), (0.061, POSE_JUMPED)):
            assert check([pose_at(0.0), *[waiting] * 5, pose_at(x)], [OK, *[status] * 5, OK]) == [0] * 6 + [expected]
        for angle, expected in ((0.59, 0), (0.61, POSE_JUMPED)):
            assert check([turn_pose(0.0), *[waiting] * 5, turn_pose(angle)], [OK, *[status] * 5, OK])[-1] == expected
    assert check([pose_at(0.0)] * 6 + [pose_at(0.059)])[-1] == POSE_JUMPED  # the driver reported them as new
    # At 100 rad/s every rotation is possible after 31.4 ms.
    assert check([turn_pose(0.0)] + [broken] * 30 + [turn_pose(3.14)])[-1] == POSE_JUMPED
    assert check([turn_pose(0.0)] + [broken] * 31 + [turn_pose(3.14)])[-1] == 0


def test_a_repeated_pose_is_frozen_only_under_a_force() -> None:
    same, moved = [pose_at(0.009)] * 20, pose_at(math.nextafter(0.009, 1.0))
    assert check([*same, moved], force=PUSH) == [0] * 11 + [POSE_FROZEN] * 9 + [0]
    assert check(same, force=(0.0, 0.0, 0.009)) == [0] * 20


def test_recorded_poses_may_jump_and_stand_still() -> None:
    assert check([pose_at(0.0)] * 20 + [pose_at(9.0), turn_pose(3.0)], force=PUSH, guard=UNHELD) == [0] * 22


def test_a_frozen_pose_remains_frozen_without_the_force() -> None:
    memory = make_pose_memory()
    for _ in range(30):
        check_pose(LIMITED, memory, make_sample(*pose_at(0.0)), OK, PUSH, T)
    assert check_pose(LIMITED, memory, make_sample(*pose_at(0.0)), OK, NONE, T) == POSE_FROZEN
