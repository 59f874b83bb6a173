"""Serial port of a device: search by ids, exclusive opening, errors with instructions."""

import os
import sys
from pathlib import Path

import pytest
from helpers.programs import run_program
from helpers.serial_devices import board, opened, rig_options
from helpers.shortages import without_rights
from test_devices_verb import plug_serial

from softfinger.config.errors import DeviceBusy, DeviceError, DeviceNotFound
from softfinger.drivers.serial import port
from softfinger.drivers.serial.device import open_device
from softfinger.drivers.system import discovery


def test_ports_that_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(DeviceNotFound, match=r"ttyACM9 cannot be opened: No such file.*plug"):
        open_device(rig_options(path=str(tmp_path / "ttyACM9")), 1000.0)
    for path in ("/dev/null", str(tmp_path / "file")):
        (tmp_path / "file").write_bytes(b"")
        with pytest.raises(DeviceError, match=f"{path} is not a serial port: use a /dev/ttyACMN"):
            open_device(rig_options(path=path), 1000.0)
    with board() as (_, _, cable):
        with pytest.raises(DeviceBusy, match=rf"{cable.path} is used by process {os.getpid()} \("):
            opened(cable)
        command = [sys.executable, "-c", OPEN, cable.path]
        process = run_program(command, check=True)
        assert process.stdout == f"DeviceBusy {cable.path} is used by process {os.getpid()}\n"
        # TIOCEXCL also excludes programs without a lock, unless they run as root.
        mine = rig_options(path=cable.path)
        with without_rights((Path(cable.path), 0o666)):
            with pytest.raises(OSError, match="Device or resource busy"):
                os.open(cable.path, os.O_RDWR | os.O_NOCTTY)
            with pytest.raises(DeviceBusy, match=rf"{cable.path} is used by process {os.getpid()} \("):
                port.open_port(mine)


OPEN = """
import sys
from softfinger.config.load import build, load_rig
from softfinger.drivers.serial import port
from softfinger.drivers.serial.device import Options
options = {**load_rig("woodenhaptics-v3").device.options, "path": sys.argv[1]}
try:
    port.open_port(build(Options, options, "rig"))
except Exception as error:
    print(type(error).__name__, str(error).split(" (")[0])
"""


def test_the_port_is_found_by_its_ids(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ports, original = discovery.iter_serial_ports, discovery.find_serial_port
    monkeypatch.setattr(discovery, "iter_serial_ports", lambda: ports(tmp_path))
    monkeypatch.setattr(discovery, "find_serial_port", lambda path: original(path, tmp_path))
    with pytest.raises(DeviceNotFound, match=r"no serial port 16c0:0483 is attached: .*; no USB serial port is"):
        port.find_port(rig_options())
    plug_serial(tmp_path, "ttyUSB0", "0403", "6001")
    (tmp_path / discovery.TTY / "ttyS0").mkdir()
    with pytest.raises(DeviceNotFound, match=r"; attached are Teensy \(0403:6001\) at /dev/ttyUSB0$"):
        port.find_port(rig_options())
    plug_serial(tmp_path, "ttyACM1", "16c0", "0483", "SN42")
    assert port.find_port(rig_options(serial="SN42")) == "/dev/ttyACM1"
    with pytest.raises(DeviceNotFound, match=r"has the serial number 'SN43': attached are 'SN42'"):
        port.find_port(rig_options(serial="SN43"))
    plug_serial(tmp_path, "ttyACM0", "16c0", "0483", "SN43")
    assert port.find_port(rig_options(serial="SN43")) == "/dev/ttyACM0"
    with pytest.raises(
        DeviceNotFound, match=r"2 serial ports are 16c0:0483: select one with serial or path: /dev/ttyACM0"
    ):
        port.find_port(rig_options())
    with pytest.raises(
        DeviceError, match=r"/dev/ttyUSB0 is the device 0403:6001 \(Teensy\), but the rig is for 16c0:0483"
    ):
        port.open_port(rig_options(path="/dev/ttyUSB0"))


def test_a_teensy_is_not_identified_by_its_ids(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ports, original = discovery.iter_serial_ports, discovery.find_serial_port
    monkeypatch.setattr(discovery, "iter_serial_ports", lambda: ports(tmp_path))
    monkeypatch.setattr(discovery, "find_serial_port", lambda path: original(path, tmp_path))
    plug_serial(tmp_path, "ttyACM0", "16c0", "0483", "SN1", product="Haply inverse3")
    with pytest.raises(DeviceNotFound, match=r"no serial port 16c0:0483 is .*; attached are a Haply Inverse3 "):
        port.find_port(rig_options())
    with pytest.raises(DeviceNotFound):
        port.find_port(rig_options(serial="SN1"))
    with pytest.raises(DeviceError, match=r"/dev/ttyACM0 is a Haply Inverse3 \('Haply inverse3'\), which"):
        port.open_port(rig_options(path="/dev/ttyACM0"))
    plug_serial(tmp_path, "ttyACM1", "16c0", "0483", "SN2", product="USB Serial")
    message = r"/dev/ttyACM1 may be another device: its product is 'USB Serial', .*path = \"/dev/ttyACM1\" under"
    with pytest.raises(DeviceNotFound, match=message):
        port.find_port(rig_options())
    assert port.find_port(rig_options(serial="SN2")) == "/dev/ttyACM1"
    plug_serial(tmp_path, "ttyUSB0", "0403", "6001")
    assert port.find_port(rig_options(vendor_id=0x0403, product_id=0x6001)) == "/dev/ttyUSB0"
