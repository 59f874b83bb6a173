"""Devices: the contract (`base`), a driver in each folder (its `device`; found by `registry`), and what they share.

No contact, no scene, no servo: a driver senses a pose and displays a wrench. A folder's `__init__` imports nothing, so
that a part of a driver is had without compiling the whole.
"""
