"""Block of memory that a Falcon's C functions share with Python; its address is the device's handle."""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple

from softfinger.drivers.base import SAMPLE_SIZE
from softfinger.drivers.block import address, counter, lay_out, numbers, raw_bytes, word
from softfinger.drivers.falcon import packets
from softfinger.drivers.system.libc import TIMESPEC_WORDS

IN_BYTES: Final = 64


class Fields(NamedTuple):
    """Fields of the block."""

    replies: Annotated[int, counter("complete packets received")]
    passed: Annotated[int, counter("of these, older ones passed over for a newer")]
    written: Annotated[int, counter("packets sent")]
    held: Annotated[int, counter("forces not sent, because an answer or the bus was late")]
    kicks: Annotated[int, counter("zeros sent into a silence")]
    cut: Annotated[int, counter("forces that the motors could not give")]
    garbled: Annotated[int, counter("pieces of the stream that were no packet")]
    unreached: Annotated[int, counter("encoder counts to which no place of the knob belongs")]
    fillers: Annotated[int, counter("replies with another byte than 'A' before the last (it has no meaning)")]
    # settings
    context: Annotated[int, address("libusb's")]
    submit: Annotated[int, address("libusb's function")]
    handle_events: Annotated[int, address("the same")]
    cancel: Annotated[int, address("the same")]
    transfer_in: Annotated[int, address("the transfer in")]
    transfer_out: Annotated[int, address("the transfer out")]
    kick: Annotated[int, word("ns of silence")]
    timeout_after: Annotated[int, word("ns of silence")]
    lights: Annotated[int, word("bits of the state byte, including the homing request")]
    # written by several threads
    open: Annotated[int, word("whether libusb may be called")]
    armed: Annotated[int, word("whether a force may go out")]
    stopped: Annotated[int, word("permanent: a later or a concurrent `arm` has no effect")]
    lock: Annotated[int, word("lock: set during each exchange")]
    # state of the exchange
    in_done: Annotated[int, word("set by libusb's call back; together with the next, each transfer's user data")]
    out_done: Annotated[int, word("the same")]
    unanswered: Annotated[int, word("packets without an answer")]
    has_force: Annotated[int, word("whether the last packet sent was a force")]
    has_sample: Annotated[int, word("whether there is a sample to repeat")]
    homed: Annotated[int, word("bits of the last reply")]
    was_homed: Annotated[int, word("the bits were set without the homing request, so their loss is an error")]
    sampled_at: Annotated[int, word("time of the latest reply, ns")]
    read_at: Annotated[int, word("ns, when the loop last read")]
    sent_at: Annotated[int, word("ns")]
    opened_at: Annotated[int, word("ns")]
    fill: Annotated[int, word("bytes in PACKET")]
    error: Annotated[int, word("libusb's, at the failure")]
    stale_replies: Annotated[int, word("replies still to come that answer packets of before a pause of the loop")]
    sent_own_zero: Annotated[int, word("a zero went out that the loop did not command, since the last read")]
    # buffers and values
    packet: Annotated[int, raw_bytes("being put together", packets.SIZE)]
    newest: Annotated[int, raw_bytes("the latest reply", packets.SIZE)]
    timespec: Annotated[int, numbers("for the clock, also a struct timeval", TIMESPEC_WORDS)]
    counts: Annotated[int, numbers("of the latest reply", 3)]
    position: Annotated[int, numbers("m, device's frame", 3)]
    centre: Annotated[int, numbers("m, device's frame", 3)]
    gain: Annotated[int, numbers("motor counts per N m", 1)]
    buffer_in: Annotated[int, raw_bytes("of the transfer in", IN_BYTES)]
    buffer_out: Annotated[int, raw_bytes("of the transfer out", packets.SIZE)]
    sample: Annotated[int, numbers("the last one", SAMPLE_SIZE)]


AT: Final = lay_out(Fields)
