"""Prompt of an experiment on the page: text, progress, and buttons, keys or a field for the answer."""

from __future__ import annotations

import html
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from softfinger.server.viewer.wire import Asker, Request
from softfinger.server.wire.client_requests import parse_number
from softfinger.server.wire.commands import Prompt, Prompted

TEXT: Final = (
    '<div style="padding: 0.5em 0.75em; font-size: {size}em; line-height: 1.5; overflow-wrap: anywhere">'
    '<b>{title}</b><div style="white-space: pre-wrap">{text}</div></div>'
)
DIGITS: Final = "123456789"
LARGE_MAX: Final = 3
"""Up to this number, each choice has a large button; more choices share a row."""
FIRST: Final = -1.0
"""Order of the prompt: above all other controls."""


class PromptPanel:
    """Display of a daemon's prompt, and input of the answer.

    Parameters
    ----------
    asker
        Sends commands to the daemon.
    refused
        Called with the reason if an answer was refused.
    answers
        False: only show the prompt.
    size
        Text size relative to the page.
    """

    def __init__(
        self, gui: Any, asker: Asker, refused: Callable[[str], None], answers: bool = True, size: float = 1.0
    ) -> None:
        self._gui, self._asker, self._refused, self._answers, self._size = gui, asker, refused, answers, size
        self._folder = gui.add_folder(None, order=FIRST, visible=False)
        with self._folder:
            self._text = gui.add_html("")
            self._bar = gui.add_progress_bar(0.0, visible=False)
        self._asking: list[Any] = []
        self._now: Prompted | None = None
        self._came: Prompted | None = None

    @property
    def known(self) -> bool:
        """Whether the daemon has sent its prompt."""
        return self._now is not None

    def look(self) -> None:
        """Request the prompt; `step` shows it."""
        self._asker.ask("prompt", Request("get_prompt", {}, self._keep, lambda text: None))

    def hear(self, event: dict[str, Any]) -> None:
        """Request the prompt again after an event about a new prompt, an answer, or a new daemon."""
        if event["kind"] == "lifecycle" or event["name"] in ("set_prompt", "answer"):
            self.look()

    def _keep(self, prompted: Prompted) -> None:
        self._came = prompted

    def step(self) -> None:
        """Show the received prompt; from the thread that draws."""
        came, self._came = self._came, None
        if came is None or came == self._now:
            return
        self._now, prompt = came, came.prompt
        self._folder.visible = bool(prompt.title or prompt.text or came.open)
        self._text.content = TEXT.format(
            size=self._size, title=html.escape(prompt.title), text=html.escape(prompt.text)
        )
        self._bar.visible, self._bar.value = prompt.of > 0, 100.0 * min(prompt.done / max(prompt.of, 1), 1.0)
        for each in self._asking:
            each.remove()
        self._asking = self._asked(prompt, came.number) if came.open and self._answers else []

    def _asked(self, prompt: Prompt, number: int) -> list[Any]:
        """Add the controls for the answer."""
        gui = self._gui
        with self._folder:
            if prompt.number is not None:
                field, button = gui.add_text("your number", ""), gui.add_button("answer")
                button.on_click(lambda event: self._send(parse_number(field.value), number))
                return [field, button]
            if len(prompt.choices) > LARGE_MAX:
                buttons = gui.add_button_group("", prompt.choices)
                buttons.on_click(lambda event: self._send(event.target.value, number))
                made = [buttons]
            else:
                made = [gui.add_button(choice) for choice in prompt.choices]
                for choice, button in zip(prompt.choices, made, strict=True):
                    button.on_click(partial(self._pressed, choice, number))
        for key, choice in keys_of(prompt.choices).items():
            command = gui.add_command(f"answer: {choice}", hotkey=key)
            command.on_trigger(partial(self._pressed, choice, number))
            made.append(command)
        return made

    def _pressed(self, choice: str, number: int, event: Any) -> None:
        self._send(choice, number)

    def _send(self, value: str | float, number: int) -> None:
        """Send the answer unchecked: the daemon validates it."""
        params = {"value": value, "prompt": number}
        self._asker.ask("answer", Request("answer", params, lambda result: None, self._refused))


def keys_of(choices: tuple[str, ...]) -> dict[str, str]:
    """Return the keys of choices: a digit that is a choice, else of its position; Enter for a single choice."""
    if len(choices) == 1:
        return {"enter": choices[0]}
    if any(digit in choices for digit in DIGITS):
        return {digit: digit for digit in DIGITS if digit in choices}
    return dict(zip(DIGITS, choices, strict=False))
