"""Haply devices for the tests: the emulated Inverse Service in another process, and the driver on its port."""

import json
import os
import subprocess
import sys
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from helpers import rig_files
from helpers.waits import eventually
from softfinger.drivers.haply.device import HaplyDevice, open_device

RIG = "haply-inverse3"
ID = "049D"
TESTS = Path(__file__).parents[1]


class Service(AbstractContextManager[Any]):
    """Process of the service, controlled by lines on its standard input; it ends with the context."""

    def __init__(
        self,
        version: str = "3.5.0",
        devices: tuple[str, ...] = (f"inverse3:{ID}",),
        grips: tuple[str, ...] = (),
        room: int | None = None,
    ) -> None:
        """Start a service; `room` is the number of bytes of its receive buffer."""
        command = [sys.executable, "-m", "emulators.haply_service", "--version", version]
        command += [] if room is None else ["--room", str(room)]
        for option, names in (("--device", devices), ("--grip", grips)):
            command += [word for name in names for word in (option, name)]
        path = os.pathsep.join(filter(None, (str(TESTS), os.environ.get("PYTHONPATH"))))
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": path}
        )
        self.port: int = self._line()

    def do(self, action: str, **how: Any) -> Any:
        """Send a request; return the answer."""
        self.process.stdin.write(json.dumps({"do": action, **how}) + "\n")
        self.process.stdin.flush()
        return self._line()

    def set(self, **to: Any) -> None:
        self.do("set", to=to)

    def force(self, name: str = ID) -> tuple[float, ...]:
        """Return the present force (N) of a device's motors."""
        return tuple(self.do("force", id=name))

    def log(self, name: str = ID) -> list[list[float]]:
        """Return times (s, monotonic clock) and forces (N) of a device so far."""
        return self.do("log", id=name)

    def commands(self, name: str = ID) -> list[tuple[float, list[float]]]:
        """Return times (s, monotonic clock) and forces (N) that the service received for a device."""
        return self.do("commands", id=name)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def _line(self) -> Any:
        line = self.process.stdout.readline()
        assert line, "the emulated service has ended"
        return json.loads(line)

    def __exit__(self, *_: object) -> None:
        self.kill()
        for end in (self.process.stdin, self.process.stdout):
            end.close()


def rig_options(port: int, **changes: Any) -> Any:
    """Return the [device] table of the shipped rig with changed keys and limits for a busy machine."""
    patient = {"port": port, "stale_s": 0.2, "quiet_s": 0.2, "timeout_s": 1.0}
    return rig_files.rig_options(RIG, **patient | changes)


def opened(service: Service, **changes: Any) -> HaplyDevice:
    return open_device(rig_options(service.port, **changes), 1000.0)


def settle(device: HaplyDevice) -> None:
    """Wait until the service has answered the latest wrench of the loop, or can no longer do so."""
    eventually(device.is_settled, 5.0)
