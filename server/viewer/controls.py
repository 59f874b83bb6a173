"""Validation of values from browsers by the limits of their controls: any program may send any value."""

from __future__ import annotations

from typing import Any


def is_on_slider(slider: Any) -> bool:
    return bool(slider.min <= slider.value <= slider.max)


def is_in_list(choice: Any) -> bool:
    return choice.value in choice.options
