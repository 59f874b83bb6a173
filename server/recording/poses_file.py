"""Files of poses for the replay device: a table in CSV, or complete records in MCAP."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from softfinger.config.errors import ConfigError
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
    """CSV file with the columns `t,x,y,z,qw,qx,qy,qz`; reading gives bit-identical numbers."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with translate_errors(path):
            self._file = io.BufferedWriter(open_recording(path))
            self._file.write((",".join(POSE_COLUMNS) + "\n").encode())

    def add(self, t: float, sample: Sample) -> None:
        with translate_errors(self._path):
            self._file.write((_LINE % (t, *sample.probe.position, *sample.probe.orientation)).encode())

    def close(self) -> None:
        with translate_errors(self._path):
            self._file.close()


class McapPoses:
    """MCAP file with complete records on topic `contact`, written in blocks with the wall clock's time."""

    BLOCK: Final = 256

    def __init__(self, path: Path) -> None:
        with translate_errors(path):
            self._results = McapResults(path, open_recording(path))
        self._rows: list[list[float]] = []

    def add(self, t: float, sample: Sample) -> None:
        self._rows.append(record_of(sample))
        if len(self._rows) == self.BLOCK:
            self._flush()

    def close(self) -> None:
        self._flush()
        self._results.close()

    def _flush(self) -> None:
        if self._rows:
            self._results.append(np.array(self._rows))
            self._rows.clear()


def poses_file(path: Path) -> PosesFile:
    """Open a file of the type given by its suffix; raises ConfigError for other suffixes."""
    kinds: dict[str, Any] = {".csv": CsvPoses, ".mcap": McapPoses}
    if path.suffix.lower() not in kinds:
        raise ConfigError(f"--poses {path}: poses are recorded as {' or '.join(SUFFIXES)}")
    file: PosesFile = kinds[path.suffix.lower()](path)
    return file
