"""Page: 3-D view of a scene and its fingertips with a panel of text and controls, updated about 30 times per second."""

from __future__ import annotations

import contextlib
import gc
import html
import io
import logging
import threading
import time
from collections.abc import Callable, Mapping
from math import exp
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import viser
from viser.infra._async_message_buffer import AsyncMessageBuffer

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.config.load import build
from softfinger.proxy.record import AT
from softfinger.server.surface_meshes import SurfaceMesh
from softfinger.server.viewer.displayed import LowDofDevice
from softfinger.server.viewer.door.access import Access
from softfinger.server.viewer.inputs import is_on_slider
from softfinger.server.viewer.nodes.bodies import BodyNodes, SceneStart
from softfinger.server.viewer.nodes.camera import Camera, place_camera
from softfinger.server.viewer.nodes.fingers import FingerNodes
from softfinger.server.viewer.nodes.glyphs import PoseTuple
from softfinger.server.viewer.nodes.looks import COLOURS, Looks, VisibleState
from softfinger.server.viewer.plots import Plots
from softfinger.server.viewer.scripts import add_theme

FRAME_S: Final = 1.0 / 30.0
TEXT_S: Final = 0.2
PLOT_S: Final = 0.33
COLLECT_S: Final = 60.0
"""Period of garbage collection. CPython caches up to 2000 freed tuples of each length, 4 MB in all, until a full
collection. Automatic ones are so rare that the memory of a page grew for most of an hour.
"""
CLOSE_S: Final = 0.5
"""Longest time for which closing waits for browsers to disconnect; they need some milliseconds."""
TITLE: Final = "softfinger"
TEXT_HTML: Final = '<div style="padding: 0.3em 0.75em; font-size: 0.85em; line-height: 1.5">{}</div>'
GRID: Final = "display: grid; grid-template-columns: 5.5em 6em 6.5em auto; font-variant-numeric: tabular-nums"
NO_DEVICES: Final[Mapping[str, LowDofDevice]] = MappingProxyType({})
ARROW: Final = "arrow, N/cm"
FADE_S: Final = 6.0
"""Time constant of the largest force: the scale of arrows changes slowly after a push."""
NOTIFICATION_S: Final = 12.0
"""Duration of a notification: long enough to read three lines twice."""
PANEL_WIDTH: Final = 384
"""Width of the docked panel, pixels: that of the theme. Without it, viser 1.1.1 uses its default width if a browser
happens to draw the panel before it applies the theme."""
PROMPT_STYLE: Final = """<style>
[style*="right: 0px"][style*="z-index: 5"] { right: 50% !important; transform: translateX(50%); width: 640px !important;
  max-width: 100vw; }
[style*="right: 0px"][style*="z-index: 5"] > * > * { width: 100% !important; }
[style*="right: 0px"][style*="box-shadow"] { display: none; }
[style*="max-height: 60%"] { max-height: 100% !important; height: 100%; }
.mantine-Button-root { min-height: 2.6em; font-size: 1.1em; }
@media (min-width: 1800px) { [style*="right: 0px"][style*="z-index: 5"] { zoom: 1.6; } }
</style>"""
"""Centres the docked panel of viser 1.1, without the shadow of its docked place, and enlarges it in large windows; the
sheet of a phone fills it. viser's own width of the panel is lost in a window that was narrow."""


_push: Final = AsyncMessageBuffer.push


def push_from_any_thread(buffer: AsyncMessageBuffer, message: Any) -> None:
    """Queue a message for browsers, even while one connects or closes in the thread of the event loop.

    viser 1.1.1 sets an `asyncio.Event` in the caller's thread, which raises RuntimeError if its waiters change then.
    The message is queued by that time, so only the event loop has to be woken.
    """
    try:
        _push(buffer, message)
    except RuntimeError as error:
        if "mutated" not in str(error):
            raise
        buffer.event_loop.call_soon_threadsafe(buffer.message_event.set)


AsyncMessageBuffer.push = push_from_any_thread  # type: ignore[method-assign, assignment]


class Page:
    """Page on `host`:`port`, or the next free port; a data source, such as `LivePage`, updates it.

    Parameters
    ----------
    host, port
        Address to listen on.
    allowed
        Further host names of the page.
    token
        Secret part of the address, reused from a previous page; None: a new one.
    """

    def __init__(self, host: str, port: int, allowed: tuple[str, ...] = (), token: str | None = None) -> None:
        access = Access(host, allowed, TITLE, token)
        logging.getLogger("websockets").setLevel(logging.WARNING)  # it logs every page that is opened
        with access.guard_server(), contextlib.redirect_stdout(io.StringIO()):  # viser prints a box with its address
            self.server: Final = viser.ViserServer(host=host, port=port, label=TITLE, verbose=False)
        self.address: Final = access.address(self.server.get_port())
        # Without a graphics card, each would cost a third of a frame.
        self.server.scene.configure_environment_map(None)
        self.server.scene.configure_default_lights(cast_shadow=False)
        self.server.scene.add_light_hemisphere("/light", ground_color=(190, 196, 206), intensity=1.1)
        self._camera: Camera | None = None
        self.server.on_client_connect(self._follow_camera)
        self._scene: schema.Scene | None = None
        self._file_vertices: Final[dict[int, Array]] = {}
        self._low_dof_devices, self._awaits_body_poses = NO_DEVICES, False
        self.looks: Final = Looks()
        self.fingers: Final[dict[str, FingerNodes]] = {}
        self.bodies: BodyNodes | None = None
        self._newest: dict[str, Array] = {}
        self._largest_n, self._newtons_per_cm = 0.0, self.looks.newtons_per_cm
        self._text_updated_s, self._plotted_s, self._shown_s, self._closed = 0.0, 0.0, 0.0, False
        gui = self.server.gui
        gui.main_panel.dock_right()
        self._message = gui.add_markdown("", visible=False)
        self.refusal = ""
        """Text of the latest notification."""
        self.preparing = ""
        """Progress of preparations in the daemon, shown below the values of the tick."""
        self._state_text = gui.add_html("")
        self._paused = gui.add_checkbox("pause picture", False)
        self.tabs: Final = gui.add_tab_group()
        add_theme(gui)
        gui.main_panel.set_width(PANEL_WIDTH)

    def show_only_prompts(self) -> None:
        """Hide everything that shows the rendering."""
        for part in (self._state_text, self._paused, self.tabs):
            part.visible = False
        self.server.gui.add_html(PROMPT_STYLE)

    def add_views(self) -> None:
        """Add the tabs for view settings and plots; call after the data source has added its tabs."""
        gui, looks = self.server.gui, self.looks
        with self.tabs.add_tab("Show"):
            for name, text in (
                ("cone", "friction cone"),
                ("traces", "contact trace"),
                ("ghost", "separate probe"),
                ("patches", "contact normals"),
            ):
                _bind(gui.add_checkbox(text, getattr(looks, name)), looks, name)
            _bind(gui.add_slider(ARROW, 0.1, 10.0, 0.1, looks.newtons_per_cm), looks, "newtons_per_cm")
            _bind(gui.add_slider("arc, deg/mN m", 5.0, 200.0, 5.0, looks.degrees_per_mnm), looks, "degrees_per_mnm")
            gui.add_button("wipe traces").on_click(lambda event: self.clear_traces())
        self._plots = Plots(gui, self.tabs.add_tab("Plots"))

    def change(self, scene: schema.Scene, start: SceneStart, devices: Mapping[str, LowDofDevice] = NO_DEVICES) -> None:
        """Replace the scene and all its nodes.

        Parameters
        ----------
        scene
            New scene.
        start
            Start of the scene.
        devices
            Devices that display only a part of the force, by finger name.
        """
        with self.server.atomic():
            for nodes in self.fingers.values():
                nodes.remove()
            if self.bodies is not None:
                self.bodies.remove()
            self.bodies = BodyNodes(self.server.scene, scene, start)
            self.fingers.clear()
            self._newest.clear()
            for finger in scene.fingers:
                nodes = self.fingers[finger.name] = FingerNodes(self.server.scene, scene, finger, self.bodies)
                if finger.name in devices:
                    nodes.displayed_force = devices[finger.name].displayed_force
        self._plots.name_finger(next(iter(self.fingers)))
        self._scene, self._low_dof_devices, self._awaits_body_poses = scene, devices, scene.world is not None
        self._file_vertices.clear()
        self._set_camera()

    def restart(self, start: SceneStart) -> None:
        if self.bodies is not None:
            self.bodies.start = start
        self.clear_traces()

    def _set_camera(self) -> None:
        """Set the camera for new and open pages, if the scene requires another one."""
        if self._scene is None or self.bodies is None:
            return
        camera = place_camera(self._scene, self._file_vertices, self.bodies.drawn_objects())
        if camera == self._camera:
            return
        self._camera = camera
        for name, value in camera._asdict().items():
            setattr(self.server.initial_camera, name, value)
        for client in self.server.get_clients().values():
            self._place_camera(client)

    def _follow_camera(self, client: viser.ClientHandle) -> None:
        """Place the camera of a new browser, again if its page applies the initial camera after that."""
        self._place_camera(client)

        def restore_camera(camera: viser.CameraHandle) -> None:
            if self._camera is not None and np.allclose(camera.position, self._camera.position):
                self._place_camera(client)

        client.camera.on_update(restore_camera)

    def _place_camera(self, client: viser.ClientHandle) -> None:
        """Place the camera of a browser; in a window higher than wide farther away, so that its sides cut nothing."""
        camera = self._camera
        if camera is None:
            return
        factor = max(1.0, client.camera.image_height / client.camera.image_width)
        look_at = np.array(camera.look_at)
        client.camera.position = look_at + factor * (camera.position - look_at)
        client.camera.look_at, client.camera.fov = look_at, camera.fov

    def drive(self, scene_index: int, position: Any, orientation: Any) -> None:
        if self.bodies is not None:
            self.bodies.drive(scene_index, position, orientation)

    def move_bodies(self, bodies: Mapping[str, PoseTuple]) -> None:
        if self.bodies is not None and not self._paused.value:
            self.bodies.move_bodies(bodies)
            if bodies and self._awaits_body_poses:  # their poses are unknown before
                self._awaits_body_poses = False
                self._set_camera()

    def draw(self, scene_index: int, mesh: SurfaceMesh) -> None:
        if self.bodies is not None:
            self.bodies.draw(scene_index, mesh)
            self._file_vertices[scene_index] = mesh.vertices
            self._set_camera()

    def show(self, ticks: dict[str, Array]) -> None:
        """Show the new ticks (n, RECORD_SIZE) of each finger."""
        new_rows = {name: rows for name, rows in ticks.items() if name in self.fingers and len(rows)}
        for name, rows in new_rows.items():
            self._newest[name] = rows[-1]
        if not self._paused.value and new_rows:
            largest = max(float(np.linalg.norm(rows[-1, AT.force : AT.force + 3])) for rows in new_rows.values())
            now = time.monotonic()
            self._largest_n = max(largest, exp((self._shown_s - now) / FADE_S) * self._largest_n)
            self._shown_s = now
            self._newtons_per_cm = self.looks.arrow(self._largest_n)
            with self.server.atomic():
                if self.bodies is not None:
                    self.bodies.show(next(iter(new_rows.values()))[-1])
                    self.bodies.deform(self._newest)
                for name, rows in new_rows.items():
                    self.fingers[name].show(rows, self.looks, self._newtons_per_cm)
        first = next(iter(self.fingers), "")
        if first in new_rows:
            self._plots.add(new_rows[first], self.fingers[first].radius)
        self._update_panel()

    def clear_traces(self) -> None:
        for nodes in self.fingers.values():
            nodes.clear_traces()

    def show_message(self, text: str, title: str = "") -> None:
        """Show a message: above the controls until the next one, or with a title as a notification over the picture."""
        if self._closed:  # a late answer
            return
        if not title:
            self._message.content, self._message.visible = text, bool(text)
            return
        self.refusal = f"{title} {text}"
        for client in self.server.get_clients().values():
            client.add_notification(title, text, auto_close_seconds=NOTIFICATION_S, color="orange")

    def clear_message(self, text: str) -> None:
        """Hide the message above the controls if it is `text`."""
        if self._message.content == text:
            self.show_message("")

    def _update_panel(self) -> None:
        now = time.monotonic()
        if now - self._text_updated_s > TEXT_S and self._newest and not self._paused.value:
            self._text_updated_s = now
            parts = []
            for name, row in self._newest.items():
                parts.append(format_tick_html(name, row, self.fingers[name].state, self.fingers[name].gap_m))
                if name in self._low_dof_devices:
                    parts.append(TEXT_HTML.format(self._low_dof_devices[name].format_html(row)))
            preparing = f"<br>the daemon prepares: {html.escape(self.preparing)}" if self.preparing else ""
            parts.append(TEXT_HTML.format(f"arrow: {self._newtons_per_cm:g} N/cm{preparing}"))
            self._state_text.content = "".join(parts)
        if now - self._plotted_s > PLOT_S and not self._paused.value:
            self._plotted_s = now
            self._plots.show()

    def close(self) -> None:
        """Stop the server, waiting at most CLOSE_S: viser waits 6 s for a browser that does not read."""
        self._closed = True
        stopping = threading.Thread(target=self.server.stop, name="stop", daemon=True)
        with contextlib.redirect_stdout(io.StringIO()):
            stopping.start()
            stopping.join(CLOSE_S)


def _bind(control: Any, looks: Looks, name: str) -> None:

    def store_value(event: Any) -> None:
        if not hasattr(control, "max") or is_on_slider(control):
            setattr(looks, name, control.value)

    control.on_update(store_value)


def format_tick_html(name: str, row: Array, state: VisibleState, gap_m: float | None) -> str:
    """Return the values of a tick as HTML, with the gap between the fingertip and the object below.

    If the force is off, the forces are those that the hand feels, zero, although the contact is still computed.
    """
    row = np.round(row, 9) + 0.0  # avoids negative zeros
    is_off = row[AT.contact_normal_force] > 0.0 and not row[AT.force : AT.force + 3].any()
    force_scale = 0.0 if is_off else 1.0
    figures = (
        ("normal", f"{force_scale * row[AT.contact_normal_force]:.2f} N"),
        ("tangential", f"{force_scale * row[AT.contact_tangential_force]:.2f} N"),
        ("depth", f"{1e3 * row[AT.contact_penetration]:.2f} mm"),
        ("torsion", f"{force_scale * 1e3 * row[AT.contact_torsion]:.2f} mN m"),
        ("spin", f"{np.degrees(row[AT.contact_spin]):.1f}°"),
        ("rolled", f"{np.degrees(row[AT.contact_rolled]):.1f}°"),
    )
    cells = "".join(f'<span style="opacity: 0.75">{word}</span><span>{figure}</span>' for word, figure in figures)
    gap = "" if gap_m is None else f" · gap {1e3 * max(gap_m, 0.0):.1f} mm"
    off = " · <b>force off</b>" if is_off else ""
    head = f'<span style="color: rgb{COLOURS[state]}">&#9632;</span> <b>{state}</b>{off} · tick {row[AT.tick]:.0f}{gap}'
    return TEXT_HTML.format(f'{html.escape(name + ": ") if name else ""}{head}<div style="{GRID}">{cells}</div>')


def parse_scene_start(description: dict[str, Any]) -> SceneStart:
    has_own_clock = all(finger["device"]["own_clock"] for finger in description["fingers"])
    return SceneStart(description["since"], description["since_missed"], 1.0 / description["rate_hz"], has_own_clock)


def parse_scene(description: dict[str, Any]) -> schema.Scene:
    """Return the scene in a daemon's description; raises ConfigError for an unknown shape."""
    return build(schema.Scene, description["scene"], "the daemon's scene")


def run_frames(work: Callable[[float], None], stop_requests: list[bool], duration: float | None) -> None:
    """Call `work(dt)` about 30 times per second, and no faster than the page is drawn.

    Parameters
    ----------
    stop_requests
        Stops the loop once it has an element. A list, because a signal handler may add to it: the lock of an Event
        could be locked by the interrupted thread.
    duration
        Maximum duration, s; None: no limit.
    """
    gc.freeze()  # existing objects are permanent: exclude them from collections
    start_s = last = collected = time.monotonic()
    while not stop_requests:
        time.sleep(max(0.0, last + FRAME_S - time.monotonic()))
        now = time.monotonic()
        work(now - last)
        last = now
        if now - collected > COLLECT_S:
            gc.collect()
            collected = now
        if duration is not None and now - start_s >= duration:
            return
