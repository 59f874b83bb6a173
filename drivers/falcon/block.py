"""The block of int64 words that a Falcon's C functions share with Python; its address is the device's handle."""

from typing import Final

from softfinger.drivers.base import SAMPLE_SIZE

# Words of the block. Counters first.
REPLIES: Final = 0  # whole packets received
PASSED: Final = 1  # of these, older ones passed over for a newer
WRITTEN: Final = 2  # packets sent
HELD: Final = 3  # forces not sent, because an answer or the bus was late
KICKS: Final = 4  # zeros sent into a silence
CUT: Final = 5  # forces that the motors could not give
GARBLED: Final = 6  # pieces of the stream that were no packet
UNREACHED: Final = 7  # encoder counts to which no place of the knob belongs
COUNTERS: Final = ("replies", "passed", "written", "held", "kicks", "cut", "garbled", "unreached")  # in their order
# Settings:
CONTEXT: Final = 8  # libusb's
SUBMIT: Final = 9  # addresses of libusb's functions
HANDLE_EVENTS: Final = 10
CANCEL: Final = 11
IN: Final = 12  # addresses of the transfers
OUT: Final = 13
KICK: Final = 14  # ns of silence
TIMEOUT_AFTER: Final = 15  # ns of silence
LIGHTS: Final = 16  # bits of the state byte, the homing request among them
# Shared with other threads:
OPEN: Final = 17
ARMED: Final = 18
LOCK: Final = 19  # held in every exchange
# Of the exchange:
IN_DONE: Final = 20  # set by libusb's call back; together with the next, each transfer's user data
OUT_DONE: Final = 21
AWAITED: Final = 22  # packets without an answer
PUSHES: Final = 23  # whether the last packet sent was a force
SENSED: Final = 24  # whether there is a sample to repeat
HOMED: Final = 25  # bits of the last reply
STAYS_HOMED: Final = 26  # the bits were seen without the homing request, so losing them means something
HEARD_AT: Final = 27  # ns, when the newest reply was taken
READ_AT: Final = 28  # ns, when the loop last read
SENT_AT: Final = 29  # ns
OPENED_AT: Final = 30  # ns
FILL: Final = 31  # bytes in PACKET
ERROR: Final = 32  # libusb's, at the failure
OLDER: Final = 33  # replies still to come that answer packets of before a pause of the loop
# Memory:
PACKET: Final = 34  # 16 bytes being put together
NEWEST: Final = 36  # 16 bytes of the newest reply
TIMESPEC: Final = 38  # two words, also a struct timeval
COUNTS: Final = 40  # three, of the newest reply
POSITION: Final = 43  # three float64: m, device's frame
CENTRE: Final = 46  # three float64: m, device's frame
GAIN: Final = 49  # a float64: motor counts per N m
BUFFER_IN: Final = 50  # 64 bytes
BUFFER_OUT: Final = 58  # 16 bytes
SAMPLE: Final = 60  # float64, the last one
WORDS: Final = SAMPLE + SAMPLE_SIZE
