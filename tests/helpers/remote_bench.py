"""Bench with a device in another process, reached through the socket named in the environment."""

import json
import os
import socket
from typing import Any, ClassVar, Final

from softfinger.server.driver_contract import Bench

SOCKET: Final = "SOFTFINGER_TESTBED"


class RemoteBench(Bench):
    """An emulated device in another process. Requests are lines; answers are lines of JSON."""

    patience_s: ClassVar[float] = 10.0

    def ask(self, line: str) -> Any:
        with socket.socket(socket.AF_UNIX) as end:
            end.connect(os.environ[SOCKET])
            end.sendall(line.encode() + b"\n")
            with end.makefile() as stream:
                return json.loads(stream.readline())

    def displayed(self) -> tuple[float, ...]:
        x, y, z = self.ask("displayed")
        return (x, y, z)

    def make(self, case: str) -> None:
        self.ask(f"make {case}")

    def mend(self) -> None:
        self.ask("mend")
