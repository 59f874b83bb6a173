"""Command `zero`: exact offset of a probe, without motion, and never under a force."""

from typing import Any

import numpy as np
import pytest
from helpers.pressed import DEPTH_M, pressed_scene
from helpers.two_fingers import pressed_by_two, two_devices
from helpers.waits import eventually
from test_commands import ROUNDING, events, rig, running  # noqa: F401 - rig is a fixture

from softfinger.config.errors import CommandRefused
from softfinger.config.load import describe
from softfinger.proxy.record import AT
from softfinger.server.loop.tick import UNMOVED
from softfinger.server.wire.control import Control

HELD_M = 0.009
"""Height of the device of these tests, which oscillates along x."""
SWAY_M_PER_S = 0.005 * 0.02 * 1000.0


def zero_when_off(control: Control, **arguments):
    """Send `zero` as soon as the force is off."""

    def zero() -> Any:
        try:
            return control.zero(**arguments)
        except CommandRefused as error:
            if not str(error).startswith("busy: "):
                raise

    answer = eventually(zero)
    assert answer
    return answer


def test_a_zero_offset_changes_no_bit():
    numbers = np.array([0.0, -0.0, 5e-324, -1.0, np.inf])
    assert (numbers + UNMOVED[0]).tobytes() == numbers.tobytes()


def test_the_probe_is_at_the_requested_position(rig):  # noqa: F811
    """It is refused under a force; afterwards F_z = k d + f at the new depth, until a reset."""
    with running(rig()) as (daemon, control, recorder), events(daemon) as next_event:
        with pytest.raises(CommandRefused, match=r"^refused: .* disarm first"):
            control.zero()
        control.disarm()
        next_event("command")
        answer = zero_when_off(control, position_m=(0.0, 0.0, HELD_M + 0.0005))
        message = next_event("command")
        assert message["name"] == "zero" and message["what"] == {"finger": "", "offset_m": list(answer.offset_m)}
        assert answer.offset_m[2] == pytest.approx(0.0005, rel=1e-9)  # a difference of numbers 20 times as large
        assert control.describe()["fingers"][0]["offset_m"] == list(answer.offset_m)
        recorder.wait_for_tick(answer.tick + 20)
        rows = recorder.since(answer.tick + 2)
        np.testing.assert_allclose(rows[:, AT.probe_position + 2], HELD_M + 0.0005, rtol=ROUNDING)
        # The tick in which the offset is applied is among these; moving 0.5 mm in a tick would be 0.5 m/s.
        velocities = recorder.since(answer.tick - 5)[:, AT.probe_velocity : AT.probe_velocity + 3]
        assert np.abs(velocities[:, 2]).max() == 0.0 and np.abs(velocities[:, 0]).max() <= SWAY_M_PER_S
        assert not recorder.since(answer.tick)[:, AT.force + 2].any()
        control.arm()
        assert eventually(lambda: recorder.force_n == pytest.approx(0.5 + 1.0, rel=1e-9))
        control.set_scene(describe(pressed_scene(stiffness_n_per_m=2000.0)))
        assert eventually(lambda: recorder.force_n == pytest.approx(1.0 + 1.0, rel=1e-9))
        control.disarm()
        second_answer = zero_when_off(control, position_m=(0.0, 0.0, 0.009))
        assert second_answer.offset_m[2] == pytest.approx(0.0, abs=1e-15)  # rounding of sums of about 0.01
        assert zero_when_off(control, reset=True).offset_m == (0.0, 0.0, 0.0)
        control.arm()
        assert eventually(lambda: recorder.force_n == pytest.approx(2000.0 * DEPTH_M + 1.0, rel=ROUNDING))
        assert recorder.latest(AT.probe_position + 2) == HELD_M


def test_one_of_several_fingers_is_shifted(rig):  # noqa: F811
    device = {"driver": "faulty"}
    two_boards = two_devices(device, device, guard=describe(rig())["guard"])
    with running(two_boards, pressed_by_two()) as (_, control, recorder):
        control.disarm()
        with pytest.raises(CommandRefused, match="set finger to one of thumb, index"):
            control.zero()
        answer = zero_when_off(control, position_m=(0.0, 0.0, 0.0085), finger="index")
        recorder.wait_for_tick(answer.tick + 2)
        heights = recorder.batches[-1][-1].reshape(2, -1)[:, AT.probe_position + 2]
        assert heights[0] == HELD_M and heights[1] == pytest.approx(0.0085, rel=ROUNDING)
