"""All objects of a scene: where they are, what is nearest, and what is met first on a way.

No contact, no force, and nothing that lasts from tick to tick.
"""
