"""Page of a recording: loading, playback and seeking."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import reduce
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.config.errors import ConfigError, RecordingError
from softfinger.config.load import build, load_scene
from softfinger.proxy.pictures import Filed, make_picture
from softfinger.proxy.record import AT
from softfinger.server.offline.simulate import run_recording
from softfinger.server.recording.contents import read_recording
from softfinger.server.recording.reader import End, Event, Note, RecordedWorld, TickBlock, explain_no_tick
from softfinger.server.surface_meshes import SurfaceMesh
from softfinger.server.viewer.displayed import find_low_dof_devices
from softfinger.server.viewer.driven import DrivenPoses, RecordedBodies
from softfinger.server.viewer.inputs import is_in_list, is_on_slider
from softfinger.server.viewer.nodes.bodies import SceneStart
from softfinger.server.viewer.page import Page, parse_scene_start
from softfinger.server.viewer.timeline import Events, format_band, format_pointer

log: Final = logging.getLogger(__name__)

TRACE_TICKS: Final = 2000
"""Ticks before the new position that are drawn as a trace after a seek."""
SPEEDS: Final = ("0.1", "0.25", "0.5", "1", "2")
EVENTS: Final = ("previous", "next")
DEFAULT_SCENE: Final = "paper-plane"


class LoadedRecording(NamedTuple):
    """Contents of a recording.

    fingers  records (n, RECORD_SIZE) by finger, of the same ticks
    events   in order of time
    worlds   messages of `world` in order of time
    notes    description of the daemon; empty if the file has none
    """

    fingers: dict[str, Array]
    scene: schema.Scene
    name: str
    rate_hz: float
    start: SceneStart
    events: tuple[dict[str, Any], ...] = ()
    worlds: tuple[dict[str, Any], ...] = ()
    notes: Mapping[str, Any] = MappingProxyType({})


def load(recording: str, scene: str | None) -> LoadedRecording:
    """Load a recording to show.

    Parameters
    ----------
    recording
        An .mcap; a .csv or .npz of results, or of poses, which are rendered first; or the name of a shipped recording.
    scene
        Scene that replaces the recording's; None: the recording's, or `paper-plane` for poses.

    Raises
    ------
    RecordingError, ConfigError
        If the recording or the scene cannot be read, or their fingers differ.
    """
    blocks: dict[str, list[TickBlock]] = {}
    notes: dict[str, Any] = {}
    events: list[dict[str, Any]] = []
    worlds: list[dict[str, Any]] = []
    end = End([], "")
    for part in read_recording(recording):
        match part:
            case TickBlock():
                blocks.setdefault(part.finger, []).append(part)
            case Note():
                notes[part.name] = part.value
            case Event():
                events.append(part.event)
            case RecordedWorld():
                worlds.append(part.world)
            case End():
                end = part
    if not blocks:
        raise RecordingError(f"{recording}: {explain_no_tick(end)}")
    if end.cut:
        log.warning("%s is incomplete: %s", recording, end.cut)
    if next(iter(blocks.values()))[0].column("force") is None:  # poses
        fingers = {"": np.asarray(run_recording(recording, scene or DEFAULT_SCENE))}
    else:
        fingers = {name: np.concatenate([part.records() for part in parts]) for name, parts in blocks.items()}
        common = reduce(np.intersect1d, [rows[:, AT.tick] for rows in fingers.values()])
        fingers = {name: rows[np.isin(rows[:, AT.tick], common)] for name, rows in fingers.items()}
        count = min(map(len, fingers.values()))
        if not count:
            raise RecordingError(f"{recording}: its fingers {sorted(fingers)} have no tick in common")
        fingers = {name: rows[:count] for name, rows in fingers.items()}
    if scene is None and "scene" in notes:
        rendered_scene = build(schema.Scene, notes["scene"], f"{recording}: scene")
    else:
        rendered_scene = load_scene(scene or DEFAULT_SCENE)
    names = {scene_finger.name for scene_finger in rendered_scene.fingers}
    if names != set(fingers) and not (len(names) == 1 and set(fingers) == {""}):
        raise RecordingError(
            f"{recording}: has fingers {sorted(fingers)}, but the scene has {sorted(names)}: add its --scene"
        )
    rate_hz, name = float(notes.get("rate_hz", 1000.0)), str(notes.get("scene_name", scene or DEFAULT_SCENE))
    start = _find_scene_start(notes, fingers, rate_hz)
    return LoadedRecording(fingers, rendered_scene, name, rate_hz, start, tuple(events), tuple(worlds), notes)


def _find_scene_start(notes: dict[str, Any], fingers: dict[str, Array], rate_hz: float) -> SceneStart:
    """Return the start of the scene: as the daemon described it, else at the first tick."""
    if "since_missed" in notes:
        return parse_scene_start(notes)
    first = next(iter(fingers.values()))[0]
    return SceneStart(int(first[AT.tick]), int(first[AT.servo_missed]), 1.0 / rate_hz, own_clock=False)


class Player:
    """Playback controls: play, pause, seek, and jump between events."""

    def __init__(self, gui: Any, recording: LoadedRecording, tick: int) -> None:
        self._fingers, self._rate_hz = recording.fingers, recording.rate_hz
        self._count = len(next(iter(self._fingers.values())))
        self._last_drawn, self._row = -TRACE_TICKS, float(min(max(tick, 0), self._count - 1))
        self._events = Events(recording.fingers, recording.events, recording.rate_hz)
        end = (self._count - 1) / self._rate_hz
        self._slider = gui.add_slider("time, s", 0.0, max(end, 1e-9), 1.0 / self._rate_hz, self._row / self._rate_hz)
        self._slider.on_update(self._on_slider)
        self._time = gui.add_markdown("")
        self._play = gui.add_checkbox("play", False)
        self._speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        self._pointer = gui.add_html(format_pointer(0.0))
        radii = {finger.name: max(finger.radii_m or (finger.radius_m,)) for finger in recording.scene.fingers}
        if len(radii) == 1:  # the records may have another name for a single finger
            radii = dict.fromkeys(recording.fingers, next(iter(radii.values())))
        gui.add_html(format_band(recording.fingers, radii))
        gui.add_button_group("event", EVENTS).on_click(self._on_event_button)
        self._event_list = gui.add_html("")

    def _on_slider(self, event: Any) -> None:
        if event.client is not None and is_on_slider(self._slider):
            self._row = float(min(round(self._slider.value * self._rate_hz), self._count - 1))

    def _on_event_button(self, event: Any) -> None:
        find_event = self._events.before if event.target.value == EVENTS[0] else self._events.after
        row = find_event(int(self._row))
        if row is not None:
            self._seek(float(row))

    def _seek(self, row: float) -> None:
        self._row = row
        self._slider.value = int(row) / self._rate_hz

    def advance(self, dt: float) -> None:
        """Advance the playback by `dt` s."""
        if self._play.value:
            row = self._row + dt * self._rate_hz * float(self._speed.value if is_in_list(self._speed) else 1.0)
            self._seek(row if row <= self._count - 1 else 0.0)

    def take_rows(self) -> tuple[dict[str, Array], bool]:
        """Return the records of each finger to draw next, empty if nothing changed, and whether they follow a seek."""
        current = int(self._row)
        if current == self._last_drawn:
            return {}, False
        is_seek = not 0 < current - self._last_drawn < TRACE_TICKS
        first = max(0, current - TRACE_TICKS) if is_seek else self._last_drawn + 1
        self._last_drawn = current
        self._time.content = f"{current / self._rate_hz:.3f} s of {(self._count - 1) / self._rate_hz:.3f} s"
        self._pointer.content = format_pointer(current / max(self._count - 1, 1))
        self._event_list.content = self._events.format_html(current)
        return {name: rows[first : current + 1] for name, rows in self._fingers.items()}, is_seek


class RecordedPage:
    """Data source of a page from a recording; call `step` for each frame."""

    def __init__(self, page: Page, recording: LoadedRecording, tick: int) -> None:
        self._page = page
        with page.tabs.add_tab("Recording"):
            self._player = Player(page.server.gui, recording, tick)
        page.add_views()
        page.change(recording.scene, recording.start, find_low_dof_devices(recording.notes))
        self._drives, self._worlds = DrivenPoses(recording.scene, recording.events), RecordedBodies(recording.worlds)
        for scene_index, obj in enumerate(recording.scene.object):
            if isinstance(obj, Filed):
                self._draw(scene_index, obj)
        names = list(page.fingers)
        self._names = dict(zip(recording.fingers, names, strict=True)) if len(names) == 1 else {n: n for n in names}

    def step(self, dt: float) -> None:
        """Advance the playback by `dt` s and draw."""
        self._player.advance(dt)
        ticks, is_seek = self._player.take_rows()
        if is_seek:
            self._page.clear_traces()
        for rows in list(ticks.values())[:1]:
            tick = int(rows[-1, AT.tick])
            for scene_index, pose in self._drives.at(tick).items():
                self._page.drive(scene_index, *pose)
            self._page.move_bodies(self._worlds.at(tick))
        self._page.show({self._names[name]: rows for name, rows in ticks.items()})

    def _draw(self, scene_index: int, obj: Filed) -> None:
        """Draw the triangles of an object from a file, if the file exists."""
        try:
            vertices, triangles = make_picture(obj).arrays
        except ConfigError as error:
            self._page.show_message(str(error))
            return
        self._page.draw(scene_index, SurfaceMesh(vertices, triangles.astype(np.uint32)))

    def close(self) -> None:
        """Do nothing: there is nothing to close."""
