"""Warnings of a device: published once, and again when they change or reappear."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from softfinger.server.services.watches import DEVICE_WARNING, DeviceWarnings

pytestmark = pytest.mark.plain


def test_each_warning_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    warning, events = [""], []
    device: Any = SimpleNamespace(info=SimpleNamespace(name="arm"), warning=lambda: warning[0])

    def event(kind: str, name: str, message: str) -> None:
        events.append((kind, name, message))

    watch = DeviceWarnings(lambda: [device], event)
    for words in ("", "hot", "hot", "hotter", "", "", "hot"):
        warning[0] = words
        watch.check()
    assert events == [("fault", DEVICE_WARNING, f"arm: {words}") for words in ("hot", "hotter", "hot")]
    assert caplog.text.count("arm: hot") == 3


def test_a_failing_check_is_published() -> None:
    messages = []
    DeviceWarnings(list, lambda *_, message: messages.append(message)).handle_failure(ValueError("broken"))
    assert messages == ["warnings of devices are no longer reported: broken"]
