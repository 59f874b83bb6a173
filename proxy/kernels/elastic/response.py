"""Response of an elastic surface: compliance between spots, slopes of the displacement, rotation and strain."""

from typing import Any

from softfinger.proxy.kernels.elastic.spots import Spot
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.model.elastic import Elastic
from softfinger.proxy.kernels.numerics import mat3, vec3
from softfinger.proxy.kernels.numerics.mat3 import Mat3

Blocks = tuple[tuple[Mat3, Mat3], tuple[Mat3, Mat3]]


@jit
def add_block(m: Mat3, elastic: Elastic, a: int, b: int, weight: float) -> Mat3:
    """Return m plus the block of two nodes times `weight`."""
    at = 9 * (a * int(elastic.number) + b)
    c = elastic.compliance
    return (
        (m[0][0] + weight * c[at], m[0][1] + weight * c[at + 1], m[0][2] + weight * c[at + 2]),
        (m[1][0] + weight * c[at + 3], m[1][1] + weight * c[at + 4], m[1][2] + weight * c[at + 5]),
        (m[2][0] + weight * c[at + 6], m[2][1] + weight * c[at + 7], m[2][2] + weight * c[at + 8]),
    )


@jit
def compute_node_row(elastic: Elastic, node: int, spot: Spot) -> Mat3:
    """Return the compliance (3, 3) m/N of a node under loads at `spot`; 0 at a rigid vertex."""
    found = mat3.ZEROS
    if node >= 0:
        for j in range(3):
            if spot.nodes[j] >= 0:
                found = add_block(found, elastic, node, spot.nodes[j], elastic.softness * spot.weights[j])
    return found


@jit
def compute_node_rows(elastic: Elastic, one: Spot, two: Spot) -> tuple[Mat3, Mat3, Mat3]:
    """Return the compliance (3, 3) m/N of each node of `one` under loads at `two`."""
    a, b, c = one.nodes
    return compute_node_row(elastic, a, two), compute_node_row(elastic, b, two), compute_node_row(elastic, c, two)


@jit
def compliance_of(spot: Spot, rows: Any) -> Mat3:
    """Return the compliance (3, 3) m/N at a spot from the `rows` of its nodes."""
    found = mat3.plus(mat3.ZEROS, spot.weights[0], rows[0])
    return mat3.plus(mat3.plus(found, spot.weights[1], rows[1]), spot.weights[2], rows[2])


@jit
def slope_at(one: Spot, two: Spot, rows: Any) -> Mat3:
    """Return the slope (3, 3) of the displacement at `one` under the load of `two` with the position of `one`.

    rows  of the nodes of `one` under loads at `two`
    """
    found = mat3.ZEROS
    for i in range(3):
        found = mat3.plus_outer(found, mat3.times(rows[i], two.load), one.slopes[i])
    return found


@jit
def slope_by(one: Spot, two: Spot, rows: Any, back: Any) -> Mat3:
    """Return the slope (3, 3) of the displacement at `one` with the position of `two`, whose load and point change.

    rows  of the nodes of `one` under loads at `two`
    back  of the nodes of `two` under loads at `one`: transposed, by reciprocity, the response to loads on these nodes
    """
    found = mat3.product(compliance_of(one, rows), two.spring)
    for i in range(3):
        found = mat3.plus_outer(found, mat3.times(mat3.transpose(back[i]), two.load), two.slopes[i])
    return found


@jit
def bending_under(elastic: Elastic, spot: Spot) -> tuple[float, float]:
    """Return the largest rotation, rad, and strain of the body under the load of a spot: an upper bound.

    Those of the components of the load on each node are added, wherever in the body they are.
    """
    rotation, strain = 0.0, 0.0
    for i in range(3):
        if spot.nodes[i] < 0:
            continue
        for j in range(3):
            share = elastic.softness * spot.weights[i] * abs(spot.load[j])
            at = 6 * spot.nodes[i] + 2 * j
            rotation += share * elastic.bending[at]
            strain += share * elastic.bending[at + 1]
    return rotation, strain


@jit
def linearize_both(elastic: Elastic, one: Spot, two: Spot, rows: Any, gain: float) -> Any:
    """Return Newton's matrix of two fingers, four blocks (3, 3), and the gradients (3,) N of load times displacement.

    rows  of the nodes of `one` under loads at `one` and `two`, and of `two` at `two`
    """
    r11, r12, r22 = rows
    r21 = compute_node_rows(elastic, two, one)
    at_one = mat3.plus(slope_at(one, one, r11), 1.0, slope_at(one, two, r12))
    at_two = mat3.plus(slope_at(two, two, r22), 1.0, slope_at(two, one, r21))
    a = mat3.plus(mat3.IDENTITY, gain, mat3.plus(at_one, 1.0, slope_by(one, one, r11, r11)))
    b = mat3.plus(mat3.ZEROS, gain, slope_by(one, two, r12, r21))
    c = mat3.plus(mat3.ZEROS, gain, slope_by(two, one, r21, r12))
    d = mat3.plus(mat3.IDENTITY, gain, mat3.plus(at_two, 1.0, slope_by(two, two, r22, r22)))
    gradients = mat3.times(mat3.transpose(at_one), one.load), mat3.times(mat3.transpose(at_two), two.load)
    return (a, b, c, d), gradients


@jit
def invert_both(a: Mat3, b: Mat3, c: Mat3, d: Mat3) -> Blocks:
    """Return the rows of blocks of the inverse of ((a, b), (c, d))."""
    a_inverse = mat3.inverse(a)
    left, right = mat3.product(c, a_inverse), mat3.product(a_inverse, b)
    corner = mat3.inverse(mat3.plus(d, -1.0, mat3.product(left, b)))
    up = mat3.plus(mat3.ZEROS, -1.0, mat3.product(right, corner))
    down = mat3.plus(mat3.ZEROS, -1.0, mat3.product(corner, left))
    return (mat3.plus(a_inverse, -1.0, mat3.product(up, left)), up), (down, corner)


@jit
def times_both(blocks: Blocks, one: Vec3, two: Vec3) -> tuple[Vec3, Vec3]:
    (a, b), (c, d) = blocks
    return vec3.add(mat3.times(a, one), mat3.times(b, two)), vec3.add(mat3.times(c, one), mat3.times(d, two))
