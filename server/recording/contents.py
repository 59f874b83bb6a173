"""Contents of a recording of any kind: .mcap, a table of results or of poses, or a shipped one by its name."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from softfinger.drivers.poses import find_recording, load_poses
from softfinger.server.recording.layout import TickField, make_tick_layout
from softfinger.server.recording.reader import End, Event, Note, RecordedWorld, TickBlock, read_contents
from softfinger.server.recording.results import NoResults, list_fingers, read_results

POSE_PARTS: Final = [
    TickField("timestamp", 1, False, 0),
    TickField("tick", 1, True, 1),
    TickField("probe.position", 3, False, 2),
    TickField("probe.orientation", 4, False, 5),
]
"""Columns of poses, named as in results, which every verb reads as poses."""


def read_recording(recording: str | Path) -> Iterator[TickBlock | Event | RecordedWorld | Note | End]:
    """Yield the contents of a recording as `read_contents` does; poses are those of one finger.

    Raises
    ------
    RecordingError
        If `recording` is neither a file nor a shipped recording, or if the file cannot be read.
    """
    path = find_recording(recording)
    if path.suffix.lower() in (".csv", ".npz"):
        if fingers := list_fingers(path):
            parts = make_tick_layout().parts
            yield from (TickBlock(finger, parts, read_results(path, finger)) for finger in fingers)
        else:
            yield _read_table(path)
        yield End([], "")
    else:
        yield from read_contents(path)


def _read_table(path: Path) -> TickBlock:
    try:
        return TickBlock("", make_tick_layout().parts, read_results(path))
    except NoResults:  # poses, or an invalid file
        poses = load_poses(path)
        numbers = np.arange(len(poses.t))
        return TickBlock("", POSE_PARTS, np.column_stack((poses.t, numbers, poses.position, poses.orientation)))
