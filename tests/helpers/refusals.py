"""Errors that a call has to raise, for tests of their text."""

from collections.abc import Callable
from typing import Any

import pytest

from softfinger.config.errors import ConfigError
from softfinger.config.load import FaultyConfig
from softfinger.config.scalars import Fault


def refusal(call: Callable[..., object], *args: Any, **options: Any) -> str:
    """Return the text of the ConfigError of a call."""
    with pytest.raises(ConfigError) as caught:
        call(*args, **options)
    return str(caught.value)


def faults_in(call: Callable[..., object], *args: Any, **options: Any) -> tuple[Fault | str, ...]:
    """Return the faults listed by the FaultyConfig of a call."""
    with pytest.raises(FaultyConfig) as caught:
        call(*args, **options)
    return caught.value.faults
