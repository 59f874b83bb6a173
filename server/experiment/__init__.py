"""Experiments with participants: design, trials, result folder, and figures.

Contains only clients of the wire: no access to the loop or a device, and no code that the daemon needs.
"""
