"""A device's memory block: no two fields overlap, kernels and Python address the same data, and counters are listed."""

from __future__ import annotations

import gc
from typing import Annotated, Any, Final, NamedTuple

import numpy as np

from softfinger.drivers.block import Block, address, counter, lay_out, numbers, raw_bytes, read_fields, word
from softfinger.drivers.board_exchange import BOARD
from softfinger.drivers.described_board import DESCRIBED
from softfinger.drivers.hid import exchange as hid
from softfinger.drivers.serial import exchange as serial
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at, uint8_at
from softfinger.proxy.kernels.jit.pack import flatten, unpack_at


class Front(NamedTuple):
    ready: Annotated[int, word("whether it is")]
    sample: Annotated[int, numbers("the last one", 3)]


class Own(NamedTuple):
    came: Annotated[int, counter("what came")]
    text: Annotated[int, raw_bytes("what it said", 9)]
    lost: Annotated[int, counter("what did not")]
    table: Annotated[int, address("rows")]


class Leaves(NamedTuple):
    pair: tuple[float, float]
    one: float


FRONT: Final = lay_out(Front)
AT: Final = lay_out(Own, after=FRONT)
LIKE: Final = Leaves((0.0, 0.0), 0.0)


@entry
def _fill(handle: int) -> float:
    at = int64_at(handle)
    at[FRONT.ready] = 7
    at[AT.came] += 2
    at[AT.lost] += 5
    uint8_at(handle + 8 * AT.text)[8] = 65
    sample = unpack_at(LIKE, handle + 8 * FRONT.sample)
    return float(float64_at(at[AT.table])[1] + sample.pair[0] + 10.0 * sample.pair[1] + 100.0 * sample.one)


def occupied_words(layouts: tuple[Any, ...]) -> list[int]:
    return [
        at + k
        for layout in layouts
        for at, place in zip(layout, read_fields(type(layout)).values(), strict=True)
        for k in range(place.word_count)
    ]


def test_layouts_do_not_overlap() -> None:
    for layouts in ((FRONT, AT), (BOARD, DESCRIBED, serial.AT), (BOARD, DESCRIBED, hid.AT)):
        assert occupied_words(layouts) == list(range(len(Block(*layouts).word)))


def test_every_field_has_a_description() -> None:
    for layout in (BOARD, DESCRIBED, serial.AT, hid.AT):
        assert all(place.doc for place in read_fields(type(layout)).values())


def test_kernels_and_python_address_the_same_data() -> None:
    block = Block(FRONT, AT)
    block.set_address(AT.table, np.array([0.5, 0.25]))
    gc.collect()  # only the block references the table now
    block.numbers(FRONT.sample, 3)[:] = flatten(Leaves((1.0, 2.0), 3.0))
    assert _fill(block.handle) == 0.25 + 1.0 + 20.0 + 300.0
    assert block.word[FRONT.ready] == 7
    assert block.raw_bytes(AT.text, 9).tolist() == [0] * 8 + [65]
    assert list(block.counts().items()) == [("came", 2), ("lost", 5)]
