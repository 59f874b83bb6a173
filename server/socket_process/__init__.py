"""Processes that handle all ZeroMQ traffic of the daemon.

The publisher reads ticks from shared memory and sends them. Another process receives commands, so that no subscriber
can delay a command that stops the force.

They contain no servo, no device, and neither numpy nor numba: each starts in a tenth of a second, and the effects of a
misbehaving peer are limited to it.
"""
