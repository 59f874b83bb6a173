"""Memory that the exchange of a serial port shares with Python, after the fields of `board_exchange`."""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple

from softfinger.drivers.block import address, counter, lay_out, numbers, raw_bytes, word
from softfinger.drivers.board_exchange import BOARD
from softfinger.drivers.fields.table import COMMANDED_SIZE, SENSED_SIZE
from softfinger.drivers.kinematics.mechanism import NO_MECHANISM, Mechanism
from softfinger.drivers.serial.frames import LOOKBACK, NUMBERS
from softfinger.proxy.kernels.jit.pack import flatten
from softfinger.proxy.kernels.model import Quaternion, Vec3

CHUNK: Final = 1024
"""Bytes per read."""
TEXT: Final = -1
"""Kind, in place of a mechanism's, of a board that computes its kinematics and sends WoodenHaptics' text."""


class FrameConversion(NamedTuple):
    """Parameters of the conversion between frames and poses or forces.

    position     (3,) m  device's origin in the world
    orientation  (4,)    device to world
    force_max    N
    mechanism    of a described board
    """

    position: Vec3
    orientation: Quaternion
    force_max: float
    mechanism: Mechanism


MODEL_LIKE: Final = FrameConversion((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.0, NO_MECHANISM)
MODEL_SIZE: Final = len(flatten(MODEL_LIKE))


class Fields(NamedTuple):
    """Fields of this driver, after the fields of `board_exchange`."""

    bytes: Annotated[int, counter("bytes received")]
    frames: Annotated[int, counter("frames received")]
    drained: Annotated[int, counter("of these, older ones passed over for a newer")]
    written: Annotated[int, counter("frames sent")]
    held: Annotated[int, counter("forces not sent, because the last frame had no answer")]
    kicks: Annotated[int, counter("newlines sent into a silence")]
    blocked: Annotated[int, counter("times the port had more than two frames to send, and the force was withheld")]
    cut: Annotated[int, counter("forces past the largest")]
    singular: Annotated[
        int, counter("forces that were less, and samples without a place, because the mechanism is singular there")
    ]
    kind: Annotated[int, word("of the mechanism, or TEXT")]
    has_orientation: Annotated[int, word("whether an orientation is sensed")]
    answer_bytes: Annotated[
        int, word("bytes of an answer, whether they can be understood or not; 0: nothing is answered")
    ]
    bytes_at_send: Annotated[
        int, word("`bytes` when the last frame was sent; `answer_bytes` or more since then are its answer")
    ]
    newline: Annotated[int, word("report that wakes WoodenHaptics")]
    ioctl_scratch: Annotated[int, word("bytes that the system has for this driver")]
    dropped: Annotated[int, counter("times that frames were dropped that the port had not sent, at the stop or before")]
    counts_unsent: Annotated[int, word("whether the system counts the bytes that the port has not sent")]
    frame_units: Annotated[int, word("its count for a frame, if larger than the bytes")]
    writes: Annotated[int, word("writes since it counted none")]
    queued_bytes: Annotated[int, word("bytes of these")]
    blocked_since: Annotated[int, word("time at which the queue became too long, ns; 0 while it is short")]
    blocked_at: Annotated[int, word("ns, when it last did")]
    maybe_torn: Annotated[int, word("whether a frame may have been truncated, so that the next would complete it")]
    by_length: Annotated[int, word("whether an answer is recognised only by its length")]
    stream_bytes: Annotated[int, word("bytes in `stream` that may belong to a frame")]
    in_shape: Annotated[int, address("a shape of `packets`")]
    out_shape: Annotated[int, address("the same")]
    in_rows: Annotated[int, word("fields of a frame")]
    out_rows: Annotated[int, word("the same")]
    in_table: Annotated[int, address("(in_rows, ROW) float64")]
    out_table: Annotated[int, address("(out_rows, ROW) float64")]
    stream: Annotated[int, address("bytes of frames that are described")]
    outgoing: Annotated[int, address("resync bytes and the last frame sent")]
    out_bytes: Annotated[int, word("of a frame sent")]
    out_total: Annotated[int, word("with the resync bytes in front of it")]
    scratch_word: Annotated[int, word("of a field being read or written")]
    model: Annotated[int, numbers("a `FrameConversion`", MODEL_SIZE)]
    last_position: Annotated[int, numbers("m, where a delta was", 3)]
    scratch: Annotated[int, numbers("of a frame being read", max(NUMBERS, SENSED_SIZE))]
    values: Annotated[int, numbers("of the latest frame", max(NUMBERS, SENSED_SIZE))]
    command_values: Annotated[int, numbers("of the frame being written", COMMANDED_SIZE)]
    incoming: Annotated[int, raw_bytes("text read last, and in front of it what may belong to it", LOOKBACK + CHUNK)]


AT: Final = lay_out(Fields, after=BOARD)
