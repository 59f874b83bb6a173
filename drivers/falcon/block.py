"""Block of memory that a Falcon's C functions share with Python; its address is the device's handle."""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple

from softfinger.drivers.base import SAMPLE_SIZE
from softfinger.drivers.block import address, counter, function, lay_out, numbers, raw_bytes, word
from softfinger.drivers.falcon import packets
from softfinger.drivers.system.libc import TIMESPEC_WORDS


class Fields(NamedTuple):
    """Fields of the block."""

    replies: Annotated[int, counter("complete packets received")]
    passed: Annotated[int, counter("of these, skipped because a newer one had arrived")]
    written: Annotated[int, counter("packets sent")]
    held: Annotated[int, counter("forces not sent, because an answer or the bus was late")]
    kicks: Annotated[int, counter("zeros sent because no reply arrived")]
    cut: Annotated[int, counter("forces above the limit of the motors")]
    garbled: Annotated[int, counter("invalid packets in the stream")]
    unreached: Annotated[int, counter("encoder counts outside the reach of the mechanism")]
    fillers: Annotated[int, counter("replies whose second to last byte is not 'A'; it has no meaning")]
    # settings
    context: Annotated[int, address("libusb's context")]
    submit: Annotated[int, function("libusb_submit_transfer")]
    handle_events: Annotated[int, function("libusb_handle_events_timeout_completed")]
    cancel: Annotated[int, function("libusb_cancel_transfer")]
    transfer_in: Annotated[int, address("transfer from the device")]
    transfer_out: Annotated[int, address("transfer to the device")]
    kick: Annotated[int, word("time without a reply after which zeros are sent, ns")]
    timeout_after: Annotated[int, word("time without a reply after which the device counts as lost, ns")]
    lights: Annotated[int, word("bits of the state byte, including the homing request")]
    # written by several threads
    open: Annotated[int, word("whether libusb may be called")]
    armed: Annotated[int, word("whether forces may be sent")]
    stopped: Annotated[int, word("permanent: a later or concurrent `arm` has no effect")]
    lock: Annotated[int, word("lock: set during each exchange")]
    # state of the exchange
    in_done: Annotated[int, word("set by the callback of libusb; user data of the transfer")]
    out_done: Annotated[int, word("the same for the transfer to the device")]
    unanswered: Annotated[int, word("packets without an answer")]
    has_force: Annotated[int, word("whether the last packet sent was a force")]
    has_sample: Annotated[int, word("whether a sample exists that can be repeated")]
    homed: Annotated[int, word("homing bits of the last reply")]
    was_homed: Annotated[int, word("whether these bits were set without a homing request, so their loss is an error")]
    sampled_at: Annotated[int, word("time of the latest reply, ns")]
    read_at: Annotated[int, word("time of the last read by the loop, ns")]
    sent_at: Annotated[int, word("time of the last packet sent, ns")]
    opened_at: Annotated[int, word("time at which the device was opened, ns")]
    fill: Annotated[int, word("bytes received of the current packet")]
    error: Annotated[int, word("error code of libusb at the failure")]
    stale_replies: Annotated[int, word("outstanding replies to packets sent before a pause of the loop")]
    sent_own_zero: Annotated[int, word("whether a zero was sent without a command of the loop since the last read")]
    # buffers and values
    packet: Annotated[int, raw_bytes("packet being received", packets.SIZE)]
    newest: Annotated[int, raw_bytes("latest reply", packets.SIZE)]
    timespec: Annotated[int, numbers("struct timespec of the clock, also a struct timeval", TIMESPEC_WORDS)]
    counts: Annotated[int, numbers("encoder counts of the latest reply", 3)]
    position: Annotated[int, numbers("position in the device frame, m", 3)]
    centre: Annotated[int, numbers("origin of the world in the device frame, m", 3)]
    gain: Annotated[int, numbers("motor counts per N m", 1)]
    buffer_in: Annotated[int, raw_bytes("buffer of the transfer from the device", packets.CHIP_BYTES)]
    buffer_out: Annotated[int, raw_bytes("buffer of the transfer to the device", packets.SIZE)]
    sample: Annotated[int, numbers("last sample", SAMPLE_SIZE)]


AT: Final = lay_out(Fields)
