"""Warnings of a device: published once, and again when they change or reappear."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from softfinger.server.services.watches import DEVICE_WARNING, DeviceWarnings

pytestmark = pytest.mark.plain


def test_each_warning_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    said, told = [""], []
    device: Any = SimpleNamespace(info=SimpleNamespace(name="arm"), warning=lambda: said[0])

    def event(kind: str, name: str, message: str) -> None:
        told.append((kind, name, message))

    watch = DeviceWarnings(lambda: [device], event)
    for words in ("", "hot", "hot", "hotter", "", "", "hot"):
        said[0] = words
        watch.check()
    assert told == [("fault", DEVICE_WARNING, f"arm: {words}") for words in ("hot", "hotter", "hot")]
    assert caplog.text.count("arm: hot") == 3


def test_a_failing_check_is_published() -> None:
    told = []
    DeviceWarnings(list, lambda *_, message: told.append(message)).handle_failure(ValueError("broken"))
    assert told == ["warnings of devices are no longer reported: broken"]
