"""Browser page: 3-D picture of a scene with fingertips and contacts, and mouse control of a simulated hand.

A client of the wire in a separate process: contains no servo, no device and no physics.
"""
