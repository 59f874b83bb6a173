"""Files of poses for the replay device: a table in CSV, or complete records in MCAP."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from softfinger.config.arrays import Array
from softfinger.config.errors import ConfigError, RecordingError
from softfinger.config.files import open_recording
from softfinger.drivers.poses import POSE_COLUMNS
from softfinger.proxy.record import AT
from softfinger.server.recording.reader import translate_errors
from softfinger.server.recording.writer import RecordingFile

POSE: Final = slice(AT.probe_position, AT.probe_position + len(POSE_COLUMNS) - 1)
"""Columns of a record with position and orientation."""
_LINE: Final = ",".join(["%.17g"] * len(POSE_COLUMNS)) + "\n"  # 17 digits reproduce every float64


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

    def add(self, times: Array, records: Array) -> None:
        """Write the poses of records (n, RECORD_SIZE) at times (n,), s."""
        for t, pose in zip(times.tolist(), records[:, POSE].tolist(), strict=True):
            self._write(_LINE % (t, *pose))
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
    """MCAP file with complete records on topic `contact`, at the wall clock's time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with translate_errors(path):
            file = open_recording(path)
            try:
                self._recording = RecordingFile(file, with_pictures=False)
            except OSError:
                path.unlink(missing_ok=True)
                raise

    def add(self, times: Array, records: Array) -> None:
        """Write records (n, RECORD_SIZE)."""
        with translate_errors(self._path):
            self._recording.ticks(records)

    def close(self) -> None:
        try:
            with translate_errors(self._path):
                self._recording.close()
        finally:
            if not self._recording.count():
                self._path.unlink(missing_ok=True)


PosesFile = CsvPoses | McapPoses


def open_poses_file(path: Path) -> PosesFile:
    """Open a file of the type given by its suffix; raises ConfigError for other suffixes."""
    match path.suffix.lower():
        case ".csv":
            return CsvPoses(path)
        case ".mcap":
            return McapPoses(path)
    raise ConfigError(f"{path}: the name of a recording must end in .csv or .mcap")
