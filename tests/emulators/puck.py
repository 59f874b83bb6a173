"""Reports of a 3Dconnexion puck for deflections by a hand; axes as published, independent of the driver.

Published: report 1 is int16 x, y, z, report 2 the rotation, or report 1 all six; x = +w0, y = -w1, z = -w2 are to the
right, away from the user and up; pitch = -w3 is nose down, roll = -w4 to the right, yaw = +w5 clockwise from above.
"""

import struct

LED = {b"\x04\x01": True, b"\x04\x00": False}


def words(
    right: int = 0, away: int = 0, up: int = 0, nose_down: int = 0, roll_right: int = 0, clockwise: int = 0
) -> tuple[int, ...]:
    return right, -away, -up, -nose_down, -roll_right, clockwise


def split(**deflection: int) -> list[bytes]:
    w = words(**deflection)
    return [struct.pack("<B3h", 1, *w[:3]), struct.pack("<B3h", 2, *w[3:])]


def combined(**deflection: int) -> list[bytes]:
    return [struct.pack("<B6h", 1, *words(**deflection))]


def buttons(mask: int) -> bytes:
    return struct.pack("<BI", 3, mask)
