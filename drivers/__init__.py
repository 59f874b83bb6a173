"""Devices: the contract (`base`), one driver per folder (module `device`, loaded by `registry`), and shared parts.

No contact, scene or servo: a driver senses a pose and displays a wrench. The `__init__` of each folder imports nothing,
so that importing a part of a driver does not compile all of it.
"""
