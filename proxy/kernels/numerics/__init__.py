"""Geometry and small solvers: vectors, rotations, frames, projections onto half-spaces and an ellipsoid.

Independent of shapes and contacts.
"""
