"""Which objects hold the proxy, and how hard."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.normal import spring
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.half_spaces import FACING, Depths
from softfinger.proxy.kernels.query.objects import closest_to_within, normal_law_of
from softfinger.proxy.kernels.shapes.composite import Deepest
from softfinger.proxy.kernels.shapes.protocol import direction

INSIDE = 1e-10
"""Depth, as a share of the fingertip's radius, that counts as inside an object and not as rounding."""
SAME_FOOT = 1.0 - 1e-4
"""Cosine between the normals of two feet on a height map above which they are taken for one."""
FLAT = 1e-4
"""Volume spanned by three unit normals below which they lie in a plane, and may close in from all sides of it."""
NONE = -1.0


class ActiveSet(NamedTuple):
    """Objects that hold the proxy. While its rest is searched a height map may be several of them, one for each foot.

    first, second, third   places in the scene's tuple, -1 for none; the first is the one that is rolled on
    n1, n2, n3             (3,) 1   normals
    push                   m        weights: how far the probe lies behind the proxy along each normal
    """

    first: float
    second: float
    third: float
    n1: Vec3
    n2: Vec3
    n3: Vec3
    push: Depths


@jit
def one_constraint(first: float, normal: Vec3) -> ActiveSet:
    """One object alone, not yet pressed."""
    return ActiveSet(first=first, second=NONE, third=NONE, n1=normal, n2=normal, n3=normal, push=Depths(0.0, 0.0, 0.0))


@jit
def count_of(active: ActiveSet) -> int:
    if active.second < 0.0:
        return 1
    return 2 if active.third < 0.0 else 3


@jit
def active_objects(active: ActiveSet) -> Vec3:
    """Places of the objects, -1 for none."""
    return active.first, active.second, active.third


@jit
def pressed(normal: Vec3, behind: Vec3) -> ActiveSet:
    """The only object, for a proxy on it that lies `behind` (3,) m ahead of the probe."""
    push = Depths(max(vec3.dot(behind, normal), 0.0), 0.0, 0.0)
    return ActiveSet(first=0.0, second=NONE, third=NONE, n1=normal, n2=normal, n3=normal, push=push)


@jit
def with_another(active: ActiveSet, index: float, normal: Vec3) -> ActiveSet:
    if active.second < 0.0:
        return ActiveSet(
            first=active.first, second=index, third=NONE, n1=active.n1, n2=normal, n3=normal, push=active.push
        )  # fmt: skip
    return ActiveSet(
        first=active.first, second=active.second, third=index, n1=active.n1, n2=active.n2, n3=normal,
        push=active.push,
    )  # fmt: skip


@jit
def with_touched(objects: Any, radius: float, center: Vec3, active: ActiveSet, near: Deepest) -> tuple[ActiveSet, int]:
    """And the object nearest to the proxy, if it touches it and there is room for one more; and what is left of the
    budget."""
    gap, at, left = near
    if gap > radius * (1.0 + INSIDE) or active.third >= 0.0 or at == active.first or at == active.second:
        return active, left
    _, _, normal, left = closest_to_within(objects, at, center, left)
    return with_another(active, at, normal), left


@jit
def without_weakest(active: ActiveSet) -> ActiveSet:
    """Let go of the one of three that pushes least, to make room."""
    push = active.push
    if push.third <= push.second and push.third <= push.first:
        return ActiveSet(
            first=active.first, second=active.second, third=NONE, n1=active.n1, n2=active.n2, n3=active.n2, push=push
        )  # fmt: skip
    if push.second <= push.first:
        return ActiveSet(
            first=active.first, second=active.third, third=NONE, n1=active.n1, n2=active.n3, n3=active.n3, push=push
        )  # fmt: skip
    return ActiveSet(
        first=active.second, second=active.third, third=NONE, n1=active.n2, n2=active.n3, n3=active.n3, push=push
    )  # fmt: skip


@jit
def swapped(active: ActiveSet, third: bool) -> ActiveSet:
    """The second or the third of them first."""
    push = active.push
    if third:
        return ActiveSet(
            first=active.third, second=active.second, third=active.first, n1=active.n3, n2=active.n2, n3=active.n1,
            push=Depths(push.third, push.second, push.first),
        )  # fmt: skip
    return ActiveSet(
        first=active.second, second=active.first, third=active.third, n1=active.n2, n2=active.n1, n3=active.n3,
        push=Depths(push.second, push.first, push.third),
    )  # fmt: skip


@jit
def loads_of(objects: Any, active: ActiveSet) -> Vec3:
    """Elastic normal forces, N, of the three; 0 for none."""
    one = spring(normal_law_of(objects, active.first), active.push.first)
    two, three = 0.0, 0.0
    if active.second >= 0.0:
        two = spring(normal_law_of(objects, active.second), active.push.second)
    if active.third >= 0.0:
        three = spring(normal_law_of(objects, active.third), active.push.third)
    return one, two, three


@jit
def strongest_first(objects: Any, active: ActiveSet) -> ActiveSet:
    """Drop what does not push, and let another be the first only when that has clearly come to bear more.

    A plain comparison would change between two equal walls with every rounding error.
    """
    load = loads_of(objects, active)
    if active.second >= 0.0 and load[1] > 1.5 * load[0] and load[1] >= load[2]:
        active = swapped(active, False)
    elif active.third >= 0.0 and load[2] > 1.5 * load[0]:
        active = swapped(active, True)
    if active.third >= 0.0 and not active.push.third > 0.0:
        active = ActiveSet(
            first=active.first, second=active.second, third=NONE, n1=active.n1, n2=active.n2, n3=active.n2,
            push=Depths(active.push.first, active.push.second, 0.0),
        )  # fmt: skip
    if active.second >= 0.0 and not active.push.second > 0.0:
        active = ActiveSet(
            first=active.first, second=active.third, third=NONE, n1=active.n1, n2=active.n3, n3=active.n3,
            push=Depths(active.push.first, active.push.third, 0.0),
        )  # fmt: skip
    return active


@jit
def leaves_no_room(active: ActiveSet) -> bool:
    """Whether two that hold the proxy face each other, or three close in on it from all sides."""
    if active.second < 0.0:
        return False
    if vec3.dot(active.n1, active.n2) < FACING:
        return True
    if active.third < 0.0:
        return False
    across = vec3.cross(active.n1, active.n2)
    return (
        vec3.dot(active.n1, active.n3) < FACING
        or vec3.dot(active.n2, active.n3) < FACING
        or abs(vec3.dot(across, active.n3)) < FLAT
    )


@jit
def is_support_point_of(active: ActiveSet, at: float, normal: Vec3) -> bool:
    """Whether that place of the height map `at`, given by its normal, is one of the feet."""
    if at == active.first and vec3.dot(normal, active.n1) > SAME_FOOT:
        return True
    if at == active.second and vec3.dot(normal, active.n2) > SAME_FOOT:
        return True
    return at == active.third and vec3.dot(normal, active.n3) > SAME_FOOT


@jit
def merge_support_points(active: ActiveSet) -> ActiveSet:
    """The feet on one height map together: pushing along the sum of their pushes, by its length."""
    push = active.push
    if active.third >= 0.0 and (active.third == active.first or active.third == active.second):
        if active.third == active.first:
            first, n1 = together(push.first, active.n1, push.third, active.n3)
            second, n2 = push.second, active.n2
        else:
            first, n1 = push.first, active.n1
            second, n2 = together(push.second, active.n2, push.third, active.n3)
        active = ActiveSet(
            first=active.first, second=active.second, third=NONE, n1=n1, n2=n2, n3=n2, push=Depths(first, second, 0.0)
        )  # fmt: skip
    if active.second >= 0.0 and active.second == active.first:
        push = active.push
        first, n1 = together(push.first, active.n1, push.second, active.n2)
        active = ActiveSet(
            first=active.first, second=active.third, third=NONE, n1=n1, n2=active.n3, n3=active.n3,
            push=Depths(first, push.third, 0.0),
        )  # fmt: skip
    return active


@jit
def together(one: float, n1: Vec3, two: float, n2: Vec3) -> tuple[float, Vec3]:
    return direction(vec3.add_scaled(vec3.scale(one, n1), two, n2), n1)


@jit
def tangent_to_all(active: ActiveSet, v: Vec3) -> Vec3:
    """Part of `v` along which all holding objects leave the proxy free."""
    v = vec3.reject(v, active.n1)
    if active.second >= 0.0:
        across = vec3.reject(active.n2, active.n1)
        size = vec3.dot(across, across)
        if size > 1e-18:
            v = vec3.add_scaled(v, -vec3.dot(v, across) / size, across)
            if active.third >= 0.0:
                return (0.0, 0.0, 0.0)
    return v
