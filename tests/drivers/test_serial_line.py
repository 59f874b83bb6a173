"""Refusal of rigs with frames that do not fit the baud rate, by `check` and before a port is opened."""

import re
from contextlib import nullcontext
from pathlib import Path

import pytest
from helpers.described_boards import rig_options

from softfinger.config.errors import ConfigError, DeviceNotFound
from softfinger.config.load import load_rig
from softfinger.config.schema import Rig
from softfinger.config.sources import find, list_shipped
from softfinger.drivers import registry
from softfinger.drivers.serial import port
from softfinger.server.cli import main

pytestmark = pytest.mark.plain

SERIAL = [name for name in list_shipped(Rig) if 'driver = "serial"' in find(name, Rig).read_text()]


@pytest.mark.parametrize("rig", SERIAL)
def test_shipped_rigs_fit(rig: str) -> None:
    config = load_rig(rig)
    registry.check(config.device, config.servo.rate_hz)


@pytest.mark.parametrize(
    ("changes", "rate_hz", "says"),
    [
        # 6 bytes from the board are the longer of the two: 6 x 160 = 960
        ({"baud": 9600}, 160.0, ""),
        (
            {"baud": 9600}, 161.0,
            r"rig\.baud = 9600: the line carries 960 bytes/s each way, as a byte takes 10 bits \(8N1: .*\); a tick "
            r"sends 4 bytes and receives 6, so servo\.rate_hz = 161 needs 644 bytes/s to the board and 966 from it, "
            r".*: set baud to 19200 or more, .*lower servo\.rate_hz, .*, to 160 Hz, or shorten the frames",
        ),
        ({"baud": 115200}, 1921.0, "set baud to 230400 or more"),
        # ttyACM is the USB port of a board, ttyUSB and ttyS are lines
        ({"baud": 9600, "path": "/dev/ttyACM0"}, 1000.0, ""),
        ({"baud": 9600, "path": "/dev/ttyUSB0"}, 1000.0, "960 bytes/s"),
        # by its vendor: FTDI, and Teensy
        ({"baud": 9600, "vendor_id": 0x0403, "product_id": 0x6001}, 1000.0, "960 bytes/s"),
        ({"baud": 9600, "vendor_id": 0x16C0, "product_id": 0x0483}, 1000.0, ""),
    ],
)  # fmt: skip
def test_frames_are_compared_with_the_line_rate(changes: dict[str, object], rate_hz: float, says: str) -> None:
    with pytest.raises(ConfigError, match=says) if says else nullcontext():
        port.check(rig_options("hapkit", **changes), rate_hz, "rig")


def test_check_and_run_reject_a_slow_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = find("hapkit", Rig).read_text()
    slow, fits = tmp_path / "slow.toml", tmp_path / "fits.toml"
    slow.write_text(re.sub(r"^baud = 115200", "baud = 9600", text, flags=re.MULTILINE))
    fits.write_text(text)
    assert main(["check", str(fits)]) == 0 and main(["check", str(slow)]) == 2
    assert f"{slow} [device].baud = 9600: the line carries 960 bytes/s" in capsys.readouterr().err
    for rig in (load_rig(slow), load_rig(fits, {"servo.rate_hz": 4000.0})):
        with pytest.raises(ConfigError, match=r"^\[device\]\.baud = .* bytes/s each way"):
            registry.open_device(rig.device, rig.servo.rate_hz)
    with pytest.raises(DeviceNotFound, match="the rig does not set a port: set path under"):
        registry.open_device(load_rig(fits).device, 1000.0)
