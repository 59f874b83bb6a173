"""Connection to a device at the service: search, lock, and setup of the service's filters on its forces."""

from __future__ import annotations

import errno
import os
import socket
import struct
import time
from contextlib import ExitStack
from math import isclose
from typing import Any, Final, NamedTuple
from urllib.parse import quote

import msgspec
from msgspec import Struct

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceNotFound, DeviceTimeout
from softfinger.drivers.haply.link import START, WebSocketLink, import_websockets, request
from softfinger.drivers.haply.messages import (
    GRIPS,
    GROUPS,
    VECTOR_SINCE,
    Config,
    DeviceRef,
    Inventory,
    InventoryEntry,
    Malformed,
    Missing,
    PoseReading,
    encode_command,
    find_force_key,
    format_moved,
    format_no_state,
    is_identity,
    parse_version,
    read_inventory,
    read_state,
    shorten,
)
from softfinger.drivers.haply.options import Filters, Options
from softfinger.drivers.system import discovery

OPEN_S: Final = 2.0
"""Maximum time for version, inventory, filters and the first state together."""
_ZERO: Final = (0.0, 0.0, 0.0)
_CREDENTIALS: Final = struct.Struct("3i")
"""Process, user and group of a peer."""


class Version(Struct):
    """Answer to /version: the fields themselves, or below `data`."""

    git_tag: str = ""
    project_version: str = ""
    data: Version | None = None


class Connection(NamedTuple):
    """Open connection with its lock, device, grip, key of forces and first pose."""

    link: WebSocketLink
    lock: socket.socket
    device: DeviceRef
    grip: DeviceRef | None
    key: str
    reading: PoseReading


def open_connection(options: Options) -> Connection:
    """Find, lock and set up the device of a rig. Raises DeviceNotFound, DeviceBusy, DeviceTimeout, DeviceError."""
    import_websockets()  # report a missing library before a missing service
    until = time.monotonic() + OPEN_S
    version = _choose_version(options, until)
    with ExitStack() as resources:
        link = WebSocketLink(options.port, until)
        resources.callback(link.close)
        try:
            inventory = _request_inventory(link, until)
            device, entry = choose_device(inventory, options.device_id, options.models)
            grip = choose_grip(inventory, options.grip)
            lock = resources.enter_context(claim(options.port, device))
            _apply_filters(options, version, device, entry, inventory.session_id, until)
            key = find_force_key(version)
            link.send(encode_command(device, key, _ZERO, basis=True))
            connection = Connection(
                link, lock, device, grip, key, read_state(link.wait_for_message(until), device, grip)
            )
        except Missing as error:
            raise DeviceError(str(error)) from None
        except Malformed as error:
            raise DeviceError(f"{error}: check that this is the Inverse Service, of version 3.1 to 3.5") from None
        resources.pop_all()
        return connection


def identify(port: int, version: str | None) -> dict[str, Any]:
    """Return the version of the service, and its devices and grips; `version`: of the rig, None: ask the service."""
    until = time.monotonic() + OPEN_S
    version_info = version or _find_version(port, until)
    parse_version(version_info)
    link = WebSocketLink(port, until)
    try:
        inventory = _request_inventory(link, until)
    finally:
        link.close()
    names = {"devices": GROUPS, "grips": GRIPS}
    return {"service": version_info} | {
        key: [str(ref) for ref, _ in inventory.list_devices(groups)] for key, groups in names.items()
    }


def choose_device(
    inventory: Inventory, device_id: str | None, models: tuple[str, ...] | None
) -> tuple[DeviceRef, InventoryEntry]:
    """Return the device of `models` with the id, or the only one; raises DeviceNotFound."""
    entries = inventory.list_devices(GROUPS)
    candidates = [entry for entry in entries if device_id in (None, entry[0].name)]
    matching = [entry for entry in candidates if models is None or _find_model(*entry) in models]
    if len(matching) == 1:
        return matching[0]
    choices = ", ".join(str(ref) for ref, _ in entries)
    if matching:
        raise DeviceNotFound(f"{len(matching)} devices are at the Inverse Service: name one with device_id: {choices}")
    if candidates and models is not None:
        present = ", ".join(f"{ref} (type {_find_model(ref, entry)})" for ref, entry in candidates)
        raise DeviceNotFound(
            f"the Inverse Service lists {present}, but the rig is for {', '.join(models)}: use rig haply-inverse3 or "
            "haply-minverse, or change models, limits and mounting under [device]"
        )
    id_text = f" with device_id = '{device_id}'" if device_id is not None else ""
    raise DeviceNotFound(
        f"no Inverse3, Inverse3x or Minverse{id_text} is at the Inverse Service, which lists {choices or 'no device'}: "
        "plug it in, switch it on and wait for its light"
    )


def _find_model(ref: DeviceRef, entry: InventoryEntry) -> str:
    """Return the model of a device: the type in its configuration, or the name of the list that contains it."""
    return entry.config.type if entry.config is not None and entry.config.type in GROUPS else ref.group


def choose_grip(inventory: Inventory, grip_id: str) -> DeviceRef | None:
    """Return the grip with the id; for "auto" the only one, or None without any. Raises DeviceNotFound."""
    entries = [ref for ref, _ in inventory.list_devices(GRIPS)]
    if grip_id == "none":
        return None
    matching = [ref for ref in entries if grip_id in ("auto", ref.name)]
    if len(matching) == 1:
        return matching[0]
    choices = ", ".join(map(str, entries)) or "no grip"
    if matching:
        raise DeviceNotFound(
            f'{len(matching)} VerseGrips are at the Inverse Service: name one with grip, or set grip = "none": '
            f"{choices}"
        )
    if grip_id == "auto":
        return None
    raise DeviceNotFound(
        f"no VerseGrip '{grip_id}' is at the Inverse Service, which lists {choices}: pair it in the Haply Hub"
    )


def _find_version(port: int, until: float) -> str:
    status, body = request(port, "GET", "/version", None, until)
    try:
        version_info = msgspec.json.decode(body, type=Version)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        version_info = Version()
    version_info = version_info.data or version_info
    if status == 200 and (version := version_info.project_version or version_info.git_tag):
        return version
    raise DeviceError(
        f"the program on port {port} returns no version (GET /version: {status} {shorten(body)}): if it is the Inverse "
        "Service, set version under [device] to the one that the Haply Hub shows; with a wrong version the "
        "service ignores forces"
    )


def _choose_version(options: Options, until: float) -> tuple[int, int]:
    """Return the version in the rig, otherwise that of the service.

    Raises DeviceError if the two versions use different keys for forces.
    """
    if options.version is None:
        return parse_version(_find_version(options.port, until))
    version = parse_version(options.version)
    try:
        reported = _find_version(options.port, until)
        differs = find_force_key(parse_version(reported)) != find_force_key(version)
    except DeviceError:
        return version  # the service does not report it
    if differs:
        raise DeviceError(
            f"version = {options.version} under [device], but the Inverse Service is version {reported}, which ignores "
            "forces in that form: remove version from the rig"
        )
    return version


def _request_inventory(link: WebSocketLink, until: float) -> Inventory:
    try:
        return read_inventory(link.wait_for_message(until))
    except DeviceTimeout:
        raise DeviceTimeout(f"the Inverse Service does not answer within {OPEN_S:g} s: restart it ({START})") from None
    except Malformed as error:
        raise DeviceError(f"{error}: check that this is the Inverse Service, of version 3.1 to 3.5") from None


def _apply_filters(
    options: Options, version: tuple[int, int], device: DeviceRef, entry: InventoryEntry, session: int, until: float
) -> None:
    """Set the service's filters as in the rig; raises DeviceError if it rejects one."""
    if entry.state is None or entry.config is None:
        raise DeviceError(format_no_state(device))
    if not (is_identity(entry.config.mount) and is_identity(entry.state.transform)):
        raise DeviceError(format_moved(device))
    for path, body in _list_config_requests(version, device, entry.config, options.filters, session):
        status, answer = request(options.port, "POST", path, body, until)
        if status != 200 or not is_applied(answer, body):
            raise DeviceError(f"{device}: the service refused {path} {body}: {status} {shorten(answer)}")


def is_applied(answer: bytes, body: dict[str, Any]) -> bool:
    """Return True if an answer to a POST confirms `body`: `{ok: true}`, with or without `data`, or the value alone.

    A value in the answer has to be the posted one; the service may have limited it.
    """
    try:
        reply = msgspec.json.decode(answer, type=dict[str, Any])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return False
    if "ok" in reply:
        confirmed, value = reply["ok"] is True, reply.get("data") or {}
    else:
        confirmed, value = body.keys() <= reply.keys(), reply
    return confirmed and all(_is_close(value.get(key, expected), expected) for key, expected in body.items())


def _is_close(value: Any, expected: Any) -> bool:
    """Return True for equal values; numbers may have been rounded to single precision."""
    if isinstance(value, float | int) and isinstance(expected, float):
        return isclose(value, expected, rel_tol=1e-6)
    return bool(value == expected)


def _list_config_requests(
    version: tuple[int, int], device: DeviceRef, config: Config, filters: Filters, session: int
) -> list[tuple[str, Any]]:
    """Return the pages to post, with their content, for settings of the rig that differ from the present ones.

    Pages of a session are always posted, because a program that configures sessions (the Haply Hub) may have changed
    them. No public page describes force gate and damping before 3.5.
    """
    gravity, torque, home = config.gravity_compensation, config.torque_scaling, config.home_return
    enabled, factor = filters.gravity_compensation, filters.gravity_scale
    sets_gravity = gravity is None or (gravity.enabled, gravity.scaling_factor) != (enabled, factor)
    sets_torque = torque is None or torque.enabled != filters.torque_scaling
    pages: list[tuple[str, Any]] = []
    if version >= VECTOR_SINCE:
        at = f"/{device.group}/{quote(device.name, safe='')}/config"
        pages.append((f"{at}/force_gate?session={session}", {"gain": filters.force_gate}))
        pages.append((f"{at}/damping?session={session}", {"scalar": filters.damping}))
        if sets_gravity:
            pages.append((f"{at}/gravity_compensation", {"enabled": enabled, "scaling_factor": factor}))
        if sets_torque:
            pages.append((f"{at}/torque_scaling", {"enabled": filters.torque_scaling}))
        if home is not None and home.enabled:
            pages.append((f"{at}/home_return", {"enabled": False}))
        return pages
    if (filters.force_gate, filters.damping) != (Filters().force_gate, Filters().damping):
        raise DeviceError(
            f"{device}: force_gate and damping can only be set at a service of 3.5 or later: "
            "update it, or leave them out of [device.filters]"
        )
    if sets_gravity:
        body = {"device_id": device.name, "enable": enabled, "gravity_scaling_factor": factor}
        pages.append(("/gravity_compensation", body))
    if sets_torque:
        pages.append(("/torque_scaling", {"device_id": device.name, "enable": filters.torque_scaling}))
    return pages


def claim(port: int, device: DeviceRef) -> socket.socket:
    """Lock a device of the service on `port`, until the returned socket is closed or this process ends.

    The lock is the name of an abstract Unix socket. Such names belong to a network namespace, like the service's port,
    and the system releases them however a process ends.
    """
    address = f"\0softfinger/haply/{port}/{device.group}/{device.name}"
    lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        lock.bind(address)
        lock.listen()
    except OSError as error:
        lock.close()
        if error.errno != errno.EADDRINUSE:
            raise DeviceError(f"{device} cannot be locked for this program: {error.strerror or error}") from error
        raise DeviceBusy(
            f"{device} at the Inverse Service on port {port} is in use by {_find_holder(address)}, and the forces of "
            "two programs would add up: end that one first, or name another device with device_id"
        ) from None
    return lock


def _find_holder(address: str) -> str:
    """Return the process that listens on a Unix socket, as text for messages."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(address)
            pid, _, _ = _CREDENTIALS.unpack(probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
        except OSError:  # it has exited, or its connection queue is full
            pid = 0
    if pid <= 0:  # in another namespace
        return "another process"
    return "this program" if pid == os.getpid() else str(discovery.read_process(pid))
