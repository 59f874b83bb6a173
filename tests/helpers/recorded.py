"""Recordings of a short run, made without a daemon."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from softfinger.config.load import describe, load_rig, load_scene
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.record import AT
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.simulate import simulate
from softfinger.server.recording.writer import RecordingFile

SCENE = "paper-plane"
EPOCH_S = 1_700_000_000.0


@cache
def run() -> np.ndarray:
    """Return records of three taps with pauses as a daemon makes them, 2281 ticks at 1 kHz."""
    tuning = make_tuning(load_scene(SCENE), load_rig("replay").guard)
    records = simulate(tuning, resample(load_poses("tap"), 1000.0), 1000.0)
    records[:, AT.timestamp] += EPOCH_S
    return records


def about(**changes: Any) -> dict[str, Any]:
    header = {"scene": describe(load_scene(SCENE)), "rig": describe(load_rig("replay")), "scene_name": SCENE}
    return header | {"rate_hz": 1000.0} | changes


def recorded(path: Path, records: np.ndarray, events: list[dict[str, Any]] = (), **changes: Any) -> Path:
    recording = RecordingFile(path.open("wb", buffering=0), ("",), about(**changes))
    recording.ticks(records)
    for event in events:
        recording.event(event)
    recording.close()
    return path


def event(kind: str, name: str, tick: int, **fields: Any) -> dict[str, Any]:
    return {"schema": 1, "timestamp": EPOCH_S + tick / 1000.0, "tick": tick, "kind": kind, "name": name} | fields


def printed(text: str) -> Any:
    return json.loads(next(line for line in text.splitlines() if line.startswith("{")))
