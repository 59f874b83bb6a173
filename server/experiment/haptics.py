"""Touches on a running daemon, by commands and telemetry: each ramps up from zero force and ends at zero force."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.errors import Exhausted, RecordingError, SafetyStop
from softfinger.config.load import describe, load_scene
from softfinger.config.overrides import find_value, to_indexed_key
from softfinger.config.schema import Scene
from softfinger.server.experiment.hands import Hands, compute_angle
from softfinger.server.experiment.interfaces import Stimulus, TouchResult
from softfinger.server.experiment.parameters import load_changed_scene, split_masses, split_rig
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.loop.guard import DISARMED
from softfinger.server.remote import Client
from softfinger.server.wire.client import Sample, Subscription
from softfinger.server.wire.protocol import CONTACT, FINGERS, find_finger

POLL_S: Final = 0.02
"""Duration of a single wait for telemetry, between which other conditions are checked."""
ZERO_FORCE_TIMEOUT_S: Final = 5.0
"""Timeout for zero force. The guard removes the force in milliseconds; a ramp of parameters takes at most 10 s."""
START_TIMEOUT_S: Final = 2.0
START_TOLERANCE_M: Final = 0.002
START_TOLERANCE_RAD: Final = 0.03
"""Tolerances of a led hand at the start of a touch, and its timeout: a spring holds the hand, so it sags."""
HEARTBEAT_S: Final = 0.1
DISK_TIMEOUT_S: Final = 30.0
"""Timeout for writing the ticks of a touch to disk; shorter than the time that the recorder can buffer in memory."""
REPEAT_REMEDY: Final = (
    ": the force is off, and all earlier answers are stored: make room on the disk and repeat the command, which "
    "presents this trial again"
)
"""Remedy if the recording lacks the ticks of a trial."""
REMOVED_REMEDY: Final = (
    ": all earlier answers are stored: find the cause in the events of the recording, then repeat the command, which "
    "presents this trial again"
)


class Haptics:
    """Presents stimuli on a daemon.

    scene_of            returns the source of a scene that the experiment names
    check_running       raises the error of a failed daemon, or Stopped on request
    change_rig          resumes the daemon, from zero force, with these values of the rig, and the file's for other keys
    last_recorded_tick  returns the last recorded tick; raises RecordingError or Exhausted if the recording stopped
    """

    def __init__(
        self,
        client: Client,
        experiment: ExperimentFile,
        scene_of: Callable[[str], str | Path],
        check_running: Callable[[], None],
        change_rig: Callable[[Mapping[str, Any]], Any],
        last_recorded_tick: Callable[[], int],
    ) -> None:
        self.client: Final = client
        self._experiment, self._scene_of, self._check_running = experiment, scene_of, check_running
        self._change_rig: Final = change_rig
        self._last_recorded_tick: Final = last_recorded_tick
        self._rig, self._set_values = split_rig(experiment.overrides, "overrides")
        self._scene: str | None = None
        self.latest: dict[str, Sample] = {}
        """Latest tick of each finger, by name."""
        self._last_heartbeat_s = 0.0
        self._touch_ticks: list[dict[str, Any]] | None = None
        self.samples: Final[Subscription] = client.subscribe((CONTACT, FINGERS))
        self._wait_until(lambda: bool(self.latest), "there is no tick")
        self._hands: Final = Hands(client, experiment)

    # --- a touch ----------------------------------------------------------------------------------------

    def touch(self, stimulus: Stimulus) -> TouchResult:
        """Present a stimulus, which is changed at zero force; if only values change, nothing is compiled.

        Raises RecordingError or Exhausted if its ticks are not in the recording, because such a trial must not be
        answered.
        """
        client = self.client
        self._read_recorded_tick()
        self.release()
        ramp_s = self._change(stimulus)
        self._lead_to_start(max(self._experiment.trial.gap_s, ramp_s))
        client.mark("touch", {"trial": stimulus.trial, "touch": stimulus.touch, "changes": stimulus.changes})
        self._touch_ticks = []
        try:
            client.arm()
            start_s = time.monotonic()
            reached_s = self._run_touch(start_s)
            client.mark("release", {"trial": stimulus.trial, "touch": stimulus.touch})
            self.release()
        finally:
            ticks, self._touch_ticks = self._touch_ticks, None
        self._wait_for_disk(ticks)
        return TouchResult(_summarize(ticks, reached_s), ticks)

    def release(self) -> None:
        """Remove the force, and wait until it is zero."""
        self.client.disarm()
        ticks = {name: sample.tick for name, sample in self.latest.items()}
        self._wait_until(
            lambda: all(
                sample.tick > ticks.get(name, -1) and not any(sample.data.force) for name, sample in self.latest.items()
            ),
            "the force does not become zero",
        )

    def _read_recorded_tick(self) -> int:
        """Return the last recorded tick; raise its error with the remedy if the recording stopped."""
        try:
            return self._last_recorded_tick()
        except (RecordingError, Exhausted) as error:
            raise type(error)(f"{error}{REPEAT_REMEDY}") from error

    def _wait_for_disk(self, ticks: list[dict[str, Any]]) -> None:
        """Wait until the ticks are recorded, at most DISK_TIMEOUT_S for a disk that stalls."""
        until = time.monotonic() + DISK_TIMEOUT_S
        while ticks and self._read_recorded_tick() < ticks[-1]["tick"]:
            if time.monotonic() > until:
                raise RecordingError(
                    f"the ticks of the touch were not written to disk within {DISK_TIMEOUT_S:g} s{REPEAT_REMEDY}"
                )
            self.wait(POLL_S)

    def _change(self, stimulus: Stimulus) -> float:
        """Apply scene and parameters of a stimulus; return the duration of the ramp, s.

        Calls set_scene for another scene, for masses and materials by name, and to remove a parameter that the scene
        does not have; otherwise set_params.
        """
        name = stimulus.scene or self._experiment.scene
        rig_values, new_values = split_rig(self._experiment.overrides | stimulus.changes, f"trial {stimulus.trial}")
        if rig_values != self._rig:
            self._change_rig(rig_values)
            self._rig = rig_values
        restored = (
            self._read_scene_values(name, self._set_values.keys() - new_values.keys())
            if stimulus.scene == self._scene
            else {}
        )
        changed = {
            path: value for path, value in (new_values | restored).items() if self._set_values.get(path) != value
        }
        ramp_s = 0.0
        needs_scene = None in restored.values() or any(isinstance(value, str | dict) for value in changed.values())
        if stimulus.scene != self._scene or needs_scene or split_masses(changed)[0]:
            scene = load_changed_scene(self._scene_of(name), new_values, f"trial {stimulus.trial}")
            self.client.set_scene(to_file_mapping(scene), name=Path(name).stem[:64])
            self._hands.update()
        elif changed:
            ramp_s = self.client.set_params(changed).ramp_s
        self._scene, self._set_values = stimulus.scene, new_values
        return ramp_s

    def _read_scene_values(self, name: str, paths: Iterable[str]) -> dict[str, Any]:
        """Return the values in the scene's file, None for missing ones."""
        scene = describe(load_scene(self._scene_of(name)))
        return {path: find_value(scene, to_indexed_key(scene, path)) for path in paths}

    def _lead_to_start(self, seconds: float) -> None:
        starts = self._hands.lead_to_start()
        until = time.monotonic() + START_TIMEOUT_S
        self.wait(seconds)
        while time.monotonic() < until and not all(
            math.dist(self.latest[name].data.probe.position, position) <= START_TOLERANCE_M
            and (
                orientation is None
                or compute_angle(self.latest[name].data.probe.orientation, orientation) <= START_TOLERANCE_RAD
            )
            for name, (position, orientation) in starts.items()
        ):
            self.wait(POLL_S)

    def _run_touch(self, start_s: float) -> float | None:
        """Run a touch and lead hands along their paths; return when a target was reached, s from `start_s`, or None.

        Raises SafetyStop if the force is removed, for example because the process of commands has ended.
        """
        experiment, task, was_on = self._experiment, self._experiment.task, False
        while (elapsed_s := time.monotonic() - start_s) < experiment.trial.touch_s:
            self._hands.lead(elapsed_s)
            self._read_recorded_tick()  # end a long touch early if its recording failed
            self.wait(POLL_S)
            is_on = not any(sample.data.servo.guard & DISARMED for sample in self.latest.values())
            if was_on and not is_on:
                raise SafetyStop(f"the force was removed during the touch{REMOVED_REMEDY}")
            was_on = is_on
            positions = [sample.data.probe.position for sample in self.latest.values()]
            target = task.target_m
            if target is not None and any(math.dist(place, target) <= task.target_radius_m for place in positions):
                return time.monotonic() - start_s
        return None

    # --- telemetry --------------------------------------------------------------------------------------

    def wait(self, seconds: float) -> None:
        """Receive telemetry for a time, and send heartbeats."""
        until = time.monotonic() + seconds
        while True:
            now = time.monotonic()
            if now - self._last_heartbeat_s > HEARTBEAT_S:
                self._check_running()
                self.client.heartbeat()
                self._last_heartbeat_s = now
            sample = self.samples.receive(max(0.0, min(until - now, HEARTBEAT_S)))
            if sample is not None:
                self._store(sample)
            elif now >= until:
                return
            if now >= until + POLL_S:  # telemetry arrives faster than it is processed; lost ticks show it
                return

    def _wait_until(self, condition: Callable[[], bool], fault: str) -> None:
        until = time.monotonic() + ZERO_FORCE_TIMEOUT_S
        while not condition():
            self.wait(POLL_S)
            if time.monotonic() > until:
                raise SafetyStop(f"{fault} within {ZERO_FORCE_TIMEOUT_S:g} s: the session ends")

    def _store(self, sample: Sample) -> None:
        name = find_finger(sample.topic)
        if name is None:
            return
        self.latest[name] = sample
        if self._touch_ticks is not None:
            self._touch_ticks.append(_make_row(name, sample))


def to_file_mapping(scene: Scene) -> dict[str, Any]:
    """Return the mapping of a scene as in its file: without the objects that loading adds for a [world]."""
    mapping = describe(scene)
    if scene.world is not None:
        mapping["object"] = [obj for obj in mapping["object"] if (obj.get("motion") or {}).get("kind") != "body"]
    return mapping


def _make_row(finger: str, sample: Sample) -> dict[str, Any]:
    tick = sample.data
    (x, y, z), (fx, fy, fz) = tick.probe.position, tick.force
    return {
        "finger": finger, "tick": tick.tick, "timestamp": tick.timestamp, "x_m": x, "y_m": y, "z_m": z,
        "fx_n": fx, "fy_n": fy, "fz_n": fz, "mode": tick.contact.mode, "object": tick.contact.object,
        "penetration_m": tick.contact.penetration, "buttons": tick.buttons, "lost": sample.lost,
    }  # fmt: skip


def _summarize(ticks: list[dict[str, Any]], reached_s: float | None) -> dict[str, Any]:
    """Return the columns of a touch for the table: forces over all fingers, and the path of the first one."""
    if not ticks:
        return {}
    force = np.array([[tick["fx_n"], tick["fy_n"], tick["fz_n"]] for tick in ticks])
    first = [tick for tick in ticks if tick["finger"] == ticks[0]["finger"]]
    path = np.array([[tick["x_m"], tick["y_m"], tick["z_m"]] for tick in first])
    norm = np.linalg.norm(force, axis=1)
    touching = norm > 0.0
    return {
        "first_tick": first[0]["tick"],
        "last_tick": first[-1]["tick"],
        "lost_ticks": sum(tick["lost"] for tick in first),
        "peak_force_n": float(norm.max()),
        "mean_force_n": float(norm[touching].mean()) if touching.any() else 0.0,
        "path_m": float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
        "duration_s": float(first[-1]["timestamp"] - first[0]["timestamp"]) if reached_s is None else reached_s,
        "reached": reached_s is not None,
    }
