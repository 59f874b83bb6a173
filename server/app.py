"""Daemon: starts and stops the services around one servo, until its last write of zero force."""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from softfinger.config import schema
from softfinger.config.errors import HapticError
from softfinger.drivers import base
from softfinger.server.loop import realtime, shutdown
from softfinger.server.loop.clock import NS_PER_S
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.loop.servo_thread import require_machine_code
from softfinger.server.services.arming import Arming
from softfinger.server.services.base import Service, stop_all
from softfinger.server.services.command_handlers import DaemonInterface
from softfinger.server.services.command_service import CommandService
from softfinger.server.services.description import describe_daemon
from softfinger.server.services.monitoring import (
    DeviceWarningMonitor,
    HotplugMonitor,
    SocketFileMonitor,
    SwapMonitor,
)
from softfinger.server.services.recordings import BlackBoxes, Recordings
from softfinger.server.services.records import RecordService, Sink, TelemetryService
from softfinger.server.services.rendering import Rendering
from softfinger.server.services.scene_topics import DeformationPublisher, WorldPublisher
from softfinger.server.services.supervisor import Supervisor
from softfinger.server.services.systemd import ServiceNotifier
from softfinger.server.socket_process.channel_messages import StateInfo
from softfinger.server.states import DaemonState, StateMachine, Trigger
from softfinger.server.wire.endpoint import listen
from softfinger.server.wire.events import make_event, read_clock_s
from softfinger.server.wire.native.switch import SharedSwitch
from softfinger.server.wire.protocol import DEFORMATION, SCHEMA, WORLD
from softfinger.server.wire.publisher import Publisher
from softfinger.server.wire.rig_endpoints import Endpoints, bind_rig

if TYPE_CHECKING:  # an HTTP server takes time to import, and is off by default
    from softfinger.server.metrics.service import MetricsService

STUCK_S: Final = 1.0
"""Time that the servo has to end after an error. Past it, the servo is stuck in its device, and `wait` raises."""
WAIT_POLL_S: Final = 0.25
PUBLISHER_PRIORITY: Final = 1
"""Lowest real-time priority: above normal threads, below all threads that a tick depends on."""


class Daemon:
    """Running server. Construct (opens everything), `start`, `wait`, `close`; also a context manager.

    Parameters
    ----------
    rig, scene
        Validated configuration.
    ticks
        Number of ticks to run; None: until stopped.
    report
        Called from the servo thread with the result of each real-time setting.
    sinks
        Receivers of all records, in addition to the publisher.
    scene_name
        Name of the scene.
    faults
        Faults to inject between the devices and the loop.

    Raises
    ------
    HapticError
        If a device cannot be opened or an endpoint cannot be bound; everything opened before is closed.
    """

    def __init__(
        self,
        rig: schema.Rig,
        scene: schema.Scene,
        ticks: int | None = None,
        report: Callable[[list[realtime.Setting]], None] | None = None,
        sinks: Sequence[Sink] = (),
        scene_name: str = "unnamed",
        faults: schema.Faults | None = None,
    ) -> None:
        require_machine_code("the servo loop")
        self._report = report
        self._rig = rig
        self._failure: HapticError | None = None
        self._failed_at = math.inf
        self._published_faults: Final[set[str]] = set()
        # Created first, so that each later change of the attached devices is reported, even if the first poll is late.
        hotplug = HotplugMonitor(self._publish_event)
        fingers = [finger.name for finger in scene.fingers] if len(scene.fingers) > 1 else [""]
        self._fingers: Final = fingers
        """Names of several fingers, used in messages; [""] for a single finger."""
        self.states: Final = StateMachine(self._publish_state)
        endpoints = bind_rig(rig)
        cleanups: list[Callable[[], None]] = [endpoints.close]
        try:
            switch = SharedSwitch()
            self.switch_file: Final = switch.file
            """File of the force switch, for `signals.stop_on_signal`; open until the publisher is closed."""
            self.publisher: Final = self._open_publisher(endpoints, scene, switch)
            cleanups += [self.publisher.close, self.publisher.tap.close]
            metrics = self._open_metrics()
            if metrics is not None:
                cleanups.append(metrics.stop)
            self.rendering: Final = Rendering(rig, scene, ticks, self._prepare, faults, self.states, switch.words)
            cleanups += [self.rendering.servo.close, self.rendering.stop]
            self.public: Final = endpoints.public
            """Endpoints reachable from other machines, by table of the rig."""
            self.servo: Final = self.rendering.servo
            self._publish_scene_info(scene_name)
            self.recordings: Final = Recordings(self.rendering, fingers, self._publish_event)
            self.deformation: Final = DeformationPublisher(self.rendering, fingers, self._send_message)
            self.blackbox: Final = BlackBoxes(
                self.servo, fingers, lambda: describe_daemon(self.rendering, self._scene_name)
            )
            self.publisher.report_event = self._publish_event
            self.supervisor: Final = Supervisor(self.servo, self.fail, self._publish_event)
            self.commands_endpoint: Final = endpoints.commands
            """Endpoint of the commands; None if they are off."""
            self.metrics_endpoint: Final = None if metrics is None else metrics.endpoint
            """Endpoint of the metrics for Prometheus; None if they are off."""
            self.services: Final = self._make_services(scene_name, hotplug, metrics, sinks)
            """In order of start; the servo is started last and stopped first."""
        except BaseException as error:
            shutdown.run_all_steps(*reversed(cleanups), first=error)
            raise

    @property
    def devices(self) -> tuple[base.Device, ...]:
        """Devices that are rendered on, one per finger of the scene."""
        return self.servo.devices

    def start(self) -> None:
        """Compile the kernels if needed, then start the services, the servo last.

        The servo thread applies its real-time settings, and arms the devices immediately before the first tick.
        """
        self.servo.compile()
        for service in self.services:
            service.start()

    def stop(self) -> None:
        """Stop the servo; from any thread or signal handler."""
        self.servo.stop()

    def pause(self) -> Callable[[], None]:
        """Remove the force (`Rendering.pause`); from the main thread or its signal handlers."""
        return self.rendering.pause()

    def replace(
        self, scene: schema.Scene | None = None, rig: schema.Rig | None = None, scene_name: str = "unnamed"
    ) -> int:
        """Replace the scene or the rig, starting at zero force, without ending the process (`Rendering.replace`).

        Subscribers stay connected and receive an event; the counts of ticks and misses and the time continue.

        Parameters
        ----------
        scene, rig
            New configuration; None: unchanged.
        scene_name
            Name of the new scene.

        Returns
        -------
        int
            Number of the first tick with the new configuration.
        """
        first = self.rendering.replace(scene, rig)
        self._raise_exchange_threads()  # of new devices
        self._publish_scene_info(self._scene_name if scene is None else scene_name)
        self._publish_event("lifecycle", "replaced", device=base.join_names(self.devices), first=first)
        return first

    def _publish_scene_info(self, scene_name: str) -> None:
        self._scene_name = scene_name
        self.publisher.set_state_info(StateInfo(scene_name, NS_PER_S / self.servo.period_ns, self.servo.epoch_s))

    def fail(self, error: HapticError) -> None:
        """End the run with an error; only the first error counts. From any thread."""
        if self._failure is None:
            self._failure, self._failed_at = error, time.monotonic()
        self.servo.stop()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for the end of the servo; return False on timeout.

        Parameters
        ----------
        timeout_s
            Maximum time to wait; None: no limit.

        Raises
        ------
        DeviceError, SafetyStop, RealtimeError
            If the cause was neither a stop, nor the last tick, nor the end of a recording. Exceptions from
            defects of the program are raised unchanged.
        """
        try:
            until = time.monotonic() + (math.inf if timeout_s is None else timeout_s)
            while (end := self.servo.join(max(0.0, min(WAIT_POLL_S, until - time.monotonic())))) is None:
                if self._failure is not None and time.monotonic() - self._failed_at > STUCK_S:
                    raise self._failure
                if time.monotonic() >= until:
                    return False
            if self._failure is not None:
                raise self._failure
            if end.error is not None:
                raise end.error
            failed = shutdown.describe_failure(self.devices[end.finger], end, self._fingers[end.finger])
            failed = failed or shutdown.describe_loop_failure(
                end, self.servo.ticks, self.servo.missed, self.servo.woken_late
            )
            if failed is not None:
                raise failed
            return True
        except Exception as error:
            self.states.fail(str(error))
            if str(error) not in self._published_faults:
                self._publish_event("fault", name_fault(error), message=str(error))
            raise

    def close(self, first: BaseException | None = None) -> None:
        """Stop all services and the servo, release the devices, send pending messages; may be called repeatedly.

        Each step runs even if an earlier one failed. The first error is raised at the end, later ones are logged.

        Parameters
        ----------
        first
            Exception that is already propagating: all errors are logged and none is raised.
        """
        failed = shutdown.run_all_steps(
            self.stop, lambda: self.states.fire(Trigger.END, "by request, or complete"), first=first
        )
        failed = stop_all(self.services, failed)
        if failed is not None and failed is not first:
            raise failed

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(error)

    def _publish_event(self, kind: str, name: str, **fields: Any) -> None:
        """Publish and record an event; a fault also gets the file name of its black box."""
        if kind == "fault":
            self._published_faults.add(str(fields.get("message", "")))
            fields["blackbox"] = self.blackbox.schedule_file(name)
        self._send(kind, name, fields)

    def publish_page_exit(self, text: str) -> None:
        self._publish_event("fault", "page", message=text)

    def _send(self, kind: str, name: str, fields: dict[str, Any]) -> None:
        """Send an event with the present tick and time to the publisher, the recordings and the black box."""
        event = make_event(self.servo.last_tick_and_time(), kind, name, fields)
        for receive in (self.publisher.send_event, self.recordings.record_event, self.blackbox.box.event):
            receive(event)

    def _publish_state(self, before: DaemonState, now: DaemonState, cause: str) -> None:
        self._send("state", now.value, {"before": before.value, "cause": cause})

    def _send_message(self, topic: str, tick: int, content: dict[str, Any]) -> None:
        """Publish and record a message of one of SCENE_TOPICS, with the content of a tick."""
        message = {"schema": SCHEMA, "timestamp": read_clock_s(), "tick": tick, **content}
        self.publisher.send_message(topic, message)
        self.recordings.record_message(topic, message)

    def _open_publisher(self, endpoints: Endpoints, scene: schema.Scene, switch: SharedSwitch) -> Publisher:
        return Publisher(
            endpoints,
            self._rig.telemetry.every,
            guard_names=GUARD_NAMES,
            fingers=self._fingers,
            priority=0 if self._rig.servo.realtime == "off" else PUBLISHER_PRIORITY,
            extra=[
                *([WORLD] if scene.world is not None else []),
                *([DEFORMATION] if scene.elastic_object is not None else []),
            ],
            switch=switch,
        )

    def _open_metrics(self) -> MetricsService | None:
        endpoint = self._rig.metrics.endpoint
        if endpoint is None:
            return None
        from softfinger.server.metrics.counts import MetricsCollector
        from softfinger.server.metrics.service import KEY, MetricsService

        counts = MetricsCollector(
            self._fingers,
            lambda: (self.publisher.figures, self.publisher.restarts),
            lambda: self.recordings.collect_totals(),
            lambda: self.states.now,
        )
        return MetricsService(listen(f"tcp://{endpoint}", KEY), counts, self._publish_event)

    def _make_services(
        self, scene_name: str, hotplug: HotplugMonitor, metrics: MetricsService | None, sinks: Sequence[Sink]
    ) -> list[Service]:
        telemetry = TelemetryService(self.publisher, self.servo)
        optional_services: list[CommandService | MetricsService] = []
        if self.commands_endpoint is not None:

            def replace(scene: schema.Scene, name: str) -> int:
                return self.replace(scene, scene_name=name)

            interface = DaemonInterface(
                self.publisher, self.recordings, replace, self._publish_event, self.stop, self.fail
            )
            optional_services.append(CommandService(self.commands_endpoint, self.rendering, interface, scene_name))
        if metrics is not None:
            optional_services.append(metrics)
        arming = Arming(self.rendering, self.states)
        record_sinks = [
            telemetry.sink,
            self.recordings.sink,
            self.blackbox.sink,
            arming.sink,
            self.deformation.sink,
            *(service.sink for service in optional_services),
            *sinks,
        ]
        return [
            telemetry,
            self.recordings,
            self.blackbox,
            RecordService(self.servo, self.publisher.tap, record_sinks, self.fail, self._publish_event),
            self.supervisor,
            hotplug,
            DeviceWarningMonitor(lambda: self.devices, self._publish_event),
            SwapMonitor(self._publish_event),
            SocketFileMonitor(self.publisher.rebind, self._publish_event),
            WorldPublisher(self.servo, self._send_message, self._publish_event),
            *optional_services,
            *([ServiceNotifier(self.servo, os.environ)] if os.environ.get("NOTIFY_SOCKET") else []),
            self.rendering,
        ]

    def _prepare(self) -> Callable[[], None]:
        servo_config = self._rig.servo
        settings = realtime.apply(servo_config.realtime, servo_config.priority, servo_config.cpu)
        if servo_config.realtime != "off":
            settings.settings += [
                realtime.raise_priority("supervisor", self.supervisor.native_id, servo_config.priority + 1),
                realtime.raise_priority("relay", self.publisher.native_id, servo_config.priority - 1),
            ]
        settings.settings += self._raise_exchange_threads()
        self.recordings.note_settings([setting._asdict() for setting in settings.settings])
        if self._report is not None:
            self._report(settings.settings)
        return settings.undo

    def _raise_exchange_threads(self) -> list[realtime.Setting]:
        """Set the real-time priority of all threads that pass forces to the present devices."""
        if self._rig.servo.realtime == "off":
            return []
        threads = [thread for device in self.devices for thread in device.thread_ids()]
        return [realtime.raise_priority("exchange", thread, self._rig.servo.priority - 1) for thread in threads]


def name_fault(error: Exception) -> str:
    """Return the event name of an error: its class name in snake case, such as `device_lost`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", type(error).__name__).lower()
