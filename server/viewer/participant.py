"""Page of a participant: only prompts and their answers."""

from __future__ import annotations

from typing import Final

from softfinger.server.gateway.addresses import Addresses
from softfinger.server.keys import ClientKeys
from softfinger.server.viewer.page import Page
from softfinger.server.viewer.prompt import PromptPanel
from softfinger.server.viewer.roles import ALLOWED, Role
from softfinger.server.viewer.scripts import run_script
from softfinger.server.viewer.wire import CommandQueue, TelemetryReceiver
from softfinger.server.wire.protocol import EVENT

TEXT_SIZE: Final = 1.5
"""Text size relative to other pages: participants sit behind a device."""
REQUEST_PERIOD_S: Final = 1.0


class ParticipantPage:
    """Data source of a page from a daemon, which may start later; call `step` for each frame."""

    def __init__(self, page: Page, daemon: Addresses, keys: ClientKeys | None = None) -> None:
        self._telemetry = TelemetryReceiver(daemon.telemetry, keys, (EVENT,))
        self._commands = CommandQueue(daemon.command_endpoint(), keys, allowed_methods=ALLOWED[Role.PARTICIPANT])
        page.show_only_prompts()
        run_script(page.server.gui, "noise")
        self._prompt = PromptPanel(
            page.server.gui, self._commands, lambda text: page.show_message(text, "Not done:"), size=TEXT_SIZE
        )
        self._since_request_s = REQUEST_PERIOD_S

    def step(self, dt: float) -> None:
        """Show the data received in the last `dt` s."""
        self._since_request_s += dt
        if not self._prompt.is_known and self._since_request_s > REQUEST_PERIOD_S:
            self._since_request_s = 0.0
            self._prompt.request()
        for event in self._telemetry.take().events:
            self._prompt.handle_event(event)
        self._prompt.step()

    def close(self) -> None:
        for part in (self._telemetry, self._commands):
            part.close()
