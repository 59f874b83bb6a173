"""Elastic bodies before the loop: volume mesh, finite elements, and the compliance of the surface, cached on disk.

Not here: the contact step on the surface, which is in `proxy/kernels/elastic/`.
"""
