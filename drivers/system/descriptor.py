"""Lengths of the reports that a HID report descriptor announces.

Source: Device Class Definition for Human Interface Devices 1.11, section 6.2.2.
"""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

Kind = Literal["input", "output"]

_MAIN: Final[dict[int, Kind]] = {0x80: "input", 0x90: "output"}
_REPORT_SIZE, _REPORT_ID, _REPORT_COUNT, _PUSH, _POP = 0x74, 0x84, 0x94, 0xA4, 0xB4
_LONG: Final = 0xFE


class ReportLengths(NamedTuple):
    """Report lengths in bytes without the id, by id (0: reports without id)."""

    input: dict[int, int]
    output: dict[int, int]

    def includes(self, required: ReportLengths) -> bool:
        """Return True if every report of `required` is included with the same length."""
        return required.input.items() <= self.input.items() and required.output.items() <= self.output.items()

    def __str__(self) -> str:
        return f"input {_format_lengths(self.input)}, output {_format_lengths(self.output)}"


def parse_descriptor(descriptor: bytes) -> ReportLengths:
    """Return the reports of a descriptor. Raises ValueError if its last item is incomplete."""
    bits: dict[Kind, dict[int, int]] = {"input": {}, "output": {}}
    size = count = number = 0
    stack: list[tuple[int, int, int]] = []
    at = 0
    while at < len(descriptor):
        prefix = descriptor[at]
        if prefix == _LONG:
            at += 3 + descriptor[at + 1] if at + 1 < len(descriptor) else 3
            continue
        length = (0, 1, 2, 4)[prefix & 3]
        data = descriptor[at + 1 : at + 1 + length]
        if len(data) != length:
            raise ValueError(f"item 0x{prefix:02x} at byte {at} of {len(descriptor)} is truncated")
        value, tag = int.from_bytes(data, "little"), prefix & 0xFC
        if tag in _MAIN:
            lengths = bits[_MAIN[tag]]
            lengths[number] = lengths.get(number, 0) + size * count
        elif tag == _REPORT_SIZE:
            size = value
        elif tag == _REPORT_ID:
            number = value
        elif tag == _REPORT_COUNT:
            count = value
        elif tag == _PUSH:
            stack.append((size, count, number))
        elif tag == _POP and stack:
            size, count, number = stack.pop()
        at += 1 + length
    lengths_in, lengths_out = ({n: (b + 7) // 8 for n, b in bits[kind].items()} for kind in ("input", "output"))
    return ReportLengths(lengths_in, lengths_out)


def _format_lengths(lengths: dict[int, int]) -> str:
    if not lengths:
        return "none"
    return " and ".join(f"{length} bytes" + (f" with id {n}" if n else "") for n, length in sorted(lengths.items()))
