"""Mechanisms: where the end of a device is at these joint angles, and the torques that a force at it takes.

What a rig may say is in `options`; `paddle`, `pantograph`, `chain` and `delta` have the equations; `mechanism` chooses
among them for the drivers whose devices a rig describes. How numbers reach a device is not in here.
"""
