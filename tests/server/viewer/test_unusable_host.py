"""Hosts on which no page can listen: one error, before the page starts."""

from __future__ import annotations

import pytest
from helpers.called import called
from helpers.waits import ends_within

pytestmark = pytest.mark.plain


@pytest.mark.parametrize("host", ["nowhere.invalid", "192.0.2.1", "a..b", "x" * 300])
def test_an_unusable_host_is_an_error(host: str) -> None:
    with ends_within(30):
        result = called("view", "tap", "--no-open", "--duration", "0.1", "--port", "0", "--host", host)
    assert result.returncode == 2
    assert result.stderr.startswith(f"softfinger: --host {host}: ") and "of this machine" in result.stderr
