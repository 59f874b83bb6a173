"""Limits of the searches of a tick on meshes and height maps, of the length of a step, and tolerances of contacts."""

BUDGET = 1536
"""Nodes and triangles that a fingertip may visit in a tick to find its rest position: at worst about 50 us, and many
times the number needed on a scanned mesh. The path to a first contact may use half of it."""


NO_BUDGET = -1
"""Remaining budget after it was exhausted."""


MAX_STRIDE = 0.9
"""Largest distance, as a share of its radius, that a fingertip's centre moves between two searches around it."""


QUEUE_SIZE = 4096
"""Capacity of a query's queue of lanes; the largest possible budget."""


INSIDE_TOLERANCE = 1e-10
"""Depth, as a share of the fingertip's radius, from which a fingertip is inside an object; below it is rounding."""


SETTLED_STEP = 1e-13
"""Motion, as a share of the fingertip's radius, below which the proxy is at rest."""


DEEP_SHARE = 0.5
"""Depth of the probe, as a share of the fingertip's radius, up to which a contact with friction is stable: half the
smallest radius of curvature of the surface on which the proxy moves, that at an edge."""
