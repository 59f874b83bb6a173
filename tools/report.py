"""`softfinger report`: archive for an issue, without names, folders and serial numbers.

report.json   versions, system, results of `doctor`
rig.json, scene.json
log.txt       lines of the log in the black boxes
blackbox/     the latest black boxes, rewritten with cleaned texts
"""

from __future__ import annotations

import argparse
import io
import json
import logging
import platform
import tarfile
import tempfile
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from softfinger.config.errors import RecordingError
from softfinger.config.files import make_write_error, open_input, write_new_file
from softfinger.config.load import describe, load_rig, load_scene
from softfinger.drivers.mcap_messages import iter_mcap_messages
from softfinger.drivers.system import discovery
from softfinger.server.loop.servo_thread import require_machine_code
from softfinger.server.recording import blackbox
from softfinger.server.recording.reader import Event, Note, TickBlock, read_contents
from softfinger.server.recording.schemas import load_message_class
from softfinger.server.recording.writer import LOG_TOPIC, RecordingFile
from softfinger.tools.doctor import machine, privacy
from softfinger.tools.doctor.verb import examine

log: Final = logging.getLogger(__name__)

LEVEL_STEP: Final = 10
"""Difference between levels of `logging`; Foxglove numbers them from 1."""


def run(args: argparse.Namespace) -> int:
    """Write the archive, completely or not at all; returns 0. Raises the errors of `make_write_error`."""
    require_machine_code("the doctor")
    rig, scene = load_rig(args.rig), load_scene(args.scene)
    place = blackbox.find_folder()
    if place is None:
        log.warning("no black boxes: this user has no home folder; set HOME or SOFTFINGER_BLACKBOX_DIR")
    files = [] if place is None else blackbox.list_files(place)
    boxes = files[len(files) - min(args.boxes, len(files)) :]
    cleaner = privacy.Redactor(device.serial for device in discovery.list_attached())
    content = {
        "softfinger": version("softfinger"),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "packages": machine.list_versions(),
        "doctor": examine(rig, scene, Path(args.rig).name, Path(args.scene).name, args.seconds, None),
    }
    parts = {
        "report.json": _to_json(cleaner.clean(content)),
        "rig.json": _to_json(cleaner.clean(redact_rig(describe(rig)))),
        "scene.json": _to_json(cleaner.clean(describe(scene))),
    }
    lines: list[str] = []
    for path in boxes:
        try:
            parts[f"blackbox/{path.name}"] = clean_recording(path, cleaner)
        except RecordingError as error:  # cut short by a kill, or of another version
            log.warning("left out: %s", error)
            continue
        lines += [f"--- {path.name}", *(text for *_, text in log_lines(path, cleaner))]
    parts["log.txt"] = "\n".join([*lines, ""]).encode()
    try:
        with write_new_file(args.out) as file:
            archive(file, parts)
    except OSError as error:
        raise make_write_error(f"--out {args.out}", error, "choose another file") from error
    log.info("%s has %s: look at it before you send it", args.out, ", ".join(parts))
    return 0


def archive(file: Any, parts: Mapping[str, bytes]) -> None:
    """Write a gzipped tar of files by name, without owner and time."""
    with tarfile.open(fileobj=file, mode="w:gz") as tar:
        for name, data in parts.items():
            info = tarfile.TarInfo(f"softfinger-report/{name}")
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))


def redact_rig(rig: dict[str, Any]) -> dict[str, Any]:
    """Return the mapping of a rig without [security], and without folders and serial numbers in device options."""
    tables = rig | {key: privacy.redact_options(rig[key]) for key in ("device", "devices") if rig.get(key)}
    return {key: value for key, value in tables.items() if key != "security"}


def clean_recording(path: Path, cleaner: privacy.Redactor) -> bytes:
    """Return a black box file rewritten with the same ticks and cleaned texts. Raises RecordingError."""
    parts = list(read_contents(path))
    about = {part.name: part.value for part in parts if isinstance(part, Note)}
    if isinstance(about.get("rig"), dict):
        about["rig"] = redact_rig(about["rig"])
    fingers = list(dict.fromkeys(part.finger for part in parts if isinstance(part, TickBlock)))
    with tempfile.TemporaryFile(buffering=0) as file:
        copy = io.FileIO(file.fileno(), "wb", closefd=False)
        recording = RecordingFile(copy, fingers or [""], cleaner.clean(about))
        for part in parts:
            if isinstance(part, TickBlock):
                recording.ticks(part.records(), part.finger)
            elif isinstance(part, Event):
                recording.event(clean_event(part.event, cleaner))
        for line in log_lines(path, cleaner):
            recording.log(*line)
        recording.close()
        file.seek(0)
        return file.read()


def clean_event(event: dict[str, Any], cleaner: privacy.Redactor) -> dict[str, Any]:
    """Return an event with cleaned texts and a shortened serial number of the device."""
    clean: dict[str, Any] = cleaner.clean(event)
    return clean | ({"serial": privacy.shorten_serial(str(event["serial"]))} if "serial" in event else {})


def log_lines(path: Path, cleaner: privacy.Redactor) -> Iterator[tuple[float, int, str, str]]:
    """Yield the cleaned lines of the log in a black box file."""
    with open_input(path) as file:
        for schema, _, message in iter_mcap_messages(file, LOG_TOPIC):
            line = load_message_class(schema.data, schema.name).FromString(message.data)
            time_s = message.log_time / 1e9
            yield time_s, LEVEL_STEP * line.level, line.name, cleaner.text(line.message)


def _to_json(value: Any) -> bytes:
    return (json.dumps(value, indent=2, default=str) + "\n").encode()
