"""`softfinger bench`: what a step, a tick, a message and a closed loop take.

Each beside a reference that runs in turn with it: no figure stands alone.
"""
