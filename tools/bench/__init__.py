"""`softfinger bench`: time of a step, a tick, a message and a closed loop.

Contains no measurement without a reference that runs in turn with it.
"""
