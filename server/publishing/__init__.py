"""The publisher: a process beside the daemon that reads its ticks from shared memory, and alone talks to ZeroMQ peers.

No servo, no device, neither numpy nor numba: it starts in a tenth of a second, and what a peer does to it stays in it.
"""
