"""`check` finds a recording that a device of a rig cannot play, which `run` would find when it opens the device."""

from __future__ import annotations

from pathlib import Path

import pytest

from softfinger.server.verbs.check import examine_file

pytestmark = pytest.mark.plain


@pytest.mark.parametrize("recording", ["", ".", "nothing", "none.csv", "/dev/zero"])
@pytest.mark.parametrize("driver", ["replay", "simulated"])
def test_an_unusable_recording_is_a_fault_of_the_rig(driver: str, recording: str, tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(f'[device]\ndriver = "{driver}"\nrecording = "{recording}"\n')
    (fault,) = examine_file(str(rig)).errors
    assert "device.recording: " in fault and recording in fault
