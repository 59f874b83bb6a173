"""`bench commands`: effect of commands on a pressing hand: torn sets, missed ticks, force steps, memory.

A daemon in a separate process replays a hand that is held 1 mm deep in a plane that only pushes back, with a constant
force in addition: F_z = k d + f. Stiffness and constant force are set together so that their sum is constant. Any other
force shows a torn set. Then two scenes alternate; each one fades in from zero force.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.server.loop.guard import PAUSE_MAX_S
from softfinger.server.progress import show_progress
from softfinger.server.wire.client import Subscription, subscribe
from softfinger.server.wire.control import Control
from softfinger.tools.bench.telemetry import run_source
from softfinger.tools.measure import Array, draw_lines, show_and_draw

DEPTH_M: Final = 0.001
FORCE_N: Final = 2.0
PAIRS: Final = [(1000.0, 1.0), (500.0, 1.5), (250.0, 1.75), (1500.0, 0.5)]
"""Stiffness, N/m, and constant force, N; at that depth their sum is FORCE_N."""
ROUNDING: Final = 1e-9
"""Relative rounding error of the few operations that compute a force."""
SLEW_N_PER_S: Final = 200.0
"""Slew limit of the guard, so low that a step of the complete force in one tick would exceed it."""
TURN_S: Final = 120.0
"""Longest time for a scene to be compiled and felt."""
SCENE: Final = f"""
[fingertip]
radius_m = 0.01
[probe]
velocity_time_constant_s = 0.0
[[object]]
name = "lid"
shape = "plane"
[object.material]
stiffness_n_per_m = {PAIRS[0][0]}
damping_ns_per_m = 0.0
[[effect]]
kind = "constant_force"
force_n = [0.0, 0.0, {PAIRS[0][1]}]
"""
SECOND_SCENE: Final = "paper-plane"
RIG: Final = f"""
[device]
driver = "replay"
recording = "{{recording}}"
[servo]
realtime = "auto"
[guard]
force_max_n = 5.0
torque_max_nm = 0.1
force_slew_n_per_s = {SLEW_N_PER_S}
torque_slew_nm_per_s = 50.0
ramp_s = 0.05
[commands]
ramp_s = 0.0
"""
POSES_CSV: Final = "t,x,y,z,qw,qx,qy,qz\n" + "".join(f"{t},0,0,{0.01 - DEPTH_M!r},1,0,0,0\n" for t in (0, 1))


class Listener:
    """Receiver of every tick of a daemon.

    It stores six numbers per tick: tick, dt, force along z, changes by the guard, missed deadlines, and the spring part
    of the force.
    """

    def __init__(self, subscription: Subscription) -> None:
        self._subscription, self.lost = subscription, 0
        self._rows: list[tuple[float, ...]] = []

    def take(self, until_s: float = 0.0) -> None:
        """Receive the available samples, and wait for more until `until_s` of the monotonic clock."""
        while (sample := self._subscription.receive(max(0.0, until_s - time.monotonic()))) is not None:
            data = sample.data
            self.lost += sample.lost
            self._rows.append(
                (data.tick, data.dt, data.force[2], data.servo.guard, data.servo.missed, data.contact.normal_force)
            )

    def rows(self) -> Array:
        """Return the samples since the last call, (n, 6)."""
        self.take()
        rows, self._rows = np.array(self._rows).reshape(-1, 6), []
        return rows

    def is_force_applied(self) -> bool:
        """Return whether the device gets the force of the scene, unchanged by the guard."""
        self.take(time.monotonic() + 0.02)
        return bool(self._rows) and self._rows[-1][3] == 0.0 and self._rows[-1][2] > 0.0

    def wait_until_applied(self) -> None:
        until = time.monotonic() + TURN_S
        while not self.is_force_applied():
            if time.monotonic() > until:
                raise ConfigError(f"no unchanged force was seen within {TURN_S:g} s: the machine may be overloaded")


def run(args: argparse.Namespace) -> int:
    with (
        tempfile.TemporaryDirectory() as folder,
        run_daemon(Path(folder)) as (process, endpoint, commands),
        subscribe(endpoint) as subscription,
        Control(commands, TURN_S) as control,
    ):
        listener = Listener(subscription)
        listener.wait_until_applied()
        listener.rows()
        quiet, _ = call_at_rate(listener, lambda: None, args.rate, args.seconds, "without commands")
        rows, answers = call_at_rate(listener, make_setter(control), args.rate, args.seconds, "set_params")
        swap_rows, memory = alternate_scenes(listener, control, process.pid, args.swaps)
    # Only increases: before a swap the switch reduces the force to zero faster than the slew limit allows.
    steps = np.diff(np.abs(swap_rows[:, 2]))[(np.diff(swap_rows[:, 0]) == 1.0) & (swap_rows[1:, 1] <= PAUSE_MAX_S)]
    result = {
        "ticks_without": len(quiet), "missed_without": count_missed(quiet),
        "set_params": len(answers), "ticks": len(rows), "missed": count_missed(rows), "torn": count_torn(rows),
        "changes_felt": int(np.count_nonzero(np.diff(rows[:, 5]))),
        "answer_p50_s": float(np.median(answers)),
        "answer_p99_s": float(np.percentile(answers, 99)),
        "swaps": args.swaps, "largest_step_n": float(steps.max()), "slew_n": SLEW_N_PER_S / 1000.0,
        "lost": listener.lost, "resident_mb": memory,
    }  # fmt: skip
    lines = {"daemon": (range(len(memory)), memory)}
    draw = partial(draw_lines, lines=lines, x="scenes set", y="resident, MB")
    return show_and_draw(args, result, format_table(result), draw)


def format_table(result: dict[str, Any]) -> list[str]:
    memory = result["resident_mb"]
    indices = sorted({0, len(memory) // 10, len(memory) // 2, len(memory) - 1})
    spots = ", ".join(f"{memory[i]:.1f} (scene {i + 1})" for i in indices)
    return [
        f"without commands: {result['missed_without']} of {result['ticks_without']} ticks missed",
        f"{result['set_params']} x set_params in contact: {result['torn']} torn, {result['changes_felt']} "
        f"changed the force, {result['missed']} of {result['ticks']} ticks missed; "
        f"answer p50 {1e3 * result['answer_p50_s']:.2f} ms, p99 {1e3 * result['answer_p99_s']:.2f} ms",
        f"{result['swaps']} x set_scene in contact: largest rise {result['largest_step_n']:.4f} N in a tick, "
        f"slew limit {result['slew_n']:.4f} N; resident memory, MB: {spots}",
        f"lost by the subscriber: {result['lost']}",
    ]


@contextmanager
def run_daemon(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], str, str]]:
    """Run a daemon until the block ends; yields its process and its two endpoints."""
    endpoint, commands = f"ipc://{folder}/telemetry", f"ipc://{folder}/commands"
    poses, scene, rig = folder / "held.csv", folder / "pressed.toml", folder / "rig.toml"
    poses.write_text(POSES_CSV, "utf-8")
    scene.write_text(SCENE, "utf-8")
    rig.write_text(RIG.format(recording=poses), "utf-8")
    words = ["run", "--rig", str(rig), "--scene", str(scene), "--endpoint", endpoint, "--commands", commands]
    with run_source([sys.executable, "-m", "softfinger.server.cli", *words], endpoint) as process:
        yield process, endpoint, commands


def make_setter(control: Control) -> Callable[[], None]:
    pairs = cycle(PAIRS[1:] + PAIRS[:1])

    def ask() -> None:
        stiffness, push = next(pairs)
        control.set_params({"object.lid.material.stiffness_n_per_m": stiffness, "effect.0.force_n": [0.0, 0.0, push]})

    return ask


def call_at_rate(
    listener: Listener, ask: Callable[[], None], rate_hz: float, seconds: float, operation: str
) -> tuple[Array, Array]:
    """Call `ask` at a rate; return the ticks in that time, (n, 6), and the duration of each call, s."""
    count = max(1, round(rate_hz * seconds))
    durations = np.zeros(count)
    with show_progress(operation, count) as advance:
        start_s = time.monotonic()
        for number in range(count):
            listener.take(start_s + number / rate_hz)
            start = time.monotonic()
            ask()
            durations[number] = time.monotonic() - start
            advance(number + 1)
    return listener.rows(), durations


def alternate_scenes(listener: Listener, control: Control, pid: int, count: int) -> tuple[Array, list[float]]:
    """Alternate set_scene; return the ticks in that time, (n, 6), and the resident memory after each call, MB."""
    pressed = control.describe()["scene"]
    memory = []
    with show_progress("set_scene", count) as advance:
        for number in range(count):
            control.set_scene(pressed if number % 2 else SECOND_SCENE)
            listener.wait_until_applied()
            memory.append(measure_resident_mb(pid))
            advance(number + 1)
    return listener.rows(), memory


def count_missed(rows: Array) -> int:
    return int(rows[-1, 4] - rows[0, 4])


def count_torn(rows: Array) -> int:
    """Return the number of ticks with a force of no pair, unchanged by the guard."""
    left_alone = rows[rows[:, 3] == 0.0]
    return int(np.count_nonzero(np.abs(left_alone[:, 2] - FORCE_N) > ROUNDING * FORCE_N))


def measure_resident_mb(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text("ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
