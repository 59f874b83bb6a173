"""The page in the browser: a scene, its fingertips, what they do to each other, and a mouse for a hand.

A client of the wire and nothing more, in a process of its own: no part of the servo, no device, no physics.
"""
