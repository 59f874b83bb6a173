"""Recording service: one recording at a time, from the start or by command, written outside the loop."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import RecordingError
from softfinger.config.files import open_recording
from softfinger.proxy.record import RECORD_SIZE
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.recording.reader import translate_errors
from softfinger.server.recording.recorder import Recorder, RecorderState
from softfinger.server.services.description import describe_daemon
from softfinger.server.services.records import Sink
from softfinger.server.services.rendering import Rendering

log: Final = logging.getLogger(__name__)

SUFFIX: Final = ".mcap"
STOP_S: Final = 0.5
"""Time for which the answer to `record_stop` waits for the disk."""
CLOSE_S: Final = 2.0
"""Time for which the end of the run waits for the disk."""


class Recordings:
    """Service that starts, feeds and ends recordings of a daemon."""

    def __init__(self, rendering: Rendering, fingers: Sequence[str], event: Callable[..., Any]) -> None:
        self._rendering, self._fingers, self._event = rendering, list(fingers), event
        self._changing = threading.Lock()
        self._recorder: Recorder | None = None
        self._ending: list[Recorder] = []  # recordings with a last part that may not be on disk yet
        self._ended = RecorderState()
        self._path = self._opening = Path()
        """File of the latest recording, and file that is opened, with `_changing` locked."""
        self._failure: RecordingError | None = None
        self._settings: Any = None
        self.sink: Final = Sink("recordings", self._add_records)

    def start(self) -> None:
        """Do nothing: a recording starts on request."""

    def stop(self) -> None:
        """End the recording; raises RecordingError, once, if a recording of this run failed or cannot be opened."""
        if not self._changing.acquire(timeout=CLOSE_S):
            raise RecordingError(
                f"{self._opening}: cannot be opened, because its disk does not answer: nothing was recorded there; "
                "choose another disk"
            )
        try:
            if self._recorder is not None:
                self._recorder.stop(CLOSE_S)
            failure, self._failure = self._failure, None
        finally:
            self._changing.release()
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

        Raises RecordingError if the recording has failed or none is running. The caller reports it, so `stop` does not.
        """
        with self._changing:
            recorder = self._recorder
            if recorder is None:
                raise RecordingError("nothing is being recorded")
            if error := (recorded := recorder.recorded).error:
                self._failure = None
                raise RecordingError(f"{self._path}: the recording ends after {recorded.ticks} ticks: {error}")
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
            self._opening = folder / path if folder is not None else path
            file = _open_new_file(path, folder)
            if self._recorder is not None:
                self._ending.append(self._recorder)
            about = describe_daemon(self._rendering, scene_name)
            if self._settings is not None:
                about["settings"] = self._settings
            self._path = self._opening.absolute()
            trouble = partial(self._report_trouble, self._path)
            self._recorder = Recorder(file, self._fingers, about, trouble, GUARD_NAMES)
            return self._path

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
