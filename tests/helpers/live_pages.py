"""Pages of running daemons that a test steps instead of a thread."""

from collections.abc import Callable
from typing import Any

from helpers.waits import WAIT_S, eventually
from softfinger.server.viewer.live import LivePage


def step_until(live: LivePage, condition: Callable[[], Any], wait_s: float = WAIT_S) -> bool:
    """Step a page until a condition holds; return False if it does not in time."""
    return bool(eventually(lambda: condition() or live.step(0.05), wait_s, every_s=0.01))
