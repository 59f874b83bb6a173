"""Preparation of meshes from files: reading, repair, report, tree over the triangles, and cache on disk.

Contains no distance queries and no contact: the code of a tick is in `kernels/`.
"""
