"""How much of a mesh or a height map a tick may search, and how far a step may go: one budget for every shape."""

BUDGET = 1536
"""Nodes and triangles that a fingertip may ask in a tick to come to rest: some fifty microseconds at the worst, and
many times what it needs on a scan. Half as many may be asked on the way to a first touch."""


SPENT = -1
"""What is left of a budget that was used up."""


STRIDE = 0.9
"""Share of its radius that a fingertip's centre goes between two looks at what is around it."""


ROOM = 4096
"""Lanes that a query may have waiting; the most that a budget can be."""
