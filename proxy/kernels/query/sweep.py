"""First object that a fingertip hits on its path in a tick, so that neither can pass through the other.

The path is straight in the frame of each object, from the fingertip's last position to its current one. So a thin
object that moves is detected, too.
"""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import STILL, Single, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into
from softfinger.proxy.kernels.query.carry import make_carry, move_point
from softfinger.proxy.kernels.query.container import MAX_ENTRIES, find_object, is_beyond
from softfinger.proxy.kernels.shapes import NO_HIT
from softfinger.proxy.kernels.shapes.protocol import meets


@jit
def sweep_to_row(
    body: Any, start: Vec3, end: Vec3, radius: float, in_contact: bool, budget: int
) -> tuple[float, float, Vec3, int]:
    """Return the share of the path at the hit, the triangle, the centre (3,) m there, and the remaining budget."""
    path_start = move_point(make_carry(body), start)
    share, facet, budget = meets(
        body.shape, into(body.pose, path_start), into(body.pose, end), radius, in_contact, budget
    )
    return share, facet, vec3.add_scaled(path_start, share, vec3.sub(end, path_start)), budget


@jit
def find_first_hit(
    objects: Any, start: Vec3, end: Vec3, radius: float, in_contact: bool, skip: Any, budget: int
) -> tuple[float, Vec3, int]:
    """Find the first object that the fingertip hits.

    returns  index of the object, -1 for none, the fingertip's centre (3,) m there, and the remaining budget

    On a mesh or a height map, an exhausted budget counts as a hit.

    start  (3,) m  start of the path, at the last tick; for an object that has moved since, it is moved with it
    end    (3,) m  end of the path
    in_contact     see `travel`
    skip           indices of up to three objects to be ignored
    budget         maximum number of nodes and triangles of meshes, and tiles of height maps, to be queried
    """
    if isinstance(objects, Single):
        if skip[0] == 0.0 or skip[1] == 0.0 or skip[2] == 0.0:
            return -1.0, end, budget
        share, facet, center, budget = sweep_to_row(objects.body, start, end, radius, in_contact, budget)
        return (facet, center, budget) if share < NO_HIT else (-1.0, end, budget)
    share, index, center = NO_HIT, -1.0, end
    reach = radius + vec3.norm(vec3.sub(end, start))
    for row in range(int(objects.size)):
        row_index = float(row)
        if row_index == skip[0] or row_index == skip[1] or row_index == skip[2]:
            continue
        entry = objects.entries[row]
        if entry.motion.kind == STILL and is_beyond(objects, row, start, reach):
            continue
        hit_share, facet, hit_center, budget = sweep_to_row(
            find_object(objects, row_index), start, end, radius, in_contact, budget
        )
        if hit_share < share:
            share, index, center = hit_share, row_index + MAX_ENTRIES * facet, hit_center
    return index, center, budget
