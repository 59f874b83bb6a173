"""`bench loop`: wake-up lateness of the servo and cost of a tick, compared with an equal loop in C.

Three loops run in turn, so that disturbances of the machine affect all of them: the C loop, the servo, and the servo
with another thread of the process spinning in pure Python. A scene that has a shipped rig simulated-SCENE uses the
hands of that rig; any other scene uses a recording.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.load import load_rig, load_scene
from softfinger.config.schema import Rig, Scene
from softfinger.config.schema.pairing import pair_devices
from softfinger.drivers.base import Device
from softfinger.drivers.registry import open_device
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.arguments import find_default_rig
from softfinger.server.loop import realtime
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.progress import show_progress
from softfinger.tools.bench.geoms import make_scene
from softfinger.tools.measure import (
    QUANTILES_HEAD,
    Array,
    compile_c,
    compute_quantiles,
    draw_exceedance,
    format_quantiles,
    format_realtime,
    show_and_draw,
)

TURN_S: Final = 5.0
SOURCE: Final = Path(__file__).with_name("reference_loop.c")
MEASURED: Final = [AT.servo_late, AT.servo_exec, AT.servo_busy, AT.servo_missed]


def run(args: argparse.Namespace) -> int:
    name = "replay" if args.geoms is not None else find_default_rig(args.scene, "replay")
    rig = load_rig(name, {"servo.rate_hz": args.rate, "servo.realtime": args.realtime})
    with tempfile.TemporaryDirectory() as folder:
        scene = args.scene if args.geoms is None else make_scene(args.geoms, args.rate, Path(folder))
        runs, settings = measure(rig, load_scene(scene), args.seconds, busy=True)
    result = {"scene": args.scene if args.geoms is None else f"{args.geoms} geoms"} | evaluate(
        {name: np.concatenate(parts) for name, parts in runs.items()}, args.rate
    )
    result["realtime"] = {setting.name: setting.ok for setting in settings}
    return show_and_draw(args, result, format_table(result), lambda path: draw(path, runs, args.rate))


def measure(
    rig: Rig, scene: Scene, seconds: float, busy: bool
) -> tuple[dict[str, list[Array]], list[realtime.Setting]]:
    """Run the loops in turn: C (if there is a compiler), servo and, if `busy`, servo with spinning Python.

    rig      rig of the devices, opened for each turn of the servo; a single device is shared by all fingers
    seconds  duration of each loop
    returns  the results of `run_reference` and `run_servo`, a list of turns each, and the real-time settings
    """
    turns = max(1, round(seconds / TURN_S))
    ticks = max(1, round(seconds / turns * rig.servo.rate_hz))
    settings: list[realtime.Setting] = []
    with tempfile.TemporaryDirectory() as folder:
        loops: dict[str, Callable[[], Array]] = {"servo": lambda: run_servo(rig, scene, ticks, settings)}
        if busy:
            loops["servo_busy"] = lambda: run_busy(rig, scene, ticks, settings)
        program = compile_c(SOURCE, Path(folder), "-pthread")
        if program is not None:
            loops = {"c": lambda: run_reference(program, rig, ticks), **loops}
        runs: dict[str, list[Array]] = {name: [] for name in loops}
        with show_progress("measuring the servo loop", turns * len(loops)) as advance:
            run_servo(rig, scene, 10, settings)  # compiles, and touches memory that the first turn would touch first
            for turn in range(turns):
                for number, (name, loop) in enumerate(loops.items()):
                    runs[name].append(loop())
                    advance(turn * len(loops) + number + 1)
    return runs, settings


def run_servo(rig: Rig, scene: Scene, ticks: int, settings: list[realtime.Setting]) -> Array:
    """Run one turn of the real servo with its records taken by a thread; returns (n, 4): late, exec, busy s, missed."""

    def prepare() -> Callable[[], None]:
        applied = realtime.apply(rig.servo.realtime, rig.servo.priority, rig.servo.cpu)
        settings[:] = applied.settings
        return applied.undo

    with open_devices(rig, scene) as devices:
        servo = ServoThread(devices, make_tuning(scene, rig.guard), rig.servo.rate_hz, ticks, prepare)
        servo.compile()
        servo.start()
        batch, parts = np.empty((256, servo.width)), []
        running = True
        while running:
            servo.records.wait()
            running = servo.is_running
            while (count := servo.records.take(batch)) > 0:
                parts.append(batch[:count, MEASURED].copy())
        ended = servo.join()
        servo.close()
    if ended is not None and ended.error is not None:
        raise ended.error
    rows = np.concatenate(parts)
    rows[:, 2] = np.roll(rows[:, 2], -1)  # a record has the busy time of the previous tick
    return rows[:-1]


@contextmanager
def open_devices(rig: Rig, scene: Scene) -> Iterator[list[Device]]:
    """Yield an open device for each finger.

    If a rig has one device for several fingers, they share it: each reads the pose after the pose of another one.
    """
    with ExitStack() as opened:
        if rig.device is not None:
            yield [opened.enter_context(open_device(rig.device, rig.servo.rate_hz))] * len(scene.fingers)
        else:
            yield [
                opened.enter_context(open_device(device.device, rig.servo.rate_hz, device.table))
                for device in pair_devices(scene, rig)
            ]


@contextmanager
def spin_python() -> Iterator[None]:
    """Run another thread of this process that occupies the interpreter."""
    stop = threading.Event()

    def spin() -> None:
        total = 0
        while not stop.is_set():
            for number in range(10_000):
                total += number * number

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def run_busy(rig: Rig, scene: Scene, ticks: int, settings: list[realtime.Setting]) -> Array:
    with spin_python():
        return run_servo(rig, scene, ticks, settings)


def run_reference(program: Path, rig: Rig, ticks: int) -> Array:
    """Run one turn of the C loop; returns (n, 3): late, exec, busy s."""
    priority = 0 if rig.servo.realtime == "off" else rig.servo.priority
    out = program.with_suffix(".out")
    words = [str(program), repr(rig.servo.rate_hz), str(ticks), str(priority), str(RECORD_SIZE), str(out)]
    subprocess.run(words, check=True)
    return np.fromfile(out).reshape(-1, 3)


def evaluate(figures: dict[str, Array], rate_hz: float) -> dict[str, Any]:
    """Return percentiles of each loop, seconds, and their ratios."""
    block = round(rate_hz)
    result: dict[str, Any] = {"rate_hz": rate_hz}
    for name, values in figures.items():
        late, execution = compute_quantiles(values[:, 0], block), compute_quantiles(values[:, 1], block)
        busy = compute_quantiles(values[:, 2], block)
        result[name] = {"ticks": len(values), "late": late, "exec": execution, "busy": busy}
        result[name]["missed"] = (
            count_missed_by_c(values, 1.0 / rate_hz) if name == "c" else count_missed_by_servo(values)
        )

    def ratio(above: str, below: str) -> dict[str, float]:
        top, bottom = result[above]["late"]["blocks"], result[below]["late"]["blocks"]
        return {name: top[name] / bottom[name] for name in top}

    if "c" in figures:
        result["late_servo_over_c"] = ratio("servo", "c")
    if "servo_busy" in figures:
        result["late_busy_over_quiet"] = ratio("servo_busy", "servo")
    return result


def count_missed_by_servo(values: Array) -> int:
    """Return the deadlines missed in turns of the servo, which counts them; values (n, 4) of `run_servo`."""
    return int(np.maximum(np.diff(values[:, 3], prepend=values[0, 3]), 0).sum())


def count_missed_by_c(values: Array, period_s: float) -> int:
    """Return the deadlines that passed before the C loop slept again, which it skips as the servo does.

    values  (n, 3) of `run_reference`
    """
    over = values[:, 0] + values[:, 2] - period_s
    return int(np.where(over > 0.0, np.floor(over / period_s) + 1.0, 0.0).sum())


def format_table(result: dict[str, Any]) -> list[str]:
    lines = [
        f"servo loop at {result['rate_hz']:g} Hz, {result['scene']}, us; in brackets the median over blocks of 1 s",
        "  late: wake-up after the deadline; exec: until the device write returned; busy: until it slept again",
    ]
    lines.append(f"  {'':<17}{QUANTILES_HEAD}")
    for loop in ("c", "servo", "servo_busy"):
        for quantity in ("late", "exec", "busy"):
            cost = result.get(loop, {}).get(quantity)
            if cost is not None:
                lines.append(f"  {loop:<11}{quantity:<6}{format_quantiles(cost)}")
    lines += [
        f"  {loop}: {result[loop]['missed']} deadlines missed in {result[loop]['ticks']} ticks"
        for loop in ("c", "servo", "servo_busy")
        if loop in result
    ]
    for key, text in (("late_servo_over_c", "servo over C"), ("late_busy_over_quiet", "busy Python over quiet")):
        if key in result:
            lines.append(f"  lateness, {text}: p50 {result[key]['p50']:.2f}, p99 {result[key]['p99']:.2f} (blocks)")
    if "c" not in result:
        lines.append("  no C compiler here, so no reference: install gcc for one")
    lines.append(format_realtime(result["realtime"]))
    return lines


def draw(path: Path, runs: dict[str, list[Array]], rate_hz: float) -> None:
    late, title = {name: np.concatenate(parts)[:, 0] for name, parts in runs.items()}, f"servo loop at {rate_hz:g} Hz"
    draw_exceedance(path, late, 0.1, "wake-up lateness", "ticks later than this", title)
