"""`softfinger bench`: what a step, a tick, a message and a closed loop take."""
