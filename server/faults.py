"""The fault model: every hazard that is provided for, what is done about it, and the test that injects it.

`docs/reference/faults.md` is made from it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

SEEN_IN: Final = Path(__file__).with_name("faults_seen.json")
"""What `make faults-seen` has seen of the tests below."""

ADVICE: Final = {
    "not_finite": "the scene gave no finite force: softfinger check names values that do not go together",
    "pose_refused": "the device gave no usable pose: see to its sensors and its cable",
    "pose_jumped": "the pose jumped, farther than a hand comes: see to sensors and cable; if it was a hand, raise "
    "guard.speed_max_m_per_s",
    "pose_frozen": "the pose repeats bit for bit under a force: move the handle; if it rests, disarm",
    "too_fast": "the handle was faster than guard.handle_speed_max_m_per_s: hold it, and arm if the rig asks for that; "
    "if nobody moved it so, take a softer scene, or turn to the sign of the force",
    "motor_hot": "the force is lowered until the motors have cooled: let go for a while, or take a softer scene",
    "energy_spent": "the rendering gave the hand more than guard.energy_max_j, and its force fades: take a softer "
    "scene or [passivity]; for an object that is meant to push, raise that limit",
    "workspace_edge": "the handle is at the edge of guard.workspace: come back from it",
}
"""What to do, by the name of a guard's event; those not here need nothing."""


class Hazard(NamedTuple):
    """A row of the fault model.

    name      of the hazard
    detection what finds it
    reaction  ticks, or s, from the first tick with it until `state` holds
    state     what the hand feels then, and what becomes of the run
    recovery  what leads back to a force
    events    kind and name of each event that tells it
    tests     node ids of the tests that inject it
    within    ticks at 1 kHz that the tests hold the reaction to, with a rig of theirs; None where it removes no force
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
"""The event of an error that ends a run; its cause is the error."""
_ENDS: Final = "zero; the run ends"
_START: Final = "start again"
_NONE: Final = "none needed"
_FROZEN: Final = 120
"""`frozen_s = 0.1` of the tests' rig, and a fifth more."""
_HELD: Final = 252
"""`HELD_MAX_S`, and the tick in which it ends."""
_STALLED: Final = 350
"""`STALL_MAX_S`, which says why."""
_INJECTED: Final = "tests/server/test_injected_faults.py::test_an_injected_fault_leaves_no_force_that_it_may_not"
_EVERYWHERE: Final = "tests/server/test_injected_faults.py::test_on_every_driver"
_PROCESS: Final = "tests/server/test_process_faults.py"

HAZARDS: Final = (
    Hazard(
        "a wall that is unstable", "energy given in contacts, `energy_max_j`", "at once",
        "the force fades to zero at twice the limit", "by itself, over 1 s", ("guard energy_spent",),
        ("tests/server/test_limits.py::test_an_unstable_wall_fades",),
    ),
    Hazard(
        "a force that is not finite", "the guard", "0 ticks", "zero", "the ramp; 0.5 s of it end the run",
        ("guard not_finite", FAILED),
        ("tests/server/test_guard.py::test_what_is_not_finite_becomes_zero_and_ramps_anew",
         "tests/server/test_health.py::test_half_a_second_without_a_force_is_a_fault"),
    ),
    Hazard(
        "a pose that is not finite, out of range or short", "before the contact step", "0 ticks", "zero",
        "the ramp; 0.5 s of it end the run", ("guard pose_refused", FAILED), (_INJECTED, _EVERYWHERE), within=0,
    ),
    Hazard(
        "a pose that jumps", "`speed_max_m_per_s`, `turn_max_rad_per_s`", "0 ticks", "zero",
        "the ramp; five in a row end the run", ("guard pose_jumped", FAILED), (_INJECTED, _EVERYWHERE), within=0,
    ),
    Hazard(
        "a pose that stands still under a force", "`frozen_s`", "5 s by default", "zero", "once it moves, the ramp",
        ("guard pose_frozen",), (_INJECTED, _EVERYWHERE), within=_FROZEN,
    ),
    Hazard(
        "a handle that runs away", "`handle_speed_max_m_per_s`", "12 ticks at 3 m/s", "zero",
        "slow for 0.5 s, or `arm`, as `arm` in the rig says", ("guard too_fast", FAILED),
        ("tests/server/test_limits.py::test_a_handle_that_is_too_fast_loses_its_force_when_the_filter_says",
         "tests/server/test_arming.py::test_a_handle_that_is_too_fast_gets_its_force_back_by_itself",
         "tests/server/test_arming.py::test_a_handle_that_is_too_fast_waits_for_whoever_arms"),
    ),
    Hazard(
        "motors that heat", "thermal model, `continuous_force_n`", "before they are hot",
        "the force falls to `continuous_force_n`", "by itself as they cool", ("guard motor_hot",),
        ("tests/server/test_limits.py::test_a_hot_motor_is_given_less_and_in_the_end_what_it_bears",),
    ),
    Hazard(
        "a device that warns", "the driver, twice a second", "0.5 s", "as before", "as its message says",
        ("fault device_warning",), ("tests/server/test_device_warnings.py::test_each_warning_is_told_once",),
    ),
    Hazard(
        "the end of the workspace", "`[guard.workspace]`", "0 ticks", "a soft wall pushes back", "by itself",
        ("guard workspace_edge",),
        ("tests/server/test_limits.py::test_the_soft_wall_pushes_back_by_the_depth_behind_it",),
    ),
    Hazard(
        "a device that is lost, silent, or breaks its protocol", "status of the driver", "0 ticks, 1 of a write",
        f"{_ENDS}, exit code 4", _START, (FAILED,),
        (_INJECTED, _EVERYWHERE, "tests/server/test_daemon.py::test_device_failure_is_named_and_force_is_zero"),
        within=1,
    ),
    Hazard(
        "a device that takes no force", "status of the driver", "0.25 s", f"{_ENDS}, exit code 4; until then the force "
        "of before", _START, (FAILED,), (_INJECTED, _EVERYWHERE), within=_HELD,
    ),
    Hazard(
        "a maker's service that breaks its protocol, closes, or reads nothing (Haply)", "the connection",
        "before the connection ends",
        "zero; the run ends, exit code 4. Nothing follows a TCP reset: the session's force ends with the session",
        _START, (FAILED,),
        ("tests/drivers/test_haply_ends.py::test_a_zero_comes_before_the_end",
         "tests/drivers/test_haply_ends.py::test_a_reset_lets_no_zero_through",
         "tests/drivers/test_haply_ends.py::test_a_service_that_stops_reading_gets_one_more_force"),
    ),
    Hazard(
        "a maker's library that calls too rarely (Touch)", "the time between its frames, `force_age_max_s`",
        "the next frame", "zero, for as long as it lasts", "the ramp", ("fault device_warning",),
        ("tests/drivers/test_openhaptics.py::test_frames_that_are_too_far_apart_are_told",),
    ),
    Hazard(
        "a device that removes its force", "status of the driver", "0 ticks", f"{_ENDS}, exit code 6", _START,
        (FAILED,), (_INJECTED, _EVERYWHERE), within=0,
    ),
    Hazard(
        "a loop that stalls", "supervisor: no tick", "0.25 to 0.35 s",
        f"{_ENDS}, exit code 6; until then the last force", _START, ("fault stalled", FAILED),
        (_INJECTED, _EVERYWHERE,
         "tests/server/test_supervisor.py::test_a_stall_is_told_and_every_device_stopped_whatever_fails"),
        within=_STALLED,
    ),
    Hazard(
        "ticks that are missed", "the loop's clock", "the next tick", "the force changes as in one tick", _NONE,
        ("servo missed",), (_INJECTED, _EVERYWHERE, "tests/server/test_servo.py::test_a_stall_is_no_licence_to_jump"),
    ),
    Hazard(
        "a machine that starves the loop", "more than half of the time lost", "0.5 s",
        f"{_ENDS}, exit code 6", _START, (FAILED,), ("tests/server/test_daemon.py::test_repeated_stalls_end_the_run",),
    ),
    Hazard(
        "a machine that slept, a process that was stopped", "the time since the last tick, and that of CLOCK_BOOTTIME",
        "0 ticks",
        "the force begins at zero", "the ramp", ("guard ramping",),
        ("tests/server/test_servo.py::test_after_a_long_pause_the_force_fades_in",
         "tests/server/test_signals.py::test_no_force_while_the_process_is_stopped",
         f"{_PROCESS}::test_processes_that_sleep_wake_with_zero_force",
         f"{_PROCESS}::test_a_machine_that_was_suspended_wakes_with_zero_force"),
        within=1,
    ),
    Hazard(
        "a commanding program that is gone", "`heartbeat_s`", "`heartbeat_s` and 0.1 s", "zero, along the slew limit",
        "the next heartbeat, or `arm`", ("command heartbeat_missed", FAILED),
        ("tests/server/test_commands.py::test_without_a_heartbeat_there_is_no_force_until_the_next",),
    ),
    Hazard(
        "a scene that cannot be rendered", "checked and compiled before the swap", "none", "as before",
        "send another scene", (),
        ("tests/server/test_replace.py::test_what_cannot_be_built_changes_nothing",
         "tests/server/test_commands.py::test_a_compiler_that_fails_is_told"),
    ),
    Hazard(
        "bodies that diverge, take too long, or an error of MuJoCo", "the step of bodies", "the next tick",
        "zero, along the slew limit; the run goes on", "`ctl reset_world`", ("fault bodies",),
        ("tests/server/test_world.py::test_bodies_that_fail_are_let_go_and_put_back",
         "tests/server/test_world.py::test_bodies_that_take_too_long_are_let_go"),
    ),
    Hazard(
        "an exception in the servo's thread", "the thread's end", "0 ticks", f"{_ENDS}, exit code 1",
        "report it", (FAILED,),
        ("tests/server/test_servo.py::test_exception_in_the_servo_thread_zeroes_the_device",),
    ),
    Hazard(
        "a supervisor that fails", "the thread's end", "at once", f"{_ENDS}, exit code 6", _START, (FAILED,),
        ("tests/server/test_supervisor.py::test_a_supervisor_that_fails_ends_the_run",),
    ),
    Hazard(
        "a daemon that is killed", "the device's own watchdog, or `run --watcher`", "as the device or the watcher",
        "zero with either; else the last force", _START, (),
        ("tests/server/test_signals.py::test_watcher_takes_the_force_off_a_killed_daemon",),
    ),
    Hazard(
        "a publisher that is killed or gets no more memory", "the daemon", "none", "as before", "it is started again",
        ("fault publisher",),
        ("tests/server/test_publisher.py::test_a_publisher_that_is_killed_is_started_again",
         "tests/server/test_out_of_memory.py::test_a_publisher_without_memory_is_started_again"),
    ),
    Hazard(
        "a page that is killed or gets no more memory", "the daemon", "none", "as before",
        "it is started again at the same address, three times in a run", ("fault page",),
        ("tests/server/viewer/test_page_process.py::test_a_page_that_dies_is_started_again_at_the_same_address",
         "tests/server/test_out_of_memory.py::test_a_page_without_memory_is_started_again"),
    ),
    Hazard(
        "a publisher that stands still, a network that is lost", "none needed: nobody waits for it", "none",
        "as before; subscribers miss ticks", _NONE, (),
        (f"{_PROCESS}::test_a_publisher_that_stands_still_holds_up_nothing",
         f"{_PROCESS}::test_a_network_that_is_lost_costs_subscribers_alone"),
    ),
    Hazard(
        "a disk that is full or stalls", "the recorder", "none",
        "as before; the recording ends, or counts what it lost", "another recording", ("fault recording",),
        ("tests/server/recording/test_recorder.py::test_a_full_disk_is_one_event_and_the_run_goes_on",
         "tests/server/recording/test_recorder.py::test_a_disk_that_stalls_costs_ticks_and_no_time"),
    ),
    Hazard(
        "a clock that is set", "none needed: ticks, events and recordings go by CLOCK_MONOTONIC", "none", "as before",
        _NONE, (),
        (f"{_PROCESS}::test_a_clock_that_is_set_puts_nothing_out_of_order",
         "tests/server/test_service_faults.py::test_a_clock_that_is_set_back_loses_no_event_and_no_second",),
    ),
    Hazard(
        "two daemons on one device or endpoint", "the device's lock; the bind", "before the start",
        "the second ends, and says who holds it", "end the first", (),
        ("tests/drivers/test_serial_loop.py::test_the_command_line_on_a_port",
         "tests/drivers/test_haply_loop.py::test_a_second_daemon_and_a_zero_that_nobody_confirms",
         "tests/server/test_cli.py::test_endpoint_in_use_has_its_own_exit_code"),
    ),
    Hazard(
        "memory of the daemon in swap", "VmSwap, at the start and once a second", "1 s", "as before",
        "end what fills the memory, or let the daemon lock its own", ("fault swapped",),
        ("tests/server/test_swapping.py::test_memory_in_swap_is_told_once",),
    ),
    Hazard(
        "a reader of ticks that fails", "the thread that hands ticks on", "none", "as before, without that reader",
        _START, ("fault sink",),
        ("tests/server/test_daemon.py::test_every_sink_takes_every_record_and_one_that_fails_is_left_out",),
    ),
    Hazard(
        "a service that fails: hot-plugging, metrics, bodies on the wire", "the end of its thread", "none", "as before",
        _START, ("fault hotplug", "fault metrics", "fault world"),
        ("tests/server/test_service_faults.py::test_a_service_that_fails_is_told_and_ends_nothing",),
    ),
    Hazard(
        "commands that cannot be taken", "an error in their thread", "none",
        "as before; with `heartbeat_s` the run ends, exit code 6", _START, ("fault commands", FAILED),
        ("tests/server/test_service_faults.py::test_commands_that_fail_end_a_run_that_needs_heartbeats",),
    ),
)  # fmt: skip
"""Every hazard that is provided for, each injected by a test."""
