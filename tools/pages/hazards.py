"""Fault model: every hazard that is handled, its reaction, and the test that injects it.

`docs/reference/faults.md` is generated from it. Each number is computed from the constant of the program that sets it.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil, floor, log
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from softfinger.config.errors import DeviceError, HapticError, SafetyStop
from softfinger.config.schema.guard import Guard
from softfinger.drivers import base
from softfinger.drivers.falcon.options import Options as FalconOptions
from softfinger.drivers.haply.options import Options as HaplyOptions
from softfinger.drivers.hid.options import Options as HidOptions
from softfinger.drivers.openhaptics.exchange import TIMEOUT_NS
from softfinger.drivers.serial.options import Options as SerialOptions
from softfinger.server.loop import fault_detection, hand_limits
from softfinger.server.loop.force_switch import MAX_OFF_S, UNREACHABLE_MAX_S
from softfinger.server.services import monitoring
from softfinger.server.viewer.door import process
from softfinger.server.wire import process_link

RESULTS_FILE: Final = Path(__file__).with_name("faults_seen.json")
"""Results of the tests below, written by `make faults-seen`."""
TICK_S: Final = 0.001
"""Period at 1 kHz, the rate of the table."""


def find_default(options: type[Any], key: str) -> float:
    """Return the default (SI) of a numeric key of a table."""
    return float(next(field.default for field in msgspec.structs.fields(options) if field.name == key))


SILENCE_S: Final = {
    "falcon": find_default(FalconOptions, "kick_s"),
    "haply": find_default(HaplyOptions, "quiet_s"),
    "hid": find_default(HidOptions, "kick_s"),
    "openhaptics": TIMEOUT_NS * 1e-9,
    "serial": find_default(SerialOptions, "quiet_s"),
}
"""Silence after which each driver removes the force.

A call of Force Dimension's library that does not return is a loop that stalls.
"""
ABANDON_S: Final = {
    "falcon": find_default(FalconOptions, "timeout_s"),
    "haply": find_default(HaplyOptions, "timeout_s"),
    "hid": find_default(HidOptions, "timeout_s"),
    "openhaptics": TIMEOUT_NS * 1e-9,
    "serial": find_default(SerialOptions, "timeout_s"),
}
"""Silence after which each driver abandons the device."""


def list_by_driver(seconds: Mapping[str, float]) -> str:
    spans = sorted({*seconds.values()})
    return "; ".join(
        f"{span:g} s of {', '.join(name for name, duration in seconds.items() if duration == span)}" for span in spans
    )


def compute_starvation_time_s(gap_s: float, period_s: float = TICK_S) -> float:
    """Return the time (s) after which stalls of `gap_s`, one after the other with a tick between, end the run.

    Notes
    -----
    `detect_fault` adds `gap_s - LOST_SHARE * (gap_s + period_s)` for each.
    """
    lost = gap_s - fault_detection.LOST_SHARE * (gap_s + period_s)
    return (floor(fault_detection.LOST_MAX_S / lost) + 1) * (gap_s + period_s)


def compute_stall_range_s() -> tuple[float, float]:
    """Return the shortest and the longest time (s) until consecutive stalls end the run, over all their lengths."""
    times = [
        compute_starvation_time_s(float(gap))
        for gap in np.linspace(fault_detection.GAP_MIN_S, fault_detection.GAP_MAX_S, 1000)
    ]
    return min(times), max(times)


def count_ticks_to_exceed(limit: float, speed: float, period_s: float = TICK_S) -> int:
    """Return the ticks until a handle that starts with `speed` (m/s) exceeds `limit` (m/s); see `smooth_velocity`."""
    return (
        floor(
            log(1.0 - limit / speed)
            / log(hand_limits.SPEED_TIME_CONSTANT_S / (hand_limits.SPEED_TIME_CONSTANT_S + period_s))
        )
        + 1
    )


class Hazard(NamedTuple):
    """Row of the fault model.

    name      of the hazard
    detection part of the program that detects it
    reaction  ticks, or s, from the first tick with it until `state` holds
    state     force at the hand after the reaction, and state of the run
    recovery  condition for a new force
    events    kind and name of each event that reports it
    tests     node ids of the tests that inject it
    within    largest reaction, ticks at 1 kHz, that the tests allow with their rig; None if no force is removed
    """

    name: str
    detection: str
    reaction: str
    state: str
    recovery: str
    events: tuple[str, ...]
    tests: tuple[str, ...]
    within: int | None = None


FAILED: Final = "state faulted"
"""Event of an error that ends a run; its cause is the error."""
_LOST: Final = f"zero; the run ends, exit code {DeviceError.exit_code}"
_STOPPED: Final = f"zero; the run ends, exit code {SafetyStop.exit_code}"
_START: Final = "start again"
_NONE: Final = "none needed"
_RAMP: Final = f"the ramp; {fault_detection.NO_FORCE_MAX_S:g} s of it end the run"
_JUMPS: Final = floor(fault_detection.NO_FORCE_MAX_S / (fault_detection.TIME_PER_JUMP_S + TICK_S)) + 1
_FROZEN: Final = 120
"""`frozen_s = 0.1` of the tests' rig, and a fifth more."""
_HELD: Final = round(base.IGNORED_WRENCH_MAX_S / TICK_S) + 2
"""Including the tick in which it ends."""
_STALLED: Final = round(fault_detection.STALL_MAX_S / TICK_S)
_QUIET: Final = round(max(SILENCE_S.values()) / TICK_S)
_STARVED: Final = compute_stall_range_s()
_FAST: Final = find_default(Guard, "handle_speed_max_m_per_s")
_FASTER: Final = 1.5 * _FAST
_CAUGHT: Final = f"{count_ticks_to_exceed(_FAST, _FASTER)} ticks at {_FASTER:g} m/s"
_FROZEN_TIME: Final = f"{find_default(Guard, 'frozen_s'):g} s by default"
_GAPS: Final = (
    f"{fault_detection.LOST_MAX_S:g} s lost above {fault_detection.LOST_SHARE:.0%} of the time, in gaps of "
    f"{fault_detection.GAP_MIN_S:g} s or more"
)
_RETRIES: Final = f"every {process_link.PAUSE_MAX_S:g} s or sooner while memory or file descriptors are missing"
_INJECTED: Final = "tests/server/test_injected_faults.py::test_an_injected_fault_leaves_no_unpermitted_force"
_EVERYWHERE: Final = "tests/server/test_injected_faults.py::test_on_every_driver"
_PROCESS: Final = "tests/server/test_process_faults.py"
_AT_ONCE: Final = "tests/server/test_commands_at_once.py"
_ENDS: Final = "test_the_force_ends_with_the_process_of_commands_and_returns_after_arm"
_NO_FILES: Final = "tests/server/test_process_faults.py::test_a_process_that_ends_without_free_descriptors_is_restarted"

HAZARDS: Final = (
    Hazard(
        "a wall that is unstable", "energy given in contacts, `energy_max_j`", "at once",
        "the force is reduced, finally to zero",
        f"automatic, over {hand_limits.ENERGY_TIME_CONSTANT_S:g} s", ("guard energy_spent",),
        ("tests/server/test_energy_limit.py::test_an_unstable_wall_fades",),
    ),
    Hazard(
        "a force that is not finite", "the guard", "0 ticks", "zero", _RAMP,
        ("guard not_finite", FAILED),
        ("tests/server/test_guard.py::test_a_force_that_is_not_finite_becomes_zero_and_ramps_up_again",
         "tests/server/test_guard.py::test_half_a_second_without_a_force_is_a_fault"),
    ),
    Hazard(
        "a pose that is not finite, out of range or short", "before the contact step", "0 ticks", "zero",
        _RAMP, ("guard pose_refused", FAILED), (_INJECTED, _EVERYWHERE), within=0,
    ),
    Hazard(
        "a pose that jumps", "`speed_max_m_per_s`, `turn_max_rad_per_s`", "0 ticks", "zero",
        f"the ramp; {_JUMPS} in a row end the run", ("guard pose_jumped", FAILED), (_INJECTED, _EVERYWHERE), within=0,
    ),
    Hazard(
        "a pose that does not change under a force", "`frozen_s`", _FROZEN_TIME, "zero", "once it moves, the ramp",
        ("guard pose_frozen",), (_INJECTED, _EVERYWHERE), within=_FROZEN,
    ),
    Hazard(
        "a handle that runs away", "`handle_speed_max_m_per_s`", _CAUGHT,
        "zero", f"slow for {hand_limits.SLOW_TIME_S:g} s, or `arm`, as set by `arm` in the rig",
        ("guard too_fast", FAILED),
        ("tests/server/test_limits.py::test_the_filter_removes_the_force_of_a_handle_that_is_too_fast",
         "tests/server/test_arming.py::test_the_force_of_a_handle_that_was_too_fast_returns_automatically",
         "tests/server/test_arming.py::test_a_handle_that_was_too_fast_waits_for_arming"),
    ),
    Hazard(
        "motors that heat", "thermal model, `continuous_force_n`", "before they are hot",
        "the force falls to `continuous_force_n`", "automatic, as they cool", ("guard motor_hot",),
        ("tests/server/test_limits.py::test_the_force_of_a_hot_motor_falls_to_the_continuous_force",),
    ),
    Hazard(
        "a device that warns", f"the driver, every {monitoring.DEVICE_PERIOD_S:g} s",
        f"{monitoring.DEVICE_PERIOD_S:g} s", "as before", "as described by its message",
        ("fault device_warning",), ("tests/server/test_service_faults.py::test_each_warning_is_reported_once",),
    ),
    Hazard(
        "the end of the workspace", "`[guard.workspace]`", "0 ticks", "a soft wall pushes back", "automatic",
        ("guard workspace_edge",),
        ("tests/server/test_limits.py::test_the_soft_wall_pushes_back_by_the_depth_behind_it",),
    ),
    Hazard(
        "a device that is lost or breaks its protocol", "status of the driver", "0 ticks, 1 of a write", _LOST, _START,
        (FAILED,),
        (_INJECTED, _EVERYWHERE, "tests/server/test_daemon.py::test_device_failure_is_named_and_force_is_zero"),
        within=1,
    ),
    Hazard(
        "a device that is silent, or sends invalid data",
        "the driver: `quiet_s`, `kick_s` of falcon and hid, then `timeout_s`", list_by_driver(SILENCE_S),
        f"{_LOST}, after {list_by_driver(ABANDON_S)}; until then the previous force",
        "the ramp; start again after the end", ("guard ramping", FAILED),
        ("tests/server/test_injected_faults.py::test_a_silent_device_gets_zero_and_then_counts_as_lost",
         "tests/drivers/test_openhaptics_exchange.py::test_a_silent_library_counts_as_lost"),
        within=_QUIET,
    ),
    Hazard(
        "a device that accepts no force", "status of the driver", f"{base.IGNORED_WRENCH_MAX_S:g} s",
        f"{_LOST}; until then the previous force", _START, (FAILED,),
        (_INJECTED, _EVERYWHERE,
         "tests/drivers/test_serial_queue.py::test_a_board_that_stops_reading_counts_as_lost_in_time",
         "tests/drivers/test_falcon_stub.py::test_a_force_that_hangs_is_withdrawn_and_a_zero_follows",
         "tests/drivers/test_hid_device.py::test_a_write_that_hangs_ends_the_run_within_any_timeout_s"), within=_HELD,
    ),
    Hazard(
        "a maker's service that breaks its protocol, closes, or reads nothing (Haply)", "the connection",
        "before the connection ends",
        f"{_LOST}. Nothing follows a TCP reset: the session's force ends with the session",
        _START, (FAILED,),
        ("tests/drivers/test_haply_ends.py::test_the_last_force_before_an_end_is_zero",
         "tests/drivers/test_haply_ends.py::test_a_reset_lets_no_zero_through",
         "tests/drivers/test_haply_ends.py::test_a_service_that_stops_reading_gets_one_more_force"),
    ),
    Hazard(
        "a maker's library that calls too rarely (Touch)", "the time between its frames, `force_age_max_s`",
        "the next frame", "zero, for as long as it lasts", "the ramp", ("fault device_warning",),
        ("tests/drivers/test_openhaptics.py::test_late_frames_cause_a_warning",),
    ),
    Hazard(
        "a device that removes its force", "status of the driver", "0 ticks", _STOPPED, _START,
        (FAILED,), (_INJECTED, _EVERYWHERE), within=0,
    ),
    Hazard(
        "a loop that stalls", "supervisor: no tick",
        f"{fault_detection.STALL_POLLS * fault_detection.STALL_POLL_S:.2f} to {fault_detection.STALL_MAX_S:.2f} s",
        f"{_STOPPED}; until then the last force", _START, ("fault stalled", FAILED),
        (_INJECTED, _EVERYWHERE,
         "tests/server/test_supervisor.py::test_a_stall_is_reported_and_every_device_stopped_if_anything_fails"),
        within=_STALLED,
    ),
    Hazard(
        "ticks that are missed", "the loop's clock", "the next tick", "the force changes as in one tick", _NONE,
        ("servo missed",),
        (_INJECTED, _EVERYWHERE, "tests/server/test_servo.py::test_the_force_does_not_jump_after_a_stall"),
    ),
    Hazard(
        "a machine that starves the loop",
        _GAPS,
        f"{floor(10 * _STARVED[0]) / 10} to {ceil(10 * _STARVED[1]) / 10} s of nothing but gaps, later with fewer",
        f"{_STOPPED}; until then the previous force in each gap", _START, (FAILED,),
        ("tests/server/test_daemon.py::test_repeated_stalls_end_the_run",
         "tests/server/test_guard.py::test_gaps_of_every_length_end_the_run_within_the_fault_model"),
        within=ceil(_STARVED[1] / TICK_S),
    ),
    Hazard(
        "a machine that slept, a process that was stopped", "the time since the last tick, and that of CLOCK_BOOTTIME",
        "0 ticks",
        "the force starts at zero", "the ramp", ("guard ramping",),
        ("tests/server/test_servo.py::test_after_a_long_pause_the_force_fades_in",
         "tests/server/test_signals.py::test_no_force_while_the_process_is_stopped",
         f"{_PROCESS}::test_processes_that_sleep_wake_with_zero_force",
         f"{_PROCESS}::test_a_machine_that_was_suspended_wakes_with_zero_force"),
        within=1,
    ),
    Hazard(
        "a commanding program that has ended", "`heartbeat_s`", f"`heartbeat_s` and {1e3 * MAX_OFF_S:g} ms", "zero",
        "the next heartbeat, or `arm`", ("command heartbeat_missed", FAILED),
        ("tests/server/test_busy_commands.py::test_without_a_heartbeat_there_is_no_force_until_the_next",
         "tests/server/test_commands_at_once.py::test_the_force_ends_while_python_does_nothing"),
    ),
    Hazard(
        "a scene that cannot be rendered", "checked and compiled before the swap", "none", "as before",
        "send another scene", (),
        ("tests/server/test_replace.py::test_a_scene_that_cannot_be_built_changes_nothing",
         "tests/server/test_busy_commands.py::test_a_failed_compilation_is_reported"),
    ),
    Hazard(
        "bodies that diverge, take too long, or an error of MuJoCo", "the step of bodies", "the next tick",
        "zero, along the slew limit; the run continues", "`ctl reset_world`", ("fault bodies",),
        ("tests/server/test_world.py::test_failing_bodies_are_released_and_reset",
         "tests/server/test_world.py::test_bodies_that_exceed_the_tick_are_released"),
    ),
    Hazard(
        "an exception in the servo's thread", "the thread's end", "0 ticks",
        f"zero; the run ends, exit code {HapticError.exit_code}", "report it", (FAILED,),
        ("tests/server/test_servo.py::test_exception_in_the_servo_thread_zeroes_the_device",),
    ),
    Hazard(
        "a supervisor that fails", "the thread's end", "at once", _STOPPED, _START, (FAILED,),
        ("tests/server/test_supervisor.py::test_a_supervisor_that_fails_ends_the_run",),
    ),
    Hazard(
        "a daemon that is killed", "the device's own watchdog, or the watcher of `run`", "as the device or the watcher",
        "zero with either; else the last force", _START, (),
        ("tests/server/test_signals.py::test_watcher_takes_the_force_off_a_killed_daemon",),
    ),
    Hazard(
        "a process of commands that ends", "the daemon; the loop", "at once", "zero",
        f"it is started again, {_RETRIES}; then `arm`", ("fault publisher",), (f"{_AT_ONCE}::{_ENDS}",),
    ),
    Hazard(
        "a process of telemetry that ends, also while no memory or file descriptor is left", "the daemon", "none",
        "as before", f"it is started again, {_RETRIES}", ("fault publisher",),
        ("tests/server/test_publisher.py::test_a_killed_publisher_is_restarted",
         "tests/server/test_process_faults.py::test_a_publisher_without_memory_is_restarted", _NO_FILES),
    ),
    Hazard(
        "a page that ends, also while no memory or file descriptor is left", "the daemon", "none", "as before",
        f"it is restarted at the same address, {process.RESTARTS} times in a run", ("fault page",),
        ("tests/server/viewer/test_page_process.py::test_a_page_that_ends_is_restarted_at_the_same_address",
         "tests/server/test_process_faults.py::test_a_page_without_memory_is_restarted", _NO_FILES),
    ),
    Hazard(
        "a removed socket file, as at the end of a login session",
        f"a check every {monitoring.SOCKET_FILE_PERIOD_S:g} s", "none", "as before", "none: it is bound again",
        ("fault publisher",), ("tests/server/test_process_faults.py::test_removed_socket_files_are_bound_again",),
    ),
    Hazard(
        "a process of commands that hangs", "the loop: it does not report that it reads requests",
        f"{1e3 * UNREACHABLE_MAX_S:g} ms and {1e3 * MAX_OFF_S:g} ms", "zero",
        f"the ramp, if it continues; after {process_link.SILENT_MAX_S:g} s it is restarted: `arm`",
        (FAILED, "fault publisher"),
        (f"{_AT_ONCE}::{_ENDS}", f"{_AT_ONCE}::test_the_force_returns_when_a_process_of_commands_continues",
         f"{_AT_ONCE}::test_a_lost_disarm_is_repeated"),
    ),
    Hazard(
        "a publisher that hangs, a lost network", "none needed: no other thread waits for it", "none",
        "as before; subscribers miss ticks; commands are answered", _NONE, (),
        ("tests/server/test_commands_at_once.py::test_subscribers_do_not_delay_disarm",
         f"{_PROCESS}::test_a_stopped_publisher_delays_nothing",
         f"{_PROCESS}::test_a_lost_network_affects_only_subscribers"),
    ),
    Hazard(
        "a disk that is full or stalls", "the recorder", "none",
        "as before; the recording ends, or counts the lost records", "another recording", ("fault recording",),
        ("tests/server/recording/test_recorder.py::test_a_full_disk_is_one_event_and_the_run_continues",
         "tests/server/recording/test_recorder.py::test_a_stalled_disk_loses_ticks_but_delays_nothing"),
    ),
    Hazard(
        "a log that nobody reads", "standard error accepts no line", "none", "as before; lines are dropped", _NONE, (),
        (f"{_PROCESS}::test_a_stopped_publisher_delays_nothing",),
    ),
    Hazard(
        "a clock that is set", "none needed: ticks, events and recordings use CLOCK_MONOTONIC", "none", "as before",
        _NONE, (),
        (f"{_PROCESS}::test_a_clock_that_is_set_puts_nothing_out_of_order",
         "tests/server/test_service_faults.py::test_a_clock_that_is_set_back_loses_no_event_and_no_second",),
    ),
    Hazard(
        "two daemons on one device or endpoint", "the device's lock; the bind", "before the start",
        "the second ends with the process that uses the device in its message", "end the first", (),
        ("tests/drivers/test_haply_ends.py::test_a_second_daemon_is_refused_and_an_unconfirmed_zero_is_reported",
         "tests/server/test_cli.py::test_an_endpoint_in_use_gives_exit_code_7"),
    ),
    Hazard(
        "memory of the daemon in swap", f"VmSwap, at the start and every {monitoring.SWAP_PERIOD_S:g} s",
        f"{monitoring.SWAP_PERIOD_S:g} s", "as before",
        "end the programs that fill the memory, or let the daemon lock its memory", ("fault swapped",),
        ("tests/server/test_service_faults.py::test_memory_in_swap_is_reported_once",),
    ),
    Hazard(
        "a reader of ticks that fails", "the relay thread", "none", "as before, without that reader",
        _START, ("fault sink",),
        ("tests/server/test_daemon.py::test_a_failing_sink_is_dropped_and_the_others_get_every_record",),
    ),
    Hazard(
        "a service that fails: hot-plugging, metrics, bodies on the wire", "the end of its thread", "none", "as before",
        _START, ("fault hotplug", "fault metrics", "fault world"),
        ("tests/server/test_service_faults.py::test_a_failed_service_is_reported_and_ends_nothing",),
    ),
    Hazard(
        "commands that cannot be received", "an error in their thread", "none",
        f"as before; with `heartbeat_s` the run ends, exit code {SafetyStop.exit_code}", _START,
        ("fault commands", FAILED),
        ("tests/server/test_service_faults.py::test_commands_that_fail_end_a_run_that_needs_heartbeats",),
    ),
)  # fmt: skip
"""Every hazard that is handled, each injected by a test."""
