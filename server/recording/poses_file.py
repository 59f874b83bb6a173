"""Files of poses for the replay device: a table in CSV, or complete records in MCAP."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from softfinger.config.errors import ConfigError, RecordingError
from softfinger.config.files import open_recording
from softfinger.drivers.poses import POSE_COLUMNS
from softfinger.server.recording.reader import translate_errors
from softfinger.server.recording.results import McapResults
from softfinger.server.wire.client import Sample, record_of

SUFFIXES: Final = (".csv", ".mcap")
_LINE: Final = ",".join(["%.17g"] * len(POSE_COLUMNS)) + "\n"  # 17 digits reproduce every float64


class PosesFile(Protocol):
    """File of poses: t (s), position (m) and orientation, with the message that they come from."""

    def add(self, t: float, sample: Sample) -> None: ...

    def close(self) -> None:
        """Write pending poses and close the file."""


class CsvPoses:
    """CSV file with the columns `t,x,y,z,qw,qx,qy,qz`; reading gives bit-identical numbers.

    Each line is written at once, so that a kill leaves no part of a line. A full disk leaves the lines before.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._size, self._lines = path, 0, 0
        with translate_errors(path):
            self._file = open_recording(path)
        try:
            self._write(",".join(POSE_COLUMNS) + "\n")
        except RecordingError:
            self.close()
            raise

    def add(self, t: float, sample: Sample) -> None:
        self._write(_LINE % (t, *sample.probe.position, *sample.probe.orientation))
        self._lines += 1

    def close(self) -> None:
        with translate_errors(self._path):
            self._file.close()
        if not self._lines:
            self._path.unlink(missing_ok=True)

    def _write(self, line: str) -> None:
        remaining = line.encode()
        size = self._size + len(remaining)
        with translate_errors(self._path):
            try:
                while remaining:
                    remaining = remaining[self._file.write(remaining) :]
            except OSError:
                os.ftruncate(self._file.fileno(), self._size)
                raise
        self._size = size


class McapPoses:
    """MCAP file with complete records on topic `contact`, written in blocks with the wall clock's time."""

    BLOCK: Final = 256

    def __init__(self, path: Path) -> None:
        self._path, self._rows = path, list[list[float]]()
        with translate_errors(path):
            file = open_recording(path)
        try:
            self._results = McapResults(path, file)
        except RecordingError:
            path.unlink(missing_ok=True)
            raise

    def add(self, t: float, sample: Sample) -> None:
        self._rows.append(record_of(sample))
        if len(self._rows) == self.BLOCK:
            self._flush()

    def close(self) -> None:
        try:
            self._flush()
            self._results.close()
        finally:
            if not self._results.count():
                self._path.unlink(missing_ok=True)

    def _flush(self) -> None:
        if self._rows:
            self._results.append(np.array(self._rows))
            self._rows.clear()


def open_poses_file(path: Path) -> PosesFile:
    """Open a file of the type given by its suffix; raises ConfigError for other suffixes."""
    kinds: dict[str, Any] = {".csv": CsvPoses, ".mcap": McapPoses}
    if path.suffix.lower() not in kinds:
        raise ConfigError(f"{path}: the name of a recording must end in {' or '.join(SUFFIXES)}")
    file: PosesFile = kinds[path.suffix.lower()](path)
    return file
