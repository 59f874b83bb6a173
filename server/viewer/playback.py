"""Page of a recording: loading, playback and seeking."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.errors import ConfigError, RecordingError
from softfinger.config.load import build, load_scene
from softfinger.proxy.pictures import Filed, picture_of
from softfinger.proxy.record import AT
from softfinger.server.offline.results import read_results
from softfinger.server.offline.simulate import run_recording
from softfinger.server.recording.reader import Event, Note, Ticks, World, contents
from softfinger.server.viewer.controls import on_list, on_slider
from softfinger.server.viewer.displayed import handles
from softfinger.server.viewer.driven import Drives, Worlds
from softfinger.server.viewer.nodes.bodies import Began
from softfinger.server.viewer.nodes.meshes import Mesh
from softfinger.server.viewer.page import Page, began_of
from softfinger.server.viewer.timeline import Events, band, pointer

Array = NDArray[np.float64]

BEFORE: Final = 2000
"""Ticks before the new position that are drawn as a trace after a seek."""
SPEEDS: Final = ("0.1", "0.25", "0.5", "1", "2")
EVENTS: Final = ("the one before", "the next")
DEFAULT_SCENE: Final = "paper-plane"


class Recording(NamedTuple):
    """Contents of a recording.

    fingers  records (n, RECORD_SIZE) by finger, the same number of each
    scene    rendered scene
    name     of the scene
    rate_hz  of the ticks
    began    start of the scene
    events   in order of time
    worlds   messages of `world` in order of time
    notes    description of the daemon; empty if the file has none
    """

    fingers: dict[str, Array]
    scene: schema.Scene
    name: str
    rate_hz: float
    began: Began
    events: tuple[dict[str, Any], ...] = ()
    worlds: tuple[dict[str, Any], ...] = ()
    notes: Mapping[str, Any] = MappingProxyType({})


def load(recording: str, scene: str | None) -> Recording:
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
    path = Path(recording)
    notes: dict[str, Any] = {}
    events: tuple[dict[str, Any], ...] = ()
    worlds: tuple[dict[str, Any], ...] = ()
    if path.suffix.lower() == ".mcap":
        fingers, notes, events, worlds = _mcap(path)
    elif path.suffix.lower() in (".csv", ".npz"):
        try:
            fingers = {"": read_results(path)}
        except RecordingError:  # no results: poses, or an invalid file
            fingers = {"": np.asarray(run_recording(path, scene or DEFAULT_SCENE))}
    else:
        fingers = {"": np.asarray(run_recording(recording, scene or DEFAULT_SCENE))}
    if scene is None and "scene" in notes:
        shown = build(schema.Scene, notes["scene"], f"{path}: scene")
    else:
        shown = load_scene(scene or DEFAULT_SCENE)
    named = {each.name for each in shown.fingers}
    if named != set(fingers) and not (len(named) == 1 and set(fingers) == {""}):
        raise RecordingError(f"{path}: has fingers {sorted(fingers)}, and the scene {sorted(named)}: give its --scene")
    rate = notes.get("rate_hz", 1000.0)
    name = str(notes.get("scene_name", scene or DEFAULT_SCENE))
    return Recording(fingers, shown, name, float(rate), _began(notes, fingers, float(rate)), events, worlds, notes)


def _began(notes: dict[str, Any], fingers: dict[str, Array], rate_hz: float) -> Began:
    """Return the start of the scene: as the daemon described it, else at the first tick."""
    if "since_missed" in notes:
        return began_of(notes)
    first = next(iter(fingers.values()))[0]
    return Began(int(first[AT.tick]), int(first[AT.servo_missed]), 1.0 / rate_hz, own_clock=False)


def _mcap(
    path: Path,
) -> tuple[dict[str, Array], dict[str, Any], tuple[dict[str, Any], ...], tuple[dict[str, Any], ...]]:
    blocks: dict[str, list[Array]] = {}
    notes: dict[str, Any] = {}
    events: list[dict[str, Any]] = []
    worlds: list[dict[str, Any]] = []
    for part in contents(path):
        if isinstance(part, Ticks):
            blocks.setdefault(part.finger, []).append(part.records())
        elif isinstance(part, Note):
            notes[part.name] = part.value
        elif isinstance(part, Event):
            events.append(part.event)
        elif isinstance(part, World):
            worlds.append(part.world)
    if not blocks:
        raise RecordingError(f"{path}: holds no tick")
    fingers = {name: np.concatenate(each) for name, each in blocks.items()}
    count = min(len(rows) for rows in fingers.values())
    return {name: rows[:count] for name, rows in fingers.items()}, notes, tuple(events), tuple(worlds)


class Player:
    """Playback controls: play, pause, seek, and jump between events."""

    def __init__(self, gui: Any, recording: Recording, tick: int) -> None:
        self._fingers, self._rate_hz = recording.fingers, recording.rate_hz
        self._count = len(next(iter(self._fingers.values())))
        self._shown, self._place = -BEFORE, float(min(max(tick, 0), self._count - 1))
        self._events = Events(recording.fingers, recording.events, recording.rate_hz)
        end = (self._count - 1) / self._rate_hz
        self._slider = gui.add_slider("time, s", 0.0, max(end, 1e-9), 1.0 / self._rate_hz, self._place / self._rate_hz)
        self._slider.on_update(self._scrubbed)
        self._time = gui.add_markdown("")
        self._play = gui.add_checkbox("play", False)
        self._speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        self._pointer = gui.add_html(pointer(0.0))
        gui.add_html(band(recording.fingers, _radii(recording)))
        gui.add_button_group("event", EVENTS).on_click(self._jumped)
        self._told = gui.add_html("")

    def _scrubbed(self, event: Any) -> None:
        if event.client is not None and on_slider(self._slider):
            self._place = float(min(round(self._slider.value * self._rate_hz), self._count - 1))

    def _jumped(self, event: Any) -> None:
        find = self._events.before if event.target.value == EVENTS[0] else self._events.after
        row = find(int(self._place))
        if row is not None:
            self._go(float(row))

    def _go(self, place: float) -> None:
        self._place = place
        self._slider.value = int(place) / self._rate_hz

    def advance(self, dt: float) -> None:
        """Advance the playback by `dt` s."""
        if self._play.value:
            place = self._place + dt * self._rate_hz * float(self._speed.value if on_list(self._speed) else 1.0)
            self._go(place if place <= self._count - 1 else 0.0)

    def take(self) -> tuple[dict[str, Array], bool]:
        """Return the records of each finger to draw next, empty if nothing changed, and whether they follow a seek."""
        here = int(self._place)
        if here == self._shown:
            return {}, False
        jumped = not 0 < here - self._shown < BEFORE
        first = max(0, here - BEFORE) if jumped else self._shown + 1
        self._shown = here
        self._time.content = f"{here / self._rate_hz:.3f} s of {(self._count - 1) / self._rate_hz:.3f} s"
        self._pointer.content = pointer(here / max(self._count - 1, 1))
        self._told.content = self._events.told(here)
        return {name: rows[first : here + 1] for name, rows in self._fingers.items()}, jumped


def _radii(recording: Recording) -> dict[str, float]:
    """Return the largest radius of each finger, m, by its name in the records."""
    radii = {finger.name: max(finger.radii_m or (finger.radius_m,)) for finger in recording.scene.fingers}
    return radii if len(radii) > 1 else dict.fromkeys(recording.fingers, next(iter(radii.values())))


class RecordedPage:
    """Data source of a page from a recording; call `step` for each frame."""

    def __init__(self, page: Page, recording: Recording, tick: int) -> None:
        self._page = page
        with page.tabs.add_tab("Recording"):
            self._player = Player(page.server.gui, recording, tick)
        page.add_views()
        page.change(recording.scene, recording.began, handles(recording.notes))
        self._drives, self._worlds = Drives(recording.scene, recording.events), Worlds(recording.worlds)
        for number, thing in enumerate(recording.scene.object):
            if isinstance(thing, Filed):
                self._draw(number, thing)
        names = list(page.fingers)
        self._names = dict(zip(recording.fingers, names, strict=True)) if len(names) == 1 else {n: n for n in names}

    def step(self, dt: float) -> None:
        """Advance the playback by `dt` s and draw."""
        self._player.advance(dt)
        ticks, jumped = self._player.take()
        if jumped:
            self._page.forget()
        for rows in list(ticks.values())[:1]:
            tick = int(rows[-1, AT.tick])
            for number, place in self._drives.at(tick).items():
                self._page.drive(number, *place)
            self._page.ride(self._worlds.at(tick))
        self._page.show({self._names[name]: rows for name, rows in ticks.items()})

    def _draw(self, number: int, thing: Filed) -> None:
        """Draw the triangles of an object from a file, if the file exists."""
        try:
            vertices, triangles = picture_of(thing).arrays
        except ConfigError as error:
            self._page.say(str(error))
            return
        self._page.draw(number, Mesh(vertices, triangles.astype(np.uint32)))

    def close(self) -> None:
        """Do nothing: there is nothing to close."""
