"""`doctor --device-report`: a rig's device, opened through its driver, measured, and described for an issue."""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, NamedTuple

from softfinger.config.errors import ConfigError, DeviceError, HapticError, SafetyStop
from softfinger.config.files import make_write_error, write_new_file
from softfinger.config.load import load_rig
from softfinger.config.schema import Rig
from softfinger.config.schema.pairing import find_single_device
from softfinger.drivers.base import Device
from softfinger.drivers.kinematics.subspace import read_subspace
from softfinger.drivers.registry import open_device
from softfinger.drivers.system import discovery
from softfinger.server.loop.guard import Guard
from softfinger.server.loop.tuning import make_guard
from softfinger.tools.bench.device import draw
from softfinger.tools.doctor import attached, machine, privacy
from softfinger.tools.doctor.questions import answer_questions
from softfinger.tools.doctor.session import FORCE_MIN_S, DeviceSession
from softfinger.tools.exchange import Exchange, make_disarmed_guard
from softfinger.tools.exchange_figures import format_burst, format_table
from softfinger.tools.measure import show

Report = Mapping[str, Any]

FORMAT: Final = 1
"""Incremented when a key changes its meaning."""
LIBRARIES: Final = ("libdrd", "libHD")


class ReportRequest(NamedTuple):
    """Report that an option requests.

    option        option of the report
    file          its value, the path of the report; empty: the default path
    force_option  option of the pushes
    force_n       largest force of the pushes, N; None: only zero force is sent
    seconds       length of each part but the first
    guided        whether a user at a terminal is to move the handle
    as_json       whether the report is printed as JSON
    plot          path of the figure of the timing, if any
    """

    option: str
    file: str
    force_option: str
    force_n: float | None
    seconds: float
    guided: bool
    as_json: bool
    plot: Path | None = None


def run(args: argparse.Namespace) -> int:
    """Make the report of `--device-report`; returns the exit code. Raises as `make_report`."""
    rig = load_rig(args.rig)
    check_force(args.with_force, args.seconds, rig)
    guided = sys.stdin.isatty() and not args.no_prompts
    request = ReportRequest(
        "--device-report",
        args.device_report,
        "--with-force",
        args.with_force,
        args.seconds,
        guided,
        args.json,
        args.plot,
    )
    return make_report(rig, request, DeviceSession)


def make_report(
    rig: Rig,
    request: ReportRequest,
    session_type: type[DeviceSession],
    head: Callable[[Report], list[str]] = lambda report: [],
) -> int:
    """Run a session of the device of a rig, then write and print the report; returns the exit code.

    `head` returns lines above the text. Raises ConfigError for an unusable file. After the report is written, it raises
    the error with which the device failed to open, or its exchange stopped.
    """
    file = Path(request.file or f"softfinger-{find_single_device(rig).driver}-report.json")
    if not file.parent.is_dir() or file.is_dir():
        raise ConfigError(f"{request.option} {file}: {file.parent} is no folder, or the file is one: name a file")
    report, serials = start_report(rig, request.guided)
    failure: HapticError | KeyboardInterrupt | None = None
    try:
        record(rig, report, request, session_type)
        report["ended"], report["complete"] = "in full", True
    except KeyboardInterrupt as error:
        report["ended"], failure = "stopped by the user", error
    except (DeviceError, SafetyStop) as error:
        report["ended"], failure = "by a fault", error
        report["fault"] = {"kind": type(error).__name__, "message": str(error), "in_use": report["device"] is not None}
    report["questions"] = answer_questions(report)
    report = privacy.Redactor(serials).clean(report)
    write(file, report, request.option)
    show(report, request.as_json, [*head(report), *format_lines(report, file)])
    if failure is not None:
        raise failure
    return 0


def check_force(force_n: float | None, seconds: float, rig: Rig) -> None:
    """Raise ConfigError for pushes that the rig does not allow, or that are too fast."""
    if force_n is None:
        return
    limit = rig.guard.force_max_n
    if not 0.0 < force_n <= limit:
        raise ConfigError(f"--with-force {force_n:g}: must be above 0 and at most guard.force_max_n = {limit:g} N")
    if seconds < FORCE_MIN_S:
        raise ConfigError(
            f"--seconds {seconds:g}: with --with-force at least {FORCE_MIN_S:g}: the force must change slowly"
        )


def start_report(rig: Rig, guided: bool) -> tuple[dict[str, Any], list[str]]:
    """Return a report with all data that is known before opening the device, and the serial numbers to shorten."""
    config = find_single_device(rig)
    devices = [device for device in discovery.list_attached() if attached.is_of(config, device)]
    freedom = read_subspace(config)
    report: dict[str, Any] = {
        "report": FORMAT,
        "complete": False,
        "ended": "",
        "softfinger": version("softfinger"),
        "system": {
            "system": f"{platform.system()} {platform.release()} {platform.machine()}",
            "python": platform.python_version(),
            "packages": machine.list_versions(),
            "checks": {
                item.name: item.seen
                for item in (machine.check_kernel(), machine.check_virtual(), machine.check_processors())
            },
        },
        "driver": config.driver,
        "options": privacy.redact_options(config.options),
        "rate_hz": rig.servo.rate_hz,
        "guided": guided,
        "freedom": "" if freedom is None else freedom.describe(),
        "identity": [identify_device(device) for device in devices],
        "maker_library": [],
        "device": None,
        "realtime": {},
        "rest": None,
        "exchange": None,
        "without_pauses": None,
        "range": None,
        "moves": [],
        "buttons": None,
        "pushes": [],
        "counts": {},
        "reason": "",
        "fault": None,
        "questions": [],
    }
    return report, [device.serial for device in devices]


def identify_device(device: discovery.SystemDevice) -> dict[str, Any]:
    """Return a device as the system lists it, for a hidraw node with the report descriptor, read without opening it."""
    identified: dict[str, Any] = {
        "bus": device.bus,
        "vendor_id": f"{device.vendor:04x}",
        "product_id": f"{device.product:04x}",
        "name": device.name,
        "serial": privacy.shorten_serial(device.serial),
        "node": device.node,
    }
    if device.bus == "hid":
        path = discovery.ROOT / discovery.HIDRAW / Path(device.node).name / "device" / "report_descriptor"
        try:
            identified["report_descriptor"] = path.read_bytes().hex()
        except OSError:
            identified["report_descriptor"] = ""
    return identified


def record(rig: Rig, report: dict[str, Any], request: ReportRequest, session_type: type[DeviceSession]) -> None:
    """Open the device, run a session, and store the results in `report`, also after an error.

    Every exit commands zero force. Raises the errors of opening, and the error of a device that failed in use.
    """
    with open_device(find_single_device(rig), rig.servo.rate_hz) as device:
        report["device"] = asdict(device.info)
        mapped = {line.split(maxsplit=5)[-1] for line in machine.read_system_file(Path("/proc/self/maps")).splitlines()}
        libraries = {Path(file).name for file in mapped if any(name in file for name in LIBRARIES)}
        report["maker_library"] = sorted(libraries)
        force_n, freedom = request.force_n, read_subspace(find_single_device(rig))
        guard = make_disarmed_guard(rig) if force_n is None else limit_guard(rig, device, force_n, request.force_option)
        exchange = Exchange(device, rig, guard)
        session = session_type(exchange, device.info, report, request.seconds, request.guided, freedom)
        try:
            with exchange:
                session.run(force_n)
                failure = exchange.failure()
                if failure is not None:
                    raise failure
        finally:
            report["counts"], report["reason"] = device.counts(), device.reason()
            report["realtime"] = {setting.name: setting.ok for setting in exchange.settings}
    if request.plot is not None and len(session.timing):
        draw(request.plot, session.timing, f"{report['driver']} at {report['rate_hz']:g} Hz")


def limit_guard(rig: Rig, device: Device, force_n: float, option: str = "--with-force") -> Guard:
    """Return the rig's guard, limited to the requested force; raises ConfigError if the device cannot push so hard."""
    if device.info.actuated_dof == 0:
        raise ConfigError(f"{option} {force_n:g}: {device.info.name} displays no force: remove the option")
    if force_n > device.info.force_max_n:
        raise ConfigError(
            f"{option} {force_n:g}: {device.info.name} accepts at most {device.info.force_max_n:g} N: use less"
        )
    return make_guard(rig.guard, device.info)._replace(force_max=force_n)


def write(file: Path, report: dict[str, Any], option: str) -> None:
    """Write the file completely or not at all. Raises the errors of `make_write_error`."""
    try:
        with write_new_file(file) as part:
            part.write((json.dumps(report, indent=2) + "\n").encode())
    except OSError as error:
        raise make_write_error(f"{option} {file}", error, "choose another file") from error


def format_lines(report: Report, file: Path) -> list[str]:
    ended = {"in full": "complete", "by a fault": "ended by a fault"}.get(report["ended"], report["ended"])
    text = [f"device report of driver {report['driver']}, softfinger {report['softfinger']}: {ended}"]
    if report["fault"] is not None:
        text.append(f"  fault: {report['fault']['message']}")
    if report["device"] is not None:
        text.append(f"  {report['device']['name']} at {report['rate_hz']:g} Hz, {report['system']['system']}")
    if report["freedom"]:
        text.append(f"  it moves {report['freedom']}")
    text += [f"  on {usb['bus']} {usb['vendor_id']}:{usb['product_id']} {usb['name']}" for usb in report["identity"]]
    text += _format_measured(report)
    if report["counts"]:
        text.append("  the driver counted: " + ", ".join(f"{name} {value}" for name, value in report["counts"].items()))
    if report["questions"] and report["device"] is not None:  # one that was opened
        text.append("only visible on hardware")
        for entry in report["questions"]:
            text += [f"  {entry['question']}", f"    {entry['answer']}"]
    text.append(f"the complete report is in {file}: attach it to an issue")
    return text


def _format_measured(report: Report) -> list[str]:
    text = []
    if report["exchange"] is not None:
        text += format_table(report["exchange"])
    if report["without_pauses"] is not None:
        text.append(format_burst(report["without_pauses"]))
    if (rest := report["rest"]) is not None:
        noise = ", ".join(f"{value * 1e6:.1f}" for value in rest["position_std_m"])
        handle = "at rest" if report["guided"] else "at the start, without a request to hold it still"
        text.append(f"  noise along x, y, z, {handle}: {noise} um")
    if (span := report["range"]) is not None:
        pairs = zip(span["position_min_m"], span["position_max_m"], strict=True)
        text.append("  was from " + ", ".join(f"{low * 1e3:.1f} to {high * 1e3:.1f}" for low, high in pairs) + " mm")
    for entry in report["moves"]:
        expectation = "" if entry["agrees"] else f", and {entry['expected']} was expected"
        text.append(f"  {entry['asked']}: {entry['seen']}{expectation}")
    if report["buttons"] is not None:
        text.append(f"  button masks: {', '.join(map(str, report['buttons']['masks']))}")
    for entry in report["pushes"]:
        answer = f"; felt: {entry['felt']}" if entry.get("felt") else ""
        text.append(f"  push along {entry['axis']}: {entry['seen']}{answer}")
    return text
