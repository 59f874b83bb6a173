"""Mechanisms: where the end of a device is at these joint angles, and the torques that a force at it takes.

A rig's keys are in `options`; `paddle`, `pantograph`, `chain` and `delta` have the equations; `mechanism` chooses
among them for the drivers whose devices a rig describes. How numbers reach a device is not in here.
"""
