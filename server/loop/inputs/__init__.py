"""Inputs of a tick: plausibility checks of poses, and ramps of changed parameters.

Contains no driver and nothing that waits: only memory and arithmetic of a tick.
"""
