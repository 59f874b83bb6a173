"""Response of an elastic surface: compliance between spots, slopes of the displacement, rotation and strain."""

from typing import Any

from softfinger.proxy.kernels.elastic.spots import Spot
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import map_each
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.model.elastic import Elastic
from softfinger.proxy.kernels.numerics import mat3, vec3
from softfinger.proxy.kernels.numerics.mat3 import Mat3

Blocks = tuple[tuple[Mat3, Mat3], tuple[Mat3, Mat3]]


@jit
def add_block(m: Mat3, elastic: Elastic, a: int, b: int, weight: float) -> Mat3:
    """Return m plus the block of two nodes times `weight`."""
    first = 9 * (a * int(elastic.node_count) + b)
    c = elastic.compliance
    return (
        (m[0][0] + weight * c[first], m[0][1] + weight * c[first + 1], m[0][2] + weight * c[first + 2]),
        (m[1][0] + weight * c[first + 3], m[1][1] + weight * c[first + 4], m[1][2] + weight * c[first + 5]),
        (m[2][0] + weight * c[first + 6], m[2][1] + weight * c[first + 7], m[2][2] + weight * c[first + 8]),
    )


@jit
def compute_node_row(node: int, elastic: Elastic, spot: Spot) -> Mat3:
    """Return the compliance (3, 3) m/N of a node under loads at `spot`; 0 at a rigid vertex."""
    row = mat3.ZEROS
    if node >= 0:
        for j in range(3):
            if spot.nodes[j] >= 0:
                row = add_block(row, elastic, node, spot.nodes[j], elastic.softness * spot.weights[j])
    return row


@jit
def compute_node_rows(elastic: Elastic, first: Spot, second: Spot) -> tuple[Mat3, Mat3, Mat3]:
    """Return the compliance (3, 3) m/N of each node of `first` under loads at `second`."""
    rows: tuple[Mat3, Mat3, Mat3] = map_each(compute_node_row, (first.nodes,), elastic, second)
    return rows


@jit
def read_compliance(spot: Spot, rows: Any) -> Mat3:
    """Return the compliance (3, 3) m/N at a spot from the `rows` of its nodes."""
    compliance = mat3.plus(mat3.ZEROS, spot.weights[0], rows[0])
    return mat3.plus(mat3.plus(compliance, spot.weights[1], rows[1]), spot.weights[2], rows[2])


@jit
def compute_slope(first: Spot, second: Spot, rows: Any) -> Mat3:
    """Return the slope (3, 3) of the displacement at `first` under the load of `second` with the position of `first`.

    rows  of the nodes of `first` under loads at `second`
    """
    slope = mat3.ZEROS
    for i in range(3):
        slope = mat3.plus_outer(slope, mat3.times(rows[i], second.load), first.slopes[i])
    return slope


@jit
def compute_slope_by(first: Spot, second: Spot, rows: Any, back: Any) -> Mat3:
    """Return the slope (3, 3) of the displacement at `first` with the position of `second`.

    The load and the point of `second` change.

    rows  of the nodes of `first` under loads at `second`
    back  of the nodes of `second` under loads at `first`: by reciprocity, transposed the responses to loads on these
          nodes
    """
    slope = mat3.product(read_compliance(first, rows), second.spring)
    for i in range(3):
        slope = mat3.plus_outer(slope, mat3.times(mat3.transpose(back[i]), second.load), second.slopes[i])
    return slope


@jit
def find_bending(elastic: Elastic, spot: Spot) -> tuple[float, float]:
    """Return the largest rotation, rad, and strain of the body under the load of a spot: an upper bound.

    It adds the largest values due to each component of the load on each node, wherever in the body they are.
    """
    rotation, strain = 0.0, 0.0
    for i in range(3):
        if spot.nodes[i] < 0:
            continue
        for j in range(3):
            share = elastic.softness * spot.weights[i] * abs(spot.load[j])
            first = 6 * spot.nodes[i] + 2 * j
            rotation += share * elastic.bending[first]
            strain += share * elastic.bending[first + 1]
    return rotation, strain


@jit
def linearize_both(elastic: Elastic, first: Spot, second: Spot, rows: Any, gain: float) -> Any:
    """Return Newton's matrix of two fingers, four blocks (3, 3), and the gradients (3,) N of load times displacement.

    rows  of the nodes of `first` under loads at `first` and `second`, and of `second` at `second`
    """
    r11, r12, r22 = rows
    r21 = compute_node_rows(elastic, second, first)
    at_first = mat3.plus(compute_slope(first, first, r11), 1.0, compute_slope(first, second, r12))
    at_second = mat3.plus(compute_slope(second, second, r22), 1.0, compute_slope(second, first, r21))
    a = mat3.plus(mat3.IDENTITY, gain, mat3.plus(at_first, 1.0, compute_slope_by(first, first, r11, r11)))
    b = mat3.plus(mat3.ZEROS, gain, compute_slope_by(first, second, r12, r21))
    c = mat3.plus(mat3.ZEROS, gain, compute_slope_by(second, first, r21, r12))
    d = mat3.plus(mat3.IDENTITY, gain, mat3.plus(at_second, 1.0, compute_slope_by(second, second, r22, r22)))
    gradients = mat3.times(mat3.transpose(at_first), first.load), mat3.times(mat3.transpose(at_second), second.load)
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
def multiply_both(blocks: Blocks, first: Vec3, second: Vec3) -> tuple[Vec3, Vec3]:
    (a, b), (c, d) = blocks
    return vec3.add(mat3.times(a, first), mat3.times(b, second)), vec3.add(mat3.times(c, first), mat3.times(d, second))
