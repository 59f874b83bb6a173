"""Random commands and faults at two boards: every frame that reaches a board obeys the limits of the guard.

The daemon runs in a separate process; both boards and all clients are in this one. SOFTFINGER_WRITES is the number of
frames that `make test-all` sends.
"""

import contextlib
import os
import random
import signal
import time
import tomllib
from math import ceil, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from emulators.serialboard import FRAME_BYTES, Board, Cable, Vector
from helpers.processes import COMMAND, list_children
from helpers.programs import Program
from helpers.two_fingers import SCENE
from helpers.waits import WAIT_S, until

from softfinger.config.errors import CommandRefused, HapticError
from softfinger.server.loop.force_switch import MAX_OFF_S
from softfinger.server.wire.control import Control

pytestmark = pytest.mark.real_time

WRITES = int(os.environ.get("SOFTFINGER_WRITES", "200000"))
RUNS = 8
"""A test may take five minutes."""
FORCE_MAX_N, SLEW_N, HEARTBEAT_S = 3.0, 0.3, 1.0
"""Limits of the rig; SLEW_N is per tick."""
OFF_STEP_N = FORCE_MAX_N / (1000.0 * MAX_OFF_S)
"""Change per tick while the switch fades the force out, along its direction."""
ROUNDING_N = 0.5e-3 * 3**0.5
"""A frame has integer mN for each component."""
LATE_FRAMES = 3
"""Ticks that may start without having read a command that stops the force, after its answer."""
SPOILT = (b"     nan", b"     inf", b"   1e999", b"  80.000", b" -80.000", b"\0\xff\n\n\n\n\n\n")
NAMES = ("thumb", "index")
RIG = f"""
servo.realtime = "off"
telemetry.endpoint = "ipc://FOLDER/telemetry"
commands = {{ endpoint = "ipc://FOLDER/commands", heartbeat_s = {HEARTBEAT_S} }}
recording.directory = "FOLDER"
[guard]
force_max_n = {FORCE_MAX_N}
force_slew_n_per_s = {1000.0 * SLEW_N}
ramp_s = 0.05
handle_speed_max_m_per_s = 3.0
"""
DEVICE = """
[devices.NAME]
driver = "serial"
path = "PATH"
baud = 921600
force_max_n = 5.0
stiffness_max_n_per_m = 1000.0
damping_max_ns_per_m = 8.0
workspace_radius_m = 0.1
quiet_s = 0.1
timeout_s = 2.0
"""


class SwayingHand:
    """Hand that sways about a height set by a test; at 0 m the fingertip is as deep as its radius."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.height = 0.03
        self.reach = 0.01

    def __call__(self, t: float) -> Vector:
        side = self.reach * sin((3.0 + self.number) * t)
        return (side, self.reach * sin(5.0 * t), self.height + 0.002 * sin(17.0 * t))


class ForcelessSpans:
    """Frame ranges of one board without force: from the answer to a command until force is allowed again."""

    def __init__(self, cable: Cable) -> None:
        self.cable = cable
        self.since: int | None = None
        self.spans: list[tuple[int, int]] = []

    def begin(self) -> None:
        """Allow no force after the frames written so far."""
        if self.since is None:
            frames = ceil((self.cable.sent_to() - self.cable.board.wakes) / FRAME_BYTES)
            self.since = frames + LATE_FRAMES + ceil(1000.0 * MAX_OFF_S)

    def end(self) -> None:
        if self.since is not None:
            self.spans.append((self.since, len(self.cable.board.sent)))
        self.since = None


class Session:
    """Daemon with two boards, and a random client."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.draw = folder, random.Random(seed)
        self.hands = [SwayingHand(number) for number in range(2)]
        self.cables = [Cable(Board(hand)) for hand in self.hands]
        self.forceless = [ForcelessSpans(cable) for cable in self.cables]
        self.resumed: list[list[int]] = [[], []]
        """First frames after a pause longer than the guard carries a force over."""
        self.starts = 0
        self.answered: dict[str, int] = {}
        devices = "".join(
            DEVICE.replace("NAME", name).replace("PATH", cable.path)
            for name, cable in zip(NAMES, self.cables, strict=True)
        )
        (folder / "rig.toml").write_text((RIG + devices).replace("FOLDER", str(folder)))
        (folder / "scene.toml").write_text(SCENE)
        self.log = (folder / "log").open("wb")
        self.daemon = self.start()

    def close(self) -> None:
        self.daemon.kill()
        self.daemon.wait()
        self.log.close()
        for cable in self.cables:
            cable.pull()

    def start(self) -> Program:
        """Start a daemon and wait until both boards receive frames."""
        self.starts += 1
        before = self.writes()
        words = ["-q", "run", "--rig", str(self.folder / "rig.toml"), "--scene", str(self.folder / "scene.toml")]
        daemon = Program([*COMMAND, *words], stdout=self.log, stderr=self.log)
        until(lambda: self.writes() > before + 100 or daemon.poll() is not None)
        assert daemon.poll() is None, (self.folder / "log").read_text()[-3000:]
        return daemon

    def writes(self) -> int:
        return sum(len(cable.board.sent) for cable in self.cables)

    def control(self) -> Control:
        return Control(f"ipc://{self.folder}/commands", timeout_s=10.0)

    def call(self, method: str, *args: Any, **keys: Any) -> bool:
        """Send a command; return True if it was done, False if refused."""
        with self.control() as control:
            try:
                getattr(control, method)(*args, **keys)
            except CommandRefused:
                return False
        self.answered[method] = self.answered.get(method, 0) + 1
        return True

    def forbid_force(self) -> None:
        for interval in self.forceless:
            interval.begin()

    def permit_force(self) -> None:
        for interval in self.forceless:
            interval.end()

    # Actions that end the force.

    def disarm(self) -> None:
        self.call("disarm")
        self.forbid_force()
        time.sleep(self.draw.uniform(0.0, 0.1))
        if self.draw.random() < 0.5:
            place = tuple(self.draw.uniform(-0.05, 0.05) for _ in range(3))
            with contextlib.suppress(HapticError):
                self.call("zero", place, finger=self.draw.choice(NAMES))
        self.flood(self.draw.randrange(5))
        self.arm()

    def arm(self) -> None:
        self.permit_force()
        self.call("arm")

    def silence(self) -> None:
        time.sleep(HEARTBEAT_S + 0.05)
        self.forbid_force()
        time.sleep(self.draw.uniform(0.02, 0.1))
        self.permit_force()
        self.call("heartbeat")

    def stop(self) -> None:
        self.call("stop")
        self.forbid_force()
        self.restart()

    def terminate(self) -> None:
        self.daemon.terminate()
        self.restart()

    def kill(self) -> None:
        self.daemon.kill()
        self.restart()

    def restart(self) -> None:
        self.daemon.wait(WAIT_S)
        self.permit_force()
        for cable in self.cables:
            cable.mute.clear()
            cable.spoil = bytes
        self.daemon = self.start()

    # Commands.

    def parameters(self) -> None:
        draw = self.draw
        values = {
            "object.table.material.stiffness_n_per_m": 10.0 ** draw.uniform(0.0, 6.0),
            "object.table.material.friction.static": draw.uniform(0.5, 3.0),
            "object.table.material.friction.kinetic": draw.uniform(0.0, 0.5),
            "effect.0.force_n": [draw.uniform(-40.0, 40.0) for _ in range(3)],
            "finger.thumb.radius_m": draw.uniform(0.001, 0.03),
        }
        self.call("set_params", dict(draw.sample(sorted(values.items()), draw.randint(1, len(values)))))

    def drive(self) -> None:
        pose = tuple(self.draw.uniform(-0.03, 0.03) for _ in range(3))
        turn = tuple(self.draw.uniform(-1.0, 1.0) for _ in range(4))
        self.call("drive", "table", pose, turn)

    def scene(self) -> None:
        stiffness = {"object.0.material.stiffness_n_per_m": self.draw.uniform(100.0, 3000.0)}
        self.call("set_scene", self.draw.choice([tomllib.loads(SCENE), "no-such-scene"]), stiffness)

    def mark(self) -> None:
        self.call("mark", "label", {"a": [1.0] * self.draw.randrange(1000)})

    def record(self) -> None:
        if not self.call("record_start", f"{self.draw.getrandbits(60)}.mcap"):
            self.call("record_stop")

    def flood(self, number: int = 50) -> None:
        """Send messages of random bytes without waiting for answers."""
        socket = zmq.Context.instance().socket(zmq.DEALER)
        socket.linger = 0
        socket.connect(f"ipc://{self.folder}/commands")
        for _ in range(number):
            socket.send(self.draw.randbytes(self.draw.choice([0, 1, 10, 1000, 100_000])))
        socket.close()

    # Hands and faults.

    def move(self) -> None:
        hand = self.draw.choice(self.hands)
        hand.height, hand.reach = self.draw.uniform(-0.03, 0.03), self.draw.uniform(0.0, 0.04)

    def mute(self) -> None:
        cable = self.draw.choice(self.cables)
        cable.hush()
        time.sleep(self.draw.uniform(0.0, 0.3))
        cable.mute.clear()

    def spoil(self) -> None:
        cable, position = self.draw.choice(self.cables), self.draw.randrange(FRAME_BYTES - 8)
        text = self.draw.choice(SPOILT)
        cable.spoil = lambda frame: frame[:position] + text + frame[position + 8 :]
        time.sleep(self.draw.uniform(0.0, 0.05))
        cable.spoil = bytes

    def suspend(self) -> None:
        self.daemon.send_signal(signal.SIGSTOP)
        time.sleep(0.3)  # the boards receive everything written before
        firsts = [len(cable.board.sent) for cable in self.cables]
        self.daemon.send_signal(signal.SIGCONT)
        for counts, first in zip(self.resumed, firsts, strict=True):
            counts.append(first)

    def kill_publisher(self) -> None:
        for child in list_children(self.daemon.pid):
            with contextlib.suppress(OSError):
                os.kill(child, signal.SIGKILL)


OFTEN = ("move", "parameters", "drive", "mark", "disarm", "mute", "spoil", "flood")
SELDOM = ("scene", "record", "silence", "suspend", "kill_publisher")
ENDS = ("stop", "terminate", "kill")


@pytest.mark.exhaustive
@pytest.mark.parametrize("run", range(RUNS))
def test_no_frame_exceeds_the_limits(run: int, tmp_path: Path) -> None:
    seed = (int(os.environ.get("SOFTFINGER_FUZZ_SEED", "0")) or int.from_bytes(os.urandom(4))) + run
    with contextlib.closing(Session(tmp_path, seed)) as session:
        while session.writes() <= WRITES / RUNS:
            draw = session.draw
            name = draw.choices([draw.choice(OFTEN), draw.choice(SELDOM), draw.choice(ENDS)], [1.0, 0.15, 0.01])[0]
            try:
                getattr(session, name)()
            except HapticError:  # the daemon has exited, or its endpoint does not exist yet
                if session.daemon.poll() is None and name not in ENDS:
                    continue
            if session.daemon.poll() is not None:
                session.restart()
            time.sleep(session.draw.uniform(0.0, 0.05))
        session.call("disarm")
        session.forbid_force()
        for interval in session.forceless:
            until(lambda interval=interval: len(interval.cable.board.sent) > (interval.since or 0) + 20)
        session.permit_force()
    print(f"seed {seed}, {session.starts} starts, commands done: {session.answered}")
    for cable, forceless, resumed in zip(session.cables, session.forceless, session.resumed, strict=True):
        forces, times = np.array(cable.board.sent, float)[:, :3] * 1e-3, np.array(cable.board.sent_at)
        sizes = np.linalg.norm(forces, axis=1)
        steps = np.linalg.norm(np.diff(forces, axis=0, prepend=0.0), axis=1)
        zero = sizes == 0.0
        limited = np.mean(sizes > 0.99 * FORCE_MAX_N)
        print(f"{len(forces)} frames, {np.mean(~zero):.0%} with force, {limited:.1%} at the limit")
        assert not cable.board.faults
        assert np.mean(~zero) > 0.1 and sizes.max() > 0.99 * FORCE_MAX_N  # otherwise the test would show nothing
        assert sizes.max() <= FORCE_MAX_N + ROUNDING_N
        # The fade-out makes up for ticks in which a board has not answered. Such a frame follows the answer to the last
        # one, so after the frame before that: the time between these two is at least that of the ticks.
        ticks = 2.0 + 1000.0 * (times[2:] - times[:-2])
        shortens = np.abs(steps + np.diff(sizes, prepend=0.0)) <= 2.0 * ROUNDING_N
        limit = np.where(shortens, OFF_STEP_N * np.concatenate([[2.0, 2.0], ticks]), SLEW_N)
        # A force that starts from zero may follow any force.
        fast = (steps > limit + 2.0 * ROUNDING_N) & (sizes > SLEW_N + ROUNDING_N)
        assert not fast.any(), [forces[max(k - 2, 0) : k + 2] for k in np.flatnonzero(fast)[:3]]
        late = [np.flatnonzero(~zero[first:last]).max(initial=-1) + 1 for first, last in forceless.spans]
        assert max(late) == 0, late
        assert len(forceless.spans) > 5
        # A tick suspended between computation and write still sends the previous force.
        assert all(sizes[first + 1] <= SLEW_N + ROUNDING_N for first in resumed if first + 1 < len(sizes))
