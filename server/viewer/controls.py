"""What a browser says of a control, checked by the same limits that it shows: a program may say anything."""

from __future__ import annotations

from typing import Any


def on_slider(slider: Any) -> bool:
    """Whether a slider's value is between its ends, and a number at all."""
    return bool(slider.min <= slider.value <= slider.max)


def on_list(choice: Any) -> bool:
    """Whether the value of a list of choices is one of them."""
    return choice.value in choice.options
