"""Haply's Inverse Service in a separate process, with devices and hands on them: `python -m emulators.haply_service`.

Written from the maker's pages of service 3.5 and from public programs for 3.1 to 3.4, independent of the driver.
WebSocket and HTTP share a port. A client gets an inventory on connect, then one state for each of its messages. A
command lasts until the next one; forces of several sessions add up, and the end of a session ends its force. Unknown
keys are ignored.

The maker's page "HTTP" describes each answer twice: as the plain value (the example of `/version`), and for all GET and
POST in an envelope, `{"ok": true, "data": value}`. `enveloped` selects one. A mount is flat in a snapshot and below
`transform` in a command ("Mount & Workspace"); a test sets either.

A test controls it by lines of JSON on its standard input, each answered by a line (`Desk`).

Not modelled: the time after which a device ends a force that is not renewed (no page defines it), the effects of force
gate, torque scaling and gravity compensation on a force, the delay until a missing device or grip is removed from the
list, if 3.1 to 3.4 report their version on this port, battery and safety events, the second format of grips,
navigation, and the time of the bus to the device.
"""

import argparse
import json
import socket
import struct
import sys
import threading
import time
from contextlib import suppress
from typing import Any, Final

from websockets.exceptions import InvalidState
from websockets.frames import Frame, Opcode
from websockets.http11 import Request
from websockets.server import ServerProtocol

from emulators.hand import Handle, Vector, stroke

CENTRE: Final = {"x": 0.0, "y": -0.12, "z": 0.15}
"""Rest position of a cursor (m), as in the maker's example."""


class Inverse:
    def __init__(self, name: str) -> None:
        self.name = name
        self.position: Any = dict(CENTRE)
        """m; "clock": x is the fraction of the monotonic clock's second."""
        self.handle: Handle | None = None
        """Hand on the device; each message moves it by a millisecond. None: the device does not move."""
        self.requests: dict[int, Vector] = {}
        """Force (N) of each session."""
        self.log: list[tuple[float, float, float, float]] = []
        """Time (s, monotonic clock) and force (N) of each command, and of each end of one."""
        self.settings: dict[str, Any] = {
            "gravity_compensation": {"enabled": True, "scaling_factor": 1.0},
            "torque_scaling": {"enabled": True},
            "home_return": {"enabled": True},
        }
        self.status = {"calibrated": True, "in_use": False, "power_supply": True, "ready": True, "started": True}

    def force(self) -> Vector:
        x, y, z = (sum(force[k] for force in self.requests.values()) for k in range(3))
        return (float(x), float(y), float(z))

    def take(self, session: int, force: Vector, now: float) -> None:
        self.requests[session] = force
        self.log.append((now, *self.force()))
        if self.handle is not None:
            self.handle.move(self.force())
            place = zip("xyz", self.handle.place, strict=True)
            self.position = {axis: CENTRE[axis] + value for axis, value in place}

    def leave(self, session: int, now: float) -> None:
        if self.requests.pop(session, None) is not None:
            self.log.append((now, *self.force()))

    def state(self, now: float) -> dict[str, Any]:
        x, y, z = self.force()
        return {
            "cursor_position": {"x": now % 1.0, "y": 0.0, "z": 0.0} if self.position == "clock" else self.position,
            "cursor_velocity": {"x": 0.0, "y": 0.0, "z": 0.0},
            "angular_position": {"a0": -69.31, "a1": 137.62, "a2": 19.83},
            "angular_velocity": {"a0": 0.0, "a1": 0.0, "a2": 0.0},
            "body_orientation": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0},
            "current_cursor_force": {"x": x, "y": y, "z": z},
            "control_domain": "cartesian",
            "control_mode": "force" if self.requests else "idle",
        }


class Service:
    def __init__(self, version: str, devices: list[str], grips: list[str]) -> None:
        self.version, self.lock = version, threading.RLock()
        self.devices: dict[str, dict[str, Inverse]] = {}
        for device in devices:
            group, _, name = device.partition(":")
            self.devices.setdefault(group, {})[name] = Inverse(name)
        self.grips: dict[str, dict[str, dict[str, Any]]] = {}
        for device in grips:
            group, _, name = device.partition(":")
            self.grips.setdefault(group, {})[name] = _grip(group)
        self.absent: set[str] = set()
        """Ids removed from the list."""
        self.sessions = 0
        self.filters: dict[int, dict[str, Any]] = {}
        """By session."""
        self.mount: dict[str, Any] | None = _identity()
        self.transform: dict[str, Any] | None = _identity()
        """Of the workspace, by the Haply Hub or another program."""
        self.types: dict[str, str] = {}
        """`config.type` by device, if it differs from the name of its list."""
        self.enveloped = True
        """If set, answers to a POST (to /version: `version_enveloped`) are `{ok, data}`, otherwise the plain value."""
        self.version_enveloped = False
        self.mute = False
        """If set, it receives but does not answer."""
        self.late_s = 0.0
        self.spoil: str | None = None
        """Text sent instead of a state."""
        self.raw: str | None = None
        """Bytes in hexadecimal digits, sent once to each session instead of a state; the session then continues."""
        self.end: str | None = None
        """End of each session after `raw`: "fin" closes the service's half of the connection, "rst" resets it."""
        self.broken: set[int] = set()
        """Sessions to which `raw` was sent."""
        self.deaf = False
        """If set, it reads no further message from any session."""
        self.streams = False
        """If set, it sends a state per millisecond while `deaf`."""
        self.pages: dict[str, str] = {}
        """Bodies that replace those of HTTP, by path."""
        self.http_requests: list[str] = []
        """HTTP request lines with their bodies."""
        self.sent: list[str] = []
        """First message of each session."""
        self.commands: dict[str, list[tuple[float, Vector]]] = {}
        """Received forces (N) with their times (s, monotonic clock), in order, by device; without ends of sessions."""

    @property
    def force_key(self) -> str:
        return "vector" if _number(self.version) >= (3, 5) else "values"

    def enter(self) -> int:
        with self.lock:
            self.sessions += 1
            self.filters[self.sessions] = {"force_gate": {"gain": 0.3}, "damping": {"scalar": 0.0}}
            return self.sessions

    def leave(self, session: int) -> None:
        with self.lock:
            for device in self.all():
                device.leave(session, time.monotonic())

    def all(self) -> list[Inverse]:
        return [device for group in self.devices.values() for device in group.values()]

    def hear(self, session: int, text: str) -> None:
        with self.lock:
            message, now = json.loads(text), time.monotonic()
            for group, devices in self.devices.items():
                for entry in message.get(group, []):
                    device = devices.get(entry.get("device_id"))
                    force = entry.get("commands", {}).get("set_cursor_force", {}).get(self.force_key)
                    if device is None or force is None:
                        continue
                    force_n = (force["x"], force["y"], force["z"])
                    self.commands.setdefault(device.name, []).append((now, force_n))
                    if device.name not in self.absent:
                        device.take(session, force_n, now)

    def view(self, session: int, whole: bool) -> str:
        with self.lock:
            now = time.monotonic()
            shown: dict[str, Any] = {"session_id": session} if whole else {}
            for group, devices in self.devices.items():
                shown[group] = [
                    {
                        "device_id": device.name,
                        "state": device.state(now) | {"transform": self.transform},
                        "status": device.status,
                    }
                    | ({"config": self._config(group, device, session)} if whole else {})
                    for device in devices.values()
                    if device.name not in self.absent
                ]
            for group, grips in self.grips.items():
                shown[group] = [
                    {"device_id": name, "state": state, "status": {"ready": True}}
                    for name, state in grips.items()
                    if name not in self.absent
                ]
            return json.dumps(shown).replace("Infinity", "null").replace("NaN", "null")  # as the maker's JSON library

    def answer_http(self, method: str, path: str, body: str) -> tuple[int, str]:
        with self.lock:
            self.http_requests.append(f"{method} {path} {body}".strip())
            if path in self.pages:
                return 200, self.pages[path]
            path = path.partition("?")[0]
            old = _number(self.version) < (3, 1)
            if method == "GET" and path == ("/3.0/version" if old else "/version"):
                value = {"git_tag": self.version, "project_version": f"{self.version}.0"}
                return 200, json.dumps({"ok": True, "data": value} if self.version_enveloped else value)
            if method == "POST" and body:
                return self._set(path.strip("/").split("/"), json.loads(body))
            return 404, json.dumps({"ok": False, "error": "not found"})

    def _set(self, path: list[str], body: dict[str, Any]) -> tuple[int, str]:
        new = _number(self.version) >= (3, 5)
        if len(path) == 4 and path[2] == "config" and new:
            device, key = self.devices.get(path[0], {}).get(path[1]), path[3]
            if device is not None and key in device.settings:
                device.settings[key] |= body
                return 200, self._applied(device.settings[key])
            if device is not None and key in ("force_gate", "damping"):
                return 200, self._applied(body)
        if len(path) == 1 and path[0] in ("gravity_compensation", "torque_scaling"):
            device = next((device for device in self.all() if device.name == body["device_id"]), None)
            if device is not None:
                device.settings[path[0]]["enabled"] = body["enable"]
                if "gravity_scaling_factor" in body:
                    device.settings[path[0]]["scaling_factor"] = body["gravity_scaling_factor"]
                return 200, json.dumps({"ok": True})
        return 404, json.dumps({"ok": False, "error": "no such route"})

    def _applied(self, value: dict[str, Any]) -> str:
        return json.dumps({"ok": True, "data": value} if self.enveloped else value)

    def _config(self, group: str, device: Inverse, session: int) -> dict[str, Any]:
        new = _number(self.version) >= (3, 5)
        config = {
            "type": self.types.get(device.name, group),
            "port": "/dev/ttyACM0",
            "device_info": {"major_version": 7, "minor_version": 4, "id": device.name, "device_type": 4},
            "handedness": "right",
            "gravity_compensation": device.settings["gravity_compensation"],
            "torque_scaling": device.settings["torque_scaling"],
        }
        if new:
            config |= {
                "home_return": device.settings["home_return"],
                "preset": "defaults",
                "basis": {"permutation": "XYZ"},
                "mount": self.mount,
                "filters": self.filters[session],
            }
        return config


def _number(version: str) -> tuple[int, int]:
    major, minor = version.split(".")[:2]
    return int(major), int(minor)


def _identity() -> dict[str, Any]:
    return {
        "position": {"x": 0, "y": 0, "z": 0},
        "rotation": {"w": 1, "x": 0, "y": 0, "z": 0},
        "scale": {"x": 1, "y": 1, "z": 1},
    }


def _grip(group: str) -> dict[str, Any]:
    orientation = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
    if group == "verse_grip":
        return {"orientation": orientation, "button": False, "hall": 0}
    return {"orientation": orientation, "buttons": {"a": False, "b": False, "c": False}, "battery_level": 0.8}


class Connection:
    def __init__(self, service: Service, end: socket.socket) -> None:
        self.service, self.end = service, end
        self.protocol = ServerProtocol()

    def run(self) -> None:
        with self.end, suppress(OSError, InvalidState):  # a client may close during an answer
            head = b""
            while b"\r\n\r\n" not in head:
                data = self.end.recv(65536)
                if not data:
                    return
                head += data
            if b"upgrade: websocket" in head.lower():
                self._session(head)
            else:
                self._page(head)

    def _page(self, head: bytes) -> None:
        top, _, body = head.partition(b"\r\n\r\n")
        lines = top.decode("latin-1").split("\r\n")
        length = next((int(line.split(":")[1]) for line in lines if line.lower().startswith("content-length:")), 0)
        while len(body) < length:
            body += self.end.recv(65536)
        method, path, _ = lines[0].split(" ")
        status, text = self.service.answer_http(method, path, body.decode())
        data = text.encode()
        head_out = f"HTTP/1.1 {status} X\r\nContent-Type: application/json\r\nContent-Length: {len(data)}\r\n\r\n"
        self.end.sendall(head_out.encode() + data)

    def _session(self, head: bytes) -> None:
        service, protocol, first = self.service, self.protocol, True
        protocol.receive_data(head)
        session = service.enter()
        try:
            while True:
                for event in protocol.events_received():
                    if isinstance(event, Request):
                        protocol.send_response(protocol.accept(event))
                        if not service.mute:
                            self._say(service.view(session, whole=True))
                    elif isinstance(event, Frame) and event.opcode is Opcode.TEXT:
                        text = bytes(event.data).decode()
                        if first:
                            service.sent.append(text)
                        first = False
                        service.hear(session, text)
                        if service.late_s:
                            time.sleep(service.late_s)
                        if service.raw is not None and session not in service.broken:
                            service.broken.add(session)
                            if self._break():
                                return
                        elif not service.mute:
                            self._say(service.view(session, whole=False))
                for data in protocol.data_to_send():
                    if not data:
                        return
                    self.end.sendall(data)
                data = self.end.recv(65536)
                while service.deaf:
                    time.sleep(1e-3)
                    if service.streams:
                        self._say(service.view(session, whole=False))
                        self.end.sendall(b"".join(protocol.data_to_send()))
                if not data:
                    return
                protocol.receive_data(data)
        finally:
            service.leave(session)

    def _break(self) -> bool:
        self.end.sendall(bytes.fromhex(self.service.raw or ""))
        if self.service.end == "fin":
            self.end.shutdown(socket.SHUT_WR)
        if self.service.end == "rst":
            self.end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self.end.close()
        return self.service.end == "rst"

    def _say(self, text: str) -> None:
        self.protocol.send_text((text if self.service.spoil is None else self.service.spoil).encode())


class Desk:
    def __init__(self, service: Service) -> None:
        self.service = service

    def answer(self, line: dict[str, Any]) -> Any:
        service = self.service
        with service.lock:
            match line["do"]:
                case "set":
                    for name, value in line["to"].items():
                        setattr(service, name, value)
                case "move":
                    self._device(line["id"]).position = line["to"]
                case "hand":
                    self._device(line["id"]).handle = Handle(stroke(tuple(line["at"]), line["press"], line["drag"]))
                case "status":
                    self._device(line["id"]).status |= line["to"]
                case "grip":
                    for group in service.grips.values():
                        if line["id"] in group:
                            group[line["id"]] |= line["to"]
                case "vanish":
                    now = time.monotonic()
                    service.absent.add(line["id"])
                    for device in service.all():  # its motors have no power
                        for session in [*device.requests] if device.name == line["id"] else []:
                            device.leave(session, now)
                case "return":
                    service.absent.discard(line["id"])
                case "force":
                    return self._device(line["id"]).force()
                case "log":
                    return self._device(line["id"]).log
                case "commands":
                    return service.commands.get(line["id"], [])
                case "settings":
                    return self._device(line["id"]).settings
                case "seen":
                    return {"asked": service.http_requests, "said": service.sent, "sessions": service.sessions}
        return None

    def _device(self, name: str) -> Inverse:
        return next(device for device in self.service.all() if device.name == name)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--version", required=True)
    parser.add_argument("--room", type=int, metavar="BYTES", help="receive buffer; the system's default without it")
    parser.add_argument("--device", action="append", default=[], metavar="GROUP:ID")
    parser.add_argument("--grip", action="append", default=[], metavar="GROUP:ID")
    args = parser.parse_args()
    service = Service(args.version, args.device, args.grip)
    listener = socket.create_server(("127.0.0.1", 0))
    if args.room is not None:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, args.room)

    def listen() -> None:
        while True:
            end, _ = listener.accept()  # with the buffer sizes of its listener
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=Connection(service, end).run, daemon=True).start()

    threading.Thread(target=listen, daemon=True).start()
    print(json.dumps(listener.getsockname()[1]), flush=True)
    desk = Desk(service)
    for line in sys.stdin:
        print(json.dumps(desk.answer(json.loads(line))), flush=True)


if __name__ == "__main__":
    main()
