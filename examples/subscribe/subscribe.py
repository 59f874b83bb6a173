"""Print each change of the contact mode, without softfinger: pip install pyzmq msgpack.

    softfinger run                                  # in one terminal
    python examples/subscribe/subscribe.py          # in another; --changes 4 ends after four

docs/protocol.md lists the keys of a message.
"""

import argparse

import msgpack
import zmq

MODES = ("free", "rolling", "sliding")

options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
options.add_argument("endpoint", nargs="?", default="tcp://127.0.0.1:5555")
options.add_argument("--changes", type=int, default=-1, help="leave after so many (default: stay)")
given = options.parse_args()

socket = zmq.Context.instance().socket(zmq.SUB)
socket.connect(given.endpoint)
socket.subscribe("contact")
mode, left = None, given.changes
while left != 0:
    topic, body = socket.recv_multipart()
    message = msgpack.unpackb(body)
    if message["contact"]["mode"] != mode:
        mode = message["contact"]["mode"]
        x, y, z = (round(component, 3) + 0.0 for component in message["force"])  # without -0.000
        print(f"{message['tick']} {MODES[mode]} {x:.3f} {y:.3f} {z:.3f}", flush=True)
        left -= 1
