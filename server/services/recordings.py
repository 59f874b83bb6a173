"""Recordings, written outside the loop: one at a time, from the start or by command; and the black box.

The black box is always on and writes a file of the last ten seconds at every fault.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import ConfigError, Exhausted, RecordingError
from softfinger.config.files import open_recording
from softfinger.proxy.record import RECORD_SIZE
from softfinger.server.loop.clock import NS_PER_S
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.recording.blackbox import BlackBox, find_folder, format_file_name, prepare_folder
from softfinger.server.recording.reader import translate_errors
from softfinger.server.recording.recorder import Recorder, RecorderState
from softfinger.server.services.base import Worker
from softfinger.server.services.description import describe_daemon
from softfinger.server.services.records import Sink
from softfinger.server.services.rendering import Rendering

log: Final = logging.getLogger(__name__)

SUFFIX: Final = ".mcap"
STOP_S: Final = 0.5
"""Time for which the answer to `record_stop` waits for the disk."""
CLOSE_S: Final = 2.0
"""Time for which the end of the run waits for the disk."""
OPEN_S: Final = 2.0
"""Time for which the start of a recording waits for the disk: a network file system without a server never answers."""


class Recordings:
    """Service that starts, feeds and ends recordings of a daemon."""

    def __init__(self, rendering: Rendering, fingers: Sequence[str], event: Callable[..., Any]) -> None:
        self._rendering, self._fingers, self._event = rendering, list(fingers), event
        self._changing = threading.Lock()
        self._recorder: Recorder | None = None
        self._ending: list[Recorder] = []  # recordings with a last part that may not be on disk yet
        self._ended = RecorderState()
        self._path = Path()
        """File of the latest recording."""
        self._opened: Future[IO[bytes]] | None = None
        """Latest file that was opened; not done if its disk does not answer."""
        self._failure: RecordingError | None = None
        self._settings: Any = None
        self.sink: Final = Sink("recordings", self._add_records)

    def start(self) -> None:
        """Do nothing: a recording starts on request."""

    def stop(self) -> None:
        """End the recording; raises RecordingError, once, if a recording of this run failed."""
        with self._changing:
            if self._recorder is not None:
                self._recorder.stop(CLOSE_S)
            failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def record(self, path: str | Path, scene_name: str) -> None:
        """Record into a new file chosen by the user of the daemon; raises RecordingError if it cannot be created."""
        self._begin(Path(path), None, scene_name)

    def begin(self, name: str, scene_name: str) -> Path:
        """Record into a new file in the rig's folder of recordings, at the request of a client; return its path.

        Raises RecordingError if a recording is running, or if the name leads outside the folder or to an existing file.
        """
        return self._begin(Path(name), Path(self._rendering.rig.recording.directory), scene_name)

    def end(self) -> tuple[Path, RecorderState]:
        """End the recording; return its file and its statistics. Raises RecordingError if none is running."""
        with self._changing:
            if self._recorder is None:
                raise RecordingError("nothing is being recorded")
            recorder, self._recorder = self._recorder, None
            self._ending.append(recorder)
            return self._path, recorder.stop(STOP_S)

    def last_written_tick(self) -> int:
        """Return the last tick in the file of the current recording, -1 for none.

        Raises RecordingError if the recording has failed or none is running, Exhausted if the disk is full. The caller
        reports it, so `stop` does not.
        """
        with self._changing:
            recorder = self._recorder
            if recorder is None:
                raise RecordingError("nothing is being recorded")
            if error := (recorded := recorder.recorded).error:
                self._failure = None
                kind = Exhausted if recorder.is_disk_full else RecordingError
                raise kind(f"{self._path}: the recording ends after {recorded.ticks} ticks: {error}")
            return recorder.last_written_tick

    def collect_totals(self) -> RecorderState:
        """Return the statistics of all recordings of this run so far."""
        with self._changing:
            recorders, self._ending = self._ending, []
            for recorder in recorders:
                recorded = recorder.recorded
                if recorded.whole or recorded.error:
                    self._ended = self._ended.with_recording(recorded)
                else:
                    self._ending.append(recorder)
            total = self._ended
            for recorder in (*self._ending, *filter(None, [self._recorder])):
                total = total.with_recording(recorder.recorded)
        return total

    def record_event(self, event: dict[str, Any]) -> None:
        """Record a published event; callable from any thread."""
        if (recorder := self._recorder) is not None:
            recorder.event(event)

    def record_message(self, topic: str, message: dict[str, Any]) -> None:
        """Record a published message of one of SCENE_TOPICS; callable from any thread."""
        if (recorder := self._recorder) is not None:
            recorder.message(topic, message)

    def note_settings(self, settings: Any) -> None:
        """Record the real-time settings granted by the machine, plain values; called after the servo has started."""
        self._settings = settings
        if (recorder := self._recorder) is not None:
            recorder.note("settings", settings)

    def _begin(self, path: Path, folder: Path | None, scene_name: str) -> Path:
        if path.suffix.lower() != SUFFIX:
            raise RecordingError(f"{path}: a recording is an MCAP file: its name must end in {SUFFIX}")
        with self._changing:
            if self._recorder is not None and not self._recorder.recorded.error:
                raise RecordingError(f"{self._path} is being recorded: stop that first")
            file = self._open(path, folder)
            about = describe_daemon(self._rendering, scene_name)
            if self._settings is not None:
                about["settings"] = self._settings
            path = (folder / path if folder is not None else path).absolute()
            recorder = Recorder(file, self._fingers, about, partial(self._report_trouble, path), GUARD_NAMES)
            if self._recorder is not None:
                self._ending.append(self._recorder)
            self._recorder, self._path = recorder, path
            return path

    def _open(self, path: Path, folder: Path | None) -> IO[bytes]:
        """Open a new file in another thread; raises RecordingError if this fails or takes longer than OPEN_S."""
        if self._opened is not None and not self._opened.done():
            raise RecordingError(f"{path}: cannot be opened, because the disk of an earlier recording does not answer")
        opened = Future[IO[bytes]]()

        def open_file() -> None:
            try:
                opened.set_result(_open_new_file(path, folder))
            except Exception as error:
                opened.set_exception(error)

        threading.Thread(target=open_file, name="opening", daemon=True).start()
        self._opened = opened
        try:
            return opened.result(OPEN_S)
        except TimeoutError:
            opened.add_done_callback(_discard)
            raise RecordingError(
                f"{path}: cannot be opened, because its disk did not answer for {OPEN_S:g} s: nothing is recorded; "
                "choose another disk"
            ) from None

    def _add_records(self, records: NDArray[np.float64], drops: int) -> None:
        if (recorder := self._recorder) is not None:
            fingers = records.reshape(len(records), -1, RECORD_SIZE)
            for index, finger in enumerate(self._fingers):
                recorder.ticks(fingers[:, index], finger)

    def _report_trouble(self, path: Path, message: str, ended: bool) -> None:
        text = f"{path}: {message}"
        if ended and self._failure is None:
            self._failure = RecordingError(text)
        log.error("%s", text)
        self._event("fault", "recording", message=text)


def _open_new_file(path: Path, folder: Path | None) -> IO[bytes]:
    try:
        with translate_errors(path):
            return open_recording(path, folder)
    except ValueError as error:
        raise RecordingError(f"{path}: cannot be written: {error}") from error


def _discard(opened: Future[IO[bytes]]) -> None:
    """Remove a file that was opened too late."""
    if opened.exception() is None:
        with opened.result() as file, contextlib.suppress(OSError):
            os.unlink(file.name)


POLL_S: Final = 0.1
TIME_AFTER_FAULT_S: Final = 0.5
"""Time after a fault that is also included in its file."""
MIN_INTERVAL_S: Final = 5.0
"""Minimum time between files; faults at shorter intervals share a file."""


class BlackBoxes(Worker):
    """Service that stores the latest records and events, and writes them to a file after a fault.

    No thread waits for it.

    servo     source of the ticks
    fingers   names of several fingers, an empty name for a single one
    describe  returns the description of the run, for the file
    """

    def __init__(self, servo: ServoThread, fingers: Sequence[str], describe: Callable[[], Mapping[str, Any]]) -> None:
        super().__init__("blackbox")
        self._describe = describe
        self.box: Final = BlackBox(fingers, GUARD_NAMES, NS_PER_S / servo.period_ns)
        self.sink: Final = Sink("blackbox", lambda records, drops: self.box.take(records))
        self._due: tuple[float, Path] | None = None
        self._written_s = -MIN_INTERVAL_S
        self._number = 0
        self._lock = threading.Lock()
        logging.getLogger().addHandler(self.box.log)

    def stop(self) -> None:
        super().stop()
        logging.getLogger().removeHandler(self.box.log)

    def schedule_file(self, fault: str) -> str:
        """Return the file that will contain a present fault; empty if none can be created. Callable from any thread."""
        with self._lock:
            if self._due is None:
                directory = find_folder()
                if directory is None:
                    return ""
                self._number += 1
                self._due = time.monotonic() + TIME_AFTER_FAULT_S, directory / format_file_name(fault, self._number)
            return str(self._due[1])

    def work(self) -> None:
        while not self.closing.wait(POLL_S):
            self._write_due()
        self._write_due(last=True)

    def handle_failure(self, error: Exception) -> None:
        """Log the error; the run continues, because the black box only serves later analysis."""
        log.error("the black box has stopped: %s", error)

    def _write_due(self, last: bool = False) -> None:
        due, now = self._due, time.monotonic()
        if due is None or not (last or now >= max(due[0], self._written_s + MIN_INTERVAL_S)):
            return
        with self._lock:
            path, self._due = due[1], None
        self._written_s = now
        try:
            prepare_folder(path.parent)
            self.box.write(path, self._describe())
        except (OSError, ConfigError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            log.warning("the black box %s cannot be written: %s", path, reason)
            return
        log.info("the last 10 s are in %s", path)
