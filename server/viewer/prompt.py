"""Prompt of an experiment on the page: text, progress, and buttons, keys or a field for the answer."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from softfinger.server.viewer.wire import CommandQueue, Request
from softfinger.server.wire.client_requests import parse_number
from softfinger.server.wire.commands import Prompt, Prompted

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


class PromptPanel:
    """Display of a daemon's prompt, and input of the answer.

    Parameters
    ----------
    commands
        Sends commands to the daemon.
    on_refused
        Called with the reason if an answer was refused.
    can_answer
        False: only show the prompt.
    size
        Text size relative to the page.
    """

    def __init__(
        self,
        gui: Any,
        commands: CommandQueue,
        on_refused: Callable[[str], None],
        can_answer: bool = True,
        size: float = 1.0,
    ) -> None:
        self._gui, self._commands, self._on_refused, self._can_answer, self._size = (
            gui,
            commands,
            on_refused,
            can_answer,
            size,
        )
        self._folder = gui.add_folder(None, order=PROMPT_ORDER, visible=False)
        with self._folder:
            self._text = gui.add_html("")
            self._bar = gui.add_progress_bar(0.0, visible=False)
        self._controls: list[Any] = []
        self._shown_prompt: Prompted | None = None
        self._received: Prompted | None = None

    @property
    def is_known(self) -> bool:
        """Whether the daemon has sent its prompt."""
        return self._shown_prompt is not None

    def request(self) -> None:
        """Request the prompt; `step` shows it."""
        self._commands.submit("prompt", Request("get_prompt", {}, self._store, lambda text: None))

    def handle_event(self, event: dict[str, Any]) -> None:
        """Request the prompt again after an event about a new prompt, an answer, or a new daemon."""
        if event["kind"] == "lifecycle" or event["name"] in ("set_prompt", "answer"):
            self.request()

    def _store(self, prompted: Prompted) -> None:
        self._received = prompted

    def step(self) -> None:
        """Show the received prompt; from the thread that draws."""
        received, self._received = self._received, None
        if received is None or received == self._shown_prompt:
            return
        self._shown_prompt, prompt = received, received.prompt
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
        """Add the controls for the answer."""
        gui = self._gui
        with self._folder:
            if prompt.number is not None:
                field, button = gui.add_text("your number", ""), gui.add_button("answer")
                button.on_click(lambda event: self._send_answer(parse_number(field.value), number))
                return [field, button]
            if prompt.text_length:
                field, button = gui.add_text("your answer", ""), gui.add_button("answer")
                button.on_click(lambda event: self._send_answer(field.value, number))
                return [field, button]
            if len(prompt.choices) > LARGE_MAX:
                buttons = gui.add_button_group("", prompt.choices)
                buttons.on_click(lambda event: self._send_answer(event.target.value, number))
                controls = [buttons]
            else:
                controls = [gui.add_button(choice) for choice in prompt.choices]
                for choice, button in zip(prompt.choices, controls, strict=True):
                    button.on_click(partial(self._on_press, choice, number))
        for key, choice in assign_keys(prompt.choices).items():
            command = gui.add_command(f"answer: {choice}", hotkey=key)
            command.on_trigger(partial(self._on_press, choice, number))
            controls.append(command)
        return controls

    def _on_press(self, choice: str, number: int, event: Any) -> None:
        self._send_answer(choice, number)

    def _send_answer(self, value: str | float, number: int) -> None:
        """Send the answer unchecked: the daemon validates it."""
        params = {"value": value, "prompt": number}
        self._commands.submit("answer", Request("answer", params, lambda result: None, self._on_refused))


def format_screen(prompt: Prompt) -> str:
    """Return colour, image and noise of a prompt as HTML; their values are escaped."""
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
