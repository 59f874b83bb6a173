"""Memory that the exchange of a serial port shares with Python, after the fields of `described_board`."""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple

from softfinger.drivers.block import address, counter, lay_out, numbers, raw_bytes, word
from softfinger.drivers.described_board import DESCRIBED
from softfinger.drivers.fields.table import SENSED_SIZE
from softfinger.drivers.serial.frames import LOOKBACK

CHUNK: Final = 1024
"""Bytes per read."""
TEXT: Final = -1
"""Kind, in place of a mechanism's, of a board that computes its kinematics and sends WoodenHaptics' text."""


class Fields(NamedTuple):
    """Fields of this driver, after the fields of `described_board`."""

    bytes: Annotated[int, counter("bytes received")]
    frames: Annotated[int, counter("frames received")]
    drained: Annotated[int, counter("of these, skipped because a newer one had arrived")]
    written: Annotated[int, counter("frames sent")]
    held: Annotated[int, counter("forces not sent because the last frame was not answered")]
    kicks: Annotated[int, counter("newlines sent because no data arrived")]
    blocked: Annotated[int, counter("forces withheld because more than two frames were queued in the port")]
    answer_bytes: Annotated[int, word("bytes of an answer, valid or not; 0: the device does not answer")]
    bytes_at_send: Annotated[
        int, word("`bytes` when the last frame was sent; `answer_bytes` or more since then are its answer")
    ]
    newline: Annotated[int, word("report that wakes WoodenHaptics")]
    ioctl_scratch: Annotated[int, word("result of an ioctl: bytes in a queue of the port")]
    dropped: Annotated[int, counter("number of times that unsent frames were discarded")]
    counts_unsent: Annotated[int, word("whether the system counts unsent bytes of the port")]
    frame_units: Annotated[int, word("count of the system for a frame, if larger than its bytes")]
    writes: Annotated[int, word("writes since the queue was empty")]
    queued_bytes: Annotated[int, word("bytes of these writes")]
    blocked_since: Annotated[int, word("time since which the queue is too long, ns; 0 while it is short")]
    blocked_at: Annotated[int, word("time at which the queue was last too long, ns")]
    maybe_torn: Annotated[int, word("whether a frame may have been truncated, so that the next would complete it")]
    by_length: Annotated[int, word("whether an answer is recognised only by its length")]
    stream_bytes: Annotated[int, word("bytes in `stream` that may belong to a frame")]
    in_shape: Annotated[int, address("format of input frames, see `packets`")]
    out_shape: Annotated[int, address("format of output frames")]
    stream: Annotated[int, address("received bytes, with described frames")]
    outgoing: Annotated[int, address("resync bytes and the last frame sent")]
    out_bytes: Annotated[int, word("bytes of an output frame")]
    out_total: Annotated[int, word("the same with the resync bytes before it")]
    scratch: Annotated[int, numbers("values of the frame being read; text has fewer", SENSED_SIZE)]
    incoming: Annotated[
        int, raw_bytes("last text read, preceded by earlier text that may belong to it", LOOKBACK + CHUNK)
    ]


AT: Final = lay_out(Fields, after=DESCRIBED)
