"""Space: vectors, rotations, frames, the shapes and where they are, and the way between two places.

Nothing of forces, and nothing that lasts from tick to tick.
"""
