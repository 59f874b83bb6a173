"""Page of a participant: only prompts and their answers."""

from __future__ import annotations

from typing import Final

from softfinger.server.gateway.addresses import Addresses
from softfinger.server.keys import ClientKeys
from softfinger.server.viewer.page import Page
from softfinger.server.viewer.prompt import PromptPanel
from softfinger.server.viewer.roles import ALLOWED, Role
from softfinger.server.viewer.wire import Asker, Live
from softfinger.server.wire.protocol import EVENT

SIZE: Final = 1.5
"""Text size relative to other pages: participants sit behind a device."""
ASK_AGAIN_S: Final = 1.0


class ParticipantPage:
    """Data source of a page from a daemon, which may start later; call `step` for each frame."""

    def __init__(self, page: Page, daemon: Addresses, keys: ClientKeys | None = None) -> None:
        self._live = Live(daemon.telemetry, keys, (EVENT,))
        self._asker = Asker(daemon.command_endpoint(), keys, may=ALLOWED[Role.PARTICIPANT])
        page.only_prompts()
        self._prompt = PromptPanel(page.server.gui, self._asker, lambda text: page.say(text, "Not done:"), size=SIZE)
        self._since = ASK_AGAIN_S

    def step(self, dt: float) -> None:
        """Show the data received in the last `dt` s."""
        self._since += dt
        if not self._prompt.known and self._since > ASK_AGAIN_S:
            self._since = 0.0
            self._prompt.look()
        for event in self._live.take().events:
            self._prompt.hear(event)
        self._prompt.step()

    def close(self) -> None:
        for part in (self._live, self._asker):
            part.close()
