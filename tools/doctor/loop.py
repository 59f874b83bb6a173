"""Checks of the servo on this machine: real-time settings are applied, ticks are run, and a step is timed."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.errors import AddressInUse, HapticError
from softfinger.config.load import load_rig
from softfinger.config.schema import Rig, Scene
from softfinger.config.schema.pairing import find_single_device
from softfinger.drivers.registry import open_device
from softfinger.proxy.kernels.jit.decorators import CACHE_DIR, KERNEL_FOLDER
from softfinger.server.loop import realtime
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.cost import make_touching_poses
from softfinger.server.offline.cost import measure as step_cost
from softfinger.server.progress import report_compilation, show_progress
from softfinger.server.wire.publisher import Publisher
from softfinger.tools.bench import loop
from softfinger.tools.doctor.machine import STATES, Check, grade

MISSED_FAIR: Final = 1e-4
"""Fraction of missed ticks: one in ten seconds at 1 kHz. A missed tick extends the force by one period."""
MISSED_BAD: Final = 1e-2
"""One in a hundred is felt as roughness of a stiff wall."""
LATE_FAIR: Final = 0.1
"""p99 of the lateness over the period. Lateness of a tenth of a period makes a velocity wrong by a tenth."""
LATE_BAD: Final = 0.5
"""Above half a period there is no time for the exchange with the device."""
STEP_FAIR: Final = 0.1
"""Cost of a step over the period. Exchange, lateness and, with cold caches, as much again are added to it."""
STEP_BAD: Final = 0.5
STEP_BLOCKS: Final = 10


def replace_device(rig: Rig) -> Rig:
    """Return the rig's loop on a recording, so that no force is displayed while the machine is measured."""
    keys = ("rate_hz", "realtime", "priority", "cpu")
    values = {f"servo.{key}": getattr(rig.servo, key) for key in keys}
    return load_rig("replay", {key: value for key, value in values.items() if value is not None})


def check_settings(rig: Rig) -> list[Check]:
    """Apply each real-time setting in a separate thread, and undo it."""
    settings_made: list[realtime.Setting] = []
    thread = threading.Thread(target=lambda: settings_made.extend(_apply(rig)))
    thread.start()
    thread.join()
    checks = []
    for setting in settings_made:
        needed = rig.servo.realtime == "require" and setting.name in realtime.REQUIRED
        state = STATES[0] if setting.ok else STATES[1 + needed]
        expected = "granted" + (": the rig requires it" if needed else "")
        checks.append(Check(f"real time, {setting.name}", state, setting.detail, expected, setting.advice))
    return checks


def _apply(rig: Rig) -> list[realtime.Setting]:
    applied = realtime.apply("auto", rig.servo.priority, rig.servo.cpu)
    applied.undo()
    return applied.settings


def check_cache(rig: Rig, scene_name: str, scene: Scene) -> Check:
    bare = replace_device(rig)
    begun = time.monotonic()
    with (
        report_compilation("kernels of the scene"),
        open_device(find_single_device(bare), bare.servo.rate_hz) as device,
    ):
        servo = ServoThread([device] * len(scene.fingers), make_tuning(scene, bare.guard), bare.servo.rate_hz)
        warm = servo.compile()
        servo.close()
    seconds_taken = time.monotonic() - begun
    expected = "a folder that this user may write to, with the kernels of the scene in it"
    if (problem := KERNEL_FOLDER.problem()) is not None:
        state = f"{problem}; every start compiles, now {seconds_taken:.1f} s"
        remedy = "export SOFTFINGER_CACHE_DIR=/a/folder/of/yours"
        return Check("kernel cache", "bad", state, expected, remedy)
    if warm:
        return Check("kernel cache", "good", f"{CACHE_DIR} contains the kernels of {scene_name}", expected)
    state = f"{CACHE_DIR} was empty for {scene_name}: compiled now, in {seconds_taken:.1f} s"
    remedy = f"softfinger warmup {scene_name}   # after an update"
    return Check("kernel cache", "could be better", state, expected, remedy)


def measure_lateness(
    rig: Rig, scene: Scene, seconds: float, plot: Path | None = None
) -> tuple[list[Check], dict[str, Any]]:
    """Measure missed ticks and wake-up lateness of the servo on a recording, and the C loop for comparison.

    Returns the checks and the figures, and draws the lateness to `plot`.
    """
    runs, _ = loop.measure(replace_device(rig), scene, seconds, busy=False)
    result = loop.evaluate({name: np.concatenate(parts) for name, parts in runs.items()}, rig.servo.rate_hz)
    if plot is not None:
        loop.draw(plot, runs, rig.servo.rate_hz)
    return judge_loop(result), result


def judge_loop(result: dict[str, Any]) -> list[Check]:
    """Return the checks for the figures of `tools.bench.loop.evaluate`."""
    period, servo = 1.0 / result["rate_hz"], result["servo"]
    share, late = servo["missed"] / servo["ticks"], servo["late"]["p99"]
    reference = "no C compiler here to compare with (install gcc)"
    if "c" in result:
        reference_s = result["c"]["late"]["p99"]
        reference = f"the same loop in C {reference_s * 1e6:.0f} us, {reference_s / period:.1%}"
    quiet = "stop other programs, reserve a processor for servo.cpu with isolcpus= on the kernel's command line"
    return [
        Check(
            "ticks in time",
            grade(share, MISSED_FAIR, MISSED_BAD),
            f"{servo['missed']} of {servo['ticks']} missed ({share:.3%}) at {result['rate_hz']:g} Hz",
            f"at most {MISSED_FAIR:.2%}; above {MISSED_BAD:.0%} it is perceptible",
            f"correct the faults listed above; {quiet}; or reduce servo.rate_hz",
        ),
        Check(
            "wake-up lateness",
            grade(late / period, LATE_FAIR, LATE_BAD),
            f"p99 {late * 1e6:.0f} us, {late / period:.1%} of the period; {reference}",
            f"at most {LATE_FAIR:.0%} of the period; above {LATE_BAD:.0%} a tick does not fit",
            f"correct the faults listed above; {quiet}",
        ),
    ]


def check_step(rig: Rig, scene_name: str, scene: Scene) -> Check:
    """Measure the cost of a contact step, in contact, relative to the period."""
    with show_progress("measuring the contact step", STEP_BLOCKS) as advance:
        cost = step_cost(scene, make_touching_poses(scene), STEP_BLOCKS, advance)
    share = cost.median_ns * 1e-9 * rig.servo.rate_hz
    return Check(
        "contact step",
        grade(share, STEP_FAIR, STEP_BAD),
        f"{cost.median_ns:.0f} ns on {scene_name}, {share:.3%} of the period",
        f"at most {STEP_FAIR:.0%} of the period",
        f"softfinger check {scene_name} --explain shows the cost of each part; or reduce servo.rate_hz",
    )


def check_endpoint(rig: Rig) -> Check:
    """Check whether the rig's telemetry endpoint can be bound; it is released at once."""
    endpoint, expected = rig.telemetry.endpoint, "free to be bound"
    try:
        Publisher(endpoint).close()
    except HapticError as error:
        holder = "end the program that uses it" if isinstance(error, AddressInUse) else "choose another"
        return Check("telemetry endpoint", "bad", str(error), expected, f"{holder}, or run with --endpoint ANOTHER")
    return Check("telemetry endpoint", "good", f"{endpoint} is free", expected)
