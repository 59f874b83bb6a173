"""Queries over all objects of a scene: poses, nearest object, and first object hit on a path.

No contact model, no forces, and no state between ticks, except in the simulation of rigid bodies (`bodies`).
"""
