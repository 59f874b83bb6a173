"""Meshes before they are rendered: read from files, mended, described, made into trees, and those kept on disk.

No distances and no contact: what runs in a tick is in `kernels/`.
"""
