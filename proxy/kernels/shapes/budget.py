"""Limits of the searches of a tick on meshes and height maps, and of the length of a step."""

BUDGET = 1536
"""Nodes and triangles that a fingertip may visit in a tick to find its rest position: at worst about 50 us, and many
times the number needed on a scanned mesh. The path to a first contact may use half of it."""


SPENT = -1
"""Remaining budget after it was exhausted."""


STRIDE = 0.9
"""Largest distance, as a share of its radius, that a fingertip's centre moves between two searches around it."""


ROOM = 4096
"""Capacity of a query's queue of lanes; the largest possible budget."""
