"""Mechanisms: pose of a device's end from joint angles, and motor torques for a force at the end.

`options` has the configuration; `paddle`, `pantograph`, `chain` and `delta` have the equations; `mechanism` selects one
of them for devices that a rig describes. Drivers carry the numbers to and from the device.
"""
