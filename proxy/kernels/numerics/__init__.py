"""Mathematics of space and small solvers: vectors, rotations, frames, projections onto half-spaces and an ellipsoid.

No shape, no contact: what is here could serve any program.
"""
