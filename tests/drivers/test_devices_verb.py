"""`devices` on device tables made of plain files and on an emulated device: list, claim, permissions, busy devices."""

import fcntl
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from emulators.boards import BOARDS
from helpers.programs import Program
from helpers.shortages import without_rights
from test_hid_emulated import WHY_NOT, run_beside_device

from softfinger.config.errors import DeviceNotFound
from softfinger.config.schema import DeviceConfig
from softfinger.drivers import registry
from softfinger.drivers.forcedimension import library
from softfinger.drivers.system import discovery
from softfinger.drivers.system.claims import Claim, find_claim
from softfinger.drivers.system.diagnosis import Diagnosis, diagnose, diagnose_requirements, suggest_permission_command
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.server.verbs import devices

COMMAND = (sys.executable, "-m", "softfinger.server.cli", "devices")


@pytest.fixture
def root() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        Path(folder).chmod(0o755)
        (Path(folder) / discovery.USB).mkdir(parents=True)
        (Path(folder) / discovery.HIDRAW).mkdir(parents=True)
        yield Path(folder)


@pytest.fixture
def node(root: Path) -> Path:
    path = root / "node"
    path.write_bytes(b"")
    return path


def write(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name).write_text(text + "\n")


def plug_usb(root: Path, name: str, vendor: str, number: str, /, **files: str) -> str:
    """Add a USB device as the kernel lists it, and return its name in the table."""
    write(root / discovery.USB / name, idVendor=vendor, idProduct=number, busnum="1", devnum="7", **files)
    write(root / discovery.USB / f"{name}:1.0", bInterfaceNumber="00")
    return str(discovery.USB / name)


def plug_hid(root: Path, number: int, ids: str, name: str = "Puck") -> str:
    """Add a hidraw node as the kernel lists it, and return its name in the table."""
    write(root / discovery.HIDRAW / f"hidraw{number}" / "device", uevent=f"HID_ID={ids}\nHID_NAME={name}\nHID_UNIQ=SN7")
    return str(discovery.HIDRAW / f"hidraw{number}")


def plug_serial(root: Path, name: str, vendor: str, number: str, serial: str = "", product: str = "Teensy") -> str:
    """Add a USB serial port as the kernel lists it (converters, ttyUSB, in an extra folder); return its name."""
    device = root / "sys/devices/usb1" / f"1-{name}"
    port = device / "1-1:1.0" / (name if name.startswith("ttyUSB") else "")
    port.mkdir(parents=True)
    write(device, idVendor=vendor, idProduct=number, serial=serial, product=product)
    entry = root / discovery.TTY / name
    entry.mkdir(parents=True)
    (entry / "device").symlink_to(port)
    return str(discovery.TTY / name)


def at(node: Path | str, vendor: int = 0x046D, product: int = 0xC626, bus: discovery.Bus = "hid") -> SystemDevice:
    return SystemDevice(bus, vendor, product, "thing", "", str(node))


def test_tables_are_read(root: Path) -> None:
    plug_usb(root, "usb1", "1d6b", "0002", bDeviceClass="09")
    plug_usb(root, "1-1", "2109", "2813", bDeviceClass="09")
    plug_usb(root, "1-1.2", "1451", "0402", bDeviceClass="00", product="omega.x haptic device", serial="0042")
    plug_usb(root, "1-2", "046d", "c626", bDeviceClass="00")
    plug_usb(root, "1-3", "nonsense", "c626")
    plug_hid(root, 10, "0003:0000046D:0000C626")
    plug_hid(root, 2, "0003:000016C0:00000486", "Arm = left")
    plug_hid(root, 3, "damaged")
    plug_usb(root, "1-4", "16c0", "0483", bDeviceClass="02")
    plug_serial(root, "ttyACM0", "16c0", "0483", "SN42")
    plug_serial(root, "ttyUSB0", "0403", "6001")
    for name in ("ttyS0", "tty", "ptmx", "ttyACM7"):  # ports of the machine, and one unplugged while the table was read
        (root / discovery.TTY / name).mkdir()
    assert discovery.list_attached(root) == [
        SystemDevice("hid", 0x16C0, 0x0486, "Arm = left", "SN7", "/dev/hidraw2"),
        SystemDevice("hid", 0x046D, 0xC626, "Puck", "SN7", "/dev/hidraw10"),
        SystemDevice("serial", 0x16C0, 0x0483, "Teensy", "SN42", "/dev/ttyACM0"),
        SystemDevice("serial", 0x0403, 0x6001, "Teensy", "", "/dev/ttyUSB0"),
        SystemDevice("usb", 0x1451, 0x0402, "omega.x haptic device", "0042", "/dev/bus/usb/001/007"),
    ]


def test_unreadable_tables_give_no_devices(root: Path) -> None:
    plug_usb(root, "1-1.2", "1451", "0402", bDeviceClass="00")
    hidden = root / "hidden"
    hidden.mkdir()
    (hidden / "libdrd.so").touch()
    with without_rights((root / "sys", 0), (hidden, 0)):
        assert not discovery.has_usb(root) and discovery.list_names(root) == frozenset()
        assert discovery.list_attached(root) == []
        with pytest.raises(DeviceNotFound, match="the file does not exist"):
            library.load(str(hidden / "libdrd.so"))
        options = {"firmware": str(hidden / "libdrd.so")}
        assert diagnose_requirements(Claim("falcon", "usb", 0x0403, 0xCB48), options).state == "firmware"


@pytest.mark.parametrize(
    ("vendor", "product", "driver", "rig"),
    [
        (0x1451, 0x0402, "forcedimension", "omega-6"),
        (0x1451, 0xFFFF, "forcedimension", "omega-6"),
        (0x16C0, 0x0486, "hid", "woodenhaptics-2019"),
        (0x1234, 0x0006, "hid", "woodenhaptics-2015"),
        (0x16C0, 0x0483, "serial", "woodenhaptics-v3"),
        (0x256F, 0xC63A, "spacemouse", "spacemouse"),
        (0x256F, 0xC631, "spacemouse", "spacemouse"),
    ],
)
def test_devices_are_claimed_by_their_ids(vendor: int, product: int, driver: str, rig: str) -> None:
    claim = find_claim(at("", vendor, product))
    assert claim is not None and claim.driver == driver
    assert rig in claim.rigs


def test_no_driver_claims_a_keyboard() -> None:
    keyboard = at("/dev/null", 0x1234, 0x5678)
    assert find_claim(keyboard) is None and diagnose(keyboard, None).state == "unclaimed"
    assert "docs/devices/hid.md" in diagnose(keyboard, None).remedy


def test_a_node_that_may_be_opened_is_usable(node: Path) -> None:
    assert diagnose(at(node), find_claim(at(node))) == Diagnosis("usable")


def test_missing_nodes_are_diagnosed(root: Path) -> None:
    missing = at(root / "hidraw5")
    assert diagnose(missing, find_claim(missing)).state == "node"
    assert "--device" in diagnose(missing, find_claim(missing)).remedy
    bare = at("/dev/bus/usb/001/002", bus="usb")
    assert diagnose(bare, find_claim(bare)).state == "node"
    assert "usbhid" in diagnose(bare, find_claim(bare)).remedy
    bare = at("/dev/bus/usb/001/002", 0x16C0, 0x0483, bus="usb")
    assert "no serial port" in diagnose(bare, find_claim(bare)).reason
    assert "cdc_acm" in diagnose(bare, find_claim(bare)).remedy


def test_a_teensy_is_not_identified_by_its_ids(node: Path) -> None:
    board = at(node, 0x16C0, 0x0483, bus="serial")
    diagnosis = diagnose(board, find_claim(board))
    assert diagnosis.state == "product"
    assert "its product is 'thing', and 16c0:0483 matches any Teensy" in diagnosis.reason
    assert f'path = "{node}"' in diagnosis.remedy
    assert "Haply" in diagnose(board._replace(name="Teensyduino"), find_claim(board)).remedy
    rig = DeviceConfig(driver="serial", options={"path": str(node)})
    assert diagnose(board, find_claim(board), rig).state == "usable"
    haply = board._replace(name="Haply")
    assert find_claim(haply) == find_claim(board._replace(name="Haply inverse3"))
    claim = find_claim(haply)
    assert claim is not None and (claim.driver, claim.rigs) == ("haply", ("haply-inverse3", "haply-minverse"))


def test_report_descriptors_distinguish_boards_with_equal_ids() -> None:
    teensy, *_ = BOARDS.values()
    raw, debug = (at("", 0x16C0, 0x0486)._replace(descriptor=interface.descriptor) for interface in teensy.interfaces)
    claim = find_claim(raw)
    assert claim is not None and "woodenhaptics-2019" in claim.rigs
    assert find_claim(debug) is None and "another channel of a board" in diagnose(debug, None).reason
    rigs = {}
    for board in ("lpc1768-8", "lpc1768-14"):
        (interface,) = BOARDS[board].interfaces
        claim = find_claim(at("", 0x1234, 0x0006)._replace(descriptor=interface.descriptor))
        rigs[board] = set(claim.rigs)
    assert "woodenhaptics-2015" in rigs["lpc1768-8"] and "woodenhaptics-polhem-v1-lpc1768" in rigs["lpc1768-14"]
    assert not rigs["lpc1768-8"] & rigs["lpc1768-14"]
    unknown = find_claim(at("", 0x1234, 0x0006))
    assert unknown is not None and set(unknown.rigs) == rigs["lpc1768-8"] | rigs["lpc1768-14"]


def test_an_arm_without_a_hidraw_node(root: Path) -> None:
    """Threads transfer the reports if the node on the bus can be opened; otherwise the remedy is about that node."""
    node = root / "002"
    arm = at(node, 0x16C0, 0x0486, bus="usb")
    assert diagnose(arm, find_claim(arm)).state == "node"
    assert f"docker run --device {node}" in diagnose(arm, find_claim(arm)).remedy
    node.write_bytes(b"")
    diagnosis = diagnose(arm, find_claim(arm))
    assert diagnosis.state == "usable" and "no hidraw node" in diagnosis.reason
    assert "install --system " in suggest_permission_command(at("", 0x16C0, 0x0486, bus="usb"))
    with node.open("rb") as locked_file:
        fcntl.flock(locked_file, fcntl.LOCK_EX)
        assert diagnose(arm, find_claim(arm)).state == "busy"


@pytest.mark.parametrize(
    ("mode", "group", "vendor", "product", "bus", "remedy"),
    [
        (0o600, 0, 0x046D, 0xC626, "hid", "install --system   # then plug the device in again"),
        (0o660, 20, 0x046D, 0xC626, "hid", "usermod -aG dialout"),
        (0o640, 20, 0x1451, 0xC626, "usb", "install --system "),
        (0o660, 20, 0x16C0, 0x0483, "serial", "usermod -aG dialout"),
        (0o600, 0, 0x16C0, 0x0483, "serial", "install --system "),
    ],
)
@pytest.mark.skipif(os.geteuid() != 0, reason="gives a file to another user's group, which only root may do")
def test_permission_is_diagnosed(node, mode, group, vendor, product, bus, remedy):
    os.chown(node, 0, group)
    device = at(node, vendor, product, bus)
    registry.load("forcedimension")  # its rule is printed; the other user has no cache to compile it into
    with without_rights((node, mode)):
        diagnosis = diagnose(device, find_claim(device))
    assert diagnosis.state == "permission" and str(node) in diagnosis.reason
    assert remedy in diagnosis.remedy


def test_a_holder_is_named(node: Path) -> None:
    code = "import sys; kept = open(sys.argv[1]); print('open', flush=True); sys.stdin.read()"
    with Program(
        [sys.executable, "-c", code, str(node)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stdin is not None
        assert process.stdout.readline() == "open\n"
        diagnosis = diagnose(at(node), find_claim(at(node)))
        assert diagnosis.state == "busy" and f"process {process.pid} (python" in diagnosis.reason
        assert diagnosis.remedy == f"kill {process.pid}"
        process.stdin.close()
        process.wait(10)
    assert discovery.find_holder(str(node)) is None
    with node.open("rb") as locked_file:
        fcntl.flock(locked_file, fcntl.LOCK_EX)
        holder = discovery.find_holder(str(node))
        assert holder is not None and holder.pid == os.getpid()


def test_a_lock_in_another_file_system_names_no_holder(node: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Inodes are unique in one file system only; a wrong holder would be in the remedy, `kill PID`."""
    locks, inode = node.with_name("locks"), node.stat().st_ino
    locks.write_text(f"1: FLOCK  ADVISORY  WRITE {os.getpid()} ff:fffff:{inode} 0 EOF\n")
    monkeypatch.setattr(discovery, "Path", lambda path: locks if path == "/proc/locks" else Path(path))
    assert discovery.find_holder(str(node)) is None


def test_a_missing_library_is_diagnosed(node: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("FDSDK", "FORCEDIM_SDK"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(node.parent))
    omega = at(node, 0x1451, 0x0402, bus="usb")
    diagnosis = diagnose(omega, find_claim(omega))
    assert diagnosis.state == "library" and "libdrd was not found" in diagnosis.reason
    assert "export FDSDK=" in diagnosis.remedy
    named = DeviceConfig(driver="forcedimension", options={"library_file": "/no/libdrd.so.9"})
    assert "libdrd.so.9': the file does not exist" in diagnose(omega, find_claim(omega), named).reason


def test_a_falcon_needs_its_firmware(root: Path) -> None:
    claim = Claim("falcon", "usb", 0x0403, 0xCB48)
    file = root / "firmware.bin"
    assert "no rig sets one" in diagnose_requirements(claim, {}).reason
    diagnosis = diagnose_requirements(claim, {"firmware": str(file)})
    assert diagnosis.state == "firmware" and "firmware.bin' is not a file" in diagnosis.reason
    file.write_bytes(b"\0")
    assert diagnose_requirements(claim, {"firmware": str(file)}).state == "usable"


def test_output_without_devices() -> None:
    text = devices.format_lines([])
    assert len(text) == 1 and text[0].startswith("no USB or HID device is attached")
    assert "--rig simulated" in text[0]


@pytest.mark.system
@pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))
@pytest.mark.parametrize(
    ("bus", "node", "reason"),
    [("hidraw", "/dev/hidraw0", ""), ("usb", "/dev/bus/usb/001/002", "threads transfer its reports")],
)
def test_an_emulated_device_is_listed(bus: str, node: str, reason: str) -> None:
    case = {"bus": bus, "arm": "woody-2019", "generation": 2}
    result, saw = run_beside_device(case, *COMMAND, "--json", code=0)
    (device,) = json.JSONDecoder().raw_decode(result.stdout)[0]["devices"]
    assert (device["bus"], device["node"]) == ("hid" if bus == "hidraw" else "usb", node)
    assert (device["name"], device["serial"]) == ("Emulated arm", "SN42")
    assert (device["vendor_id"], device["product_id"]) == ("16c0", "0486")
    assert (device["driver"], device["state"]) == ("hid", "usable") and reason in device["reason"]
    assert "woodenhaptics-2019" in device["rigs"]
    assert saw["reports"] == 0, "a look sends nothing to the device"
    result, _ = run_beside_device(case, *COMMAND)
    ids = f"{node}  16c0:0486  Emulated arm\n    driver hid: softfinger run --rig woodenhaptics-2019"
    assert ids in result.stdout
