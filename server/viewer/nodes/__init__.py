"""Nodes of the 3-D picture: objects and fingertips as meshes, lines and arrows.

Contains no wire and no controls.
"""
