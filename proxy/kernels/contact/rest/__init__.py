"""Rest position of the proxy, and the constraints that support it there.

The rest position is the point nearest to the probe that satisfies every constraint. The common case of one object has
a separate solver, which includes the deflection by friction: `one_object`. With `several_objects`, the search starts
from the last active set, adds every obstacle, and computes the smallest displacement that satisfies all constraints
(`projection`), until nothing changes. On a mesh, the proxy moves from facet to facet (`facets`), or by supporting
planes if the last active set no longer supports it (`cutting_planes`).
"""
