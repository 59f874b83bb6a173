"""Boards of these arms by their makers' sources: USB ids, HID interfaces, report descriptors.

Teensy: PJRC's cores, teensy4/usb_desc.h and usb_desc.c, type USB_RAWHID: product "Teensyduino RawHID", interface 0 with
reports of 64 bytes both ways on usage page 0xFFAB, usage 0x0200, and interface 1, which emulates a serial port for
debugging, with 64 bytes in, 32 out and a feature of 4 on usage page 0xFFC9, usage 4.

LPC1768: mbed's USBHID, with default ids 1234:0006 and one interface on the same usage page and usage as a Teensy's
first: `USBHID hid(14, 14)` in haptikfabrikenapi, firmware/main.cpp, and `USBHID hid(8, 8)` in woody-experimental,
mbed-code. Independent of the driver.
"""

from typing import NamedTuple


class Interface(NamedTuple):
    descriptor: bytes
    end_in: int
    end_out: int
    bytes_in: int
    bytes_out: int


class Board(NamedTuple):
    vendor: int
    product: int
    name: str
    interfaces: tuple[Interface, ...]
    arm: int = 0


def raw_hid(size: int) -> bytes:
    head = bytes.fromhex("06abff 0a0002 a101 7508 1500 26ff00")
    return head + bytes([0x95, size, 0x09, 0x01, 0x81, 0x02, 0x95, size, 0x09, 0x02, 0x91, 0x02, 0xC0])


def serial_emulation() -> bytes:
    return bytes.fromhex("06c9ff 0904 a15c 7508 1500 26ff00 9540 0975 8102 9520 0976 9102 9504 0976 b102 c0")


RAW = Interface(raw_hid(64), 0x83, 0x04, 64, 64)
DEBUG = Interface(serial_emulation(), 0x82, 0x02, 64, 32)
BOARDS = {
    "teensy": Board(0x16C0, 0x0486, "Teensyduino RawHID", (RAW, DEBUG)),
    # the system may list the nodes in the other order
    "teensy-swapped": Board(0x16C0, 0x0486, "Teensyduino RawHID", (DEBUG, RAW), 1),
    "lpc1768-14": Board(0x1234, 0x0006, "HID DEVICE", (Interface(raw_hid(14), 0x81, 0x01, 64, 64),)),
    "lpc1768-8": Board(0x1234, 0x0006, "HID DEVICE", (Interface(raw_hid(8), 0x81, 0x01, 64, 64),)),
}
