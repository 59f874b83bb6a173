"""Prompts of an experiment: text, progress, and controls for the answer; the page of a participant shows only them."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from typing import Any, Final

from softfinger.server.gateway.addresses import Addresses
from softfinger.server.keys import ClientKeys
from softfinger.server.viewer.page import Page
from softfinger.server.viewer.roles import ALLOWED, Role
from softfinger.server.viewer.scripts import run_script
from softfinger.server.viewer.wire import CommandQueue, QueuedCommand, TelemetryReceiver
from softfinger.server.wire.client_requests import parse_number
from softfinger.server.wire.commands import Prompt, PromptResult
from softfinger.server.wire.protocol import EVENT

TEXT: Final = (
    '<div style="padding: 0.5em 0.75em; font-size: {size}em; line-height: 1.5; overflow-wrap: anywhere">'
    '<b>{title}</b><div style="white-space: pre-wrap">{text}</div>{screen}</div>'
)
COLOUR: Final = '<div data-colour="{colour}" style="height: 6em; margin-top: 0.5em; background: {colour}"></div>'
IMAGE: Final = '<img alt="" src="{image}" style="display: block; max-width: 100%; margin-top: 0.5em">'
NOISE: Final = '<span hidden data-masking-noise="{noise}" data-volume="{volume}"></span>'
DIGITS: Final = "1234567890"
NUMBER: Final = re.compile(r"-?[0-9.]+")
LARGE_MAX: Final = 3
"""Up to this number, each choice has a large button; more choices share a row."""
PROMPT_ORDER: Final = -1.0
"""Order of the prompt: above all other controls."""
TEXT_SIZE: Final = 1.5
"""Text size of a participant's page relative to other pages: participants sit behind a device."""
REQUEST_PERIOD_S: Final = 1.0


class PromptPanel:
    """Display of a daemon's prompt, and input of the answer.

    on_refused  called with the reason if an answer was refused
    can_answer  false: only show the prompt
    size        text size relative to the page
    """

    def __init__(
        self,
        gui: Any,
        commands: CommandQueue,
        on_refused: Callable[[str], None],
        can_answer: bool = True,
        size: float = 1.0,
    ) -> None:
        self._gui, self._commands, self._on_refused = gui, commands, on_refused
        self._can_answer, self._size = can_answer, size
        self._folder = gui.add_folder(None, order=PROMPT_ORDER, visible=False)
        with self._folder:
            self._text = gui.add_html("")
            self._bar = gui.add_progress_bar(0.0, visible=False)
        self._controls: list[Any] = []
        self.shown: PromptResult | None = None
        self._received: PromptResult | None = None

    def request(self) -> None:
        self._commands.submit("prompt", QueuedCommand("get_prompt", {}, self._store))

    def handle_event(self, event: dict[str, Any]) -> None:
        """Request the prompt again after an event about a new prompt, an answer, or a new daemon."""
        if event["kind"] == "lifecycle" or event["name"] in ("set_prompt", "answer"):
            self.request()

    def _store(self, prompted: PromptResult) -> None:
        self._received = prompted

    def step(self) -> None:
        """Show the received prompt; from the thread that draws."""
        received, self._received = self._received, None
        if received is None or received == self.shown:
            return
        self.shown, prompt = received, received.prompt
        self._folder.visible = bool(prompt.title or prompt.text or received.open)
        self._text.content = TEXT.format(
            size=self._size,
            title=html.escape(prompt.title),
            text=html.escape(prompt.text),
            screen=format_screen(prompt) if self._can_answer else "",
        )
        self._bar.visible, self._bar.value = prompt.of > 0, 100.0 * min(prompt.done / max(prompt.of, 1), 1.0)
        for control in self._controls:
            control.remove()
        self._controls = self._add_controls(prompt, received.number) if received.open and self._can_answer else []

    def _add_controls(self, prompt: Prompt, number: int) -> list[Any]:
        gui = self._gui
        with self._folder:
            if prompt.number is not None or prompt.text_length:
                parse, kind = (parse_number, "number") if prompt.number is not None else (str, "answer")
                field, button = gui.add_text(f"your {kind}", ""), gui.add_button("answer")
                button.on_click(lambda event: self._send_answer(parse(field.value), number))
                return [field, button]
            if len(prompt.choices) > LARGE_MAX:
                buttons = gui.add_button_group("", prompt.choices)
                buttons.on_click(lambda event: self._send_answer(event.target.value, number))
                controls = [buttons]
            else:
                controls = [gui.add_button(choice) for choice in prompt.choices]
                for choice, button in zip(prompt.choices, controls, strict=True):
                    button.on_click(lambda event, choice=choice: self._send_answer(choice, number))
        for key, choice in assign_keys(prompt.choices).items():
            command = gui.add_command(f"answer: {choice}", hotkey=key)
            command.on_trigger(lambda event, choice=choice: self._send_answer(choice, number))
            controls.append(command)
        return controls

    def _send_answer(self, value: str | float, number: int) -> None:
        """Send the answer unchecked: the daemon validates it."""
        self._commands.submit(
            "answer", QueuedCommand("answer", {"value": value, "prompt": number}, on_error=self._on_refused)
        )


def format_screen(prompt: Prompt) -> str:
    parts = []
    if prompt.colour:
        parts.append(COLOUR.format(colour=html.escape(prompt.colour)))
    if prompt.image:
        parts.append(IMAGE.format(image=html.escape(prompt.image)))
    if prompt.masking_noise != "none":
        parts.append(NOISE.format(noise=html.escape(prompt.masking_noise), volume=prompt.volume))
    return "".join(parts)


def assign_keys(choices: tuple[str, ...]) -> dict[str, str]:
    """Return the keys of choices: Enter for a single choice, the digits of a scale, else the digit of the position.

    A scale with longer marks, such as 0 to 100, has no keys: typing the 5 of 50 would answer 5.
    """
    if len(choices) == 1:
        return {"enter": choices[0]}
    if all(NUMBER.fullmatch(choice) for choice in choices):
        return {choice: choice for choice in choices} if set(choices) <= set(DIGITS) else {}
    return dict(zip(DIGITS, choices, strict=False))


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
        if self._prompt.shown is None and self._since_request_s > REQUEST_PERIOD_S:
            self._since_request_s = 0.0
            self._prompt.request()
        for event in self._telemetry.take().events:
            self._prompt.handle_event(event)
        self._prompt.step()

    def close(self) -> None:
        for part in (self._telemetry, self._commands):
            part.close()
