"""Pages of running daemons that a test steps instead of a thread."""

from collections.abc import Callable
from typing import Any

from helpers.waits import eventually
from softfinger.server.viewer.live import LivePage


def step_until(live: LivePage, condition: Callable[[], Any]) -> bool:
    """Step a page until a condition is true; return False if it is not in time."""
    return bool(eventually(lambda: condition() or live.step(0.05), every_s=0.01))
