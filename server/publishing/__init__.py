"""Publisher: a separate process that reads ticks from shared memory and handles all ZeroMQ traffic of the daemon.

Contains no servo, no device, and neither numpy nor numba: it starts in a tenth of a second, and the effects of a
misbehaving peer are limited to it.
"""
