"""Experiments with participants: the design, the trials, the folder they leave, and the figures of it.

Clients of the wire: nothing here touches the loop or a device, and the daemon needs nothing of it.
"""
