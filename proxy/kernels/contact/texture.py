"""Effect of a texture on a contact: surface heights, and friction that varies over the surface.

Heights. The highest value of a texture is at the surface of the shape; all heights are h(u, v) <= 0. The probe is delta
behind the proxy, and its surface depth is d = delta + h, with u, v under the probe. The force is that of the potential
K d^2 / 2 for d > 0: K d m, with m = -grad d = n - grad h. It depends only on the position of the probe, so a closed
path neither gains nor loses energy; damping also acts along m, and dissipates B (m . v)^2.

Friction. The coefficients of the law and the torsional limit are multiplied by the texture's factor at the contact
point.

    apply_relief(body, depth, normal, position)  -> d, m
    apply_grip(body, index, active, center)      -> body with the friction of its material under the proxy
"""

from math import floor
from typing import Any, NamedTuple

from softfinger.proxy.kernels.friction.laws import scale_law
from softfinger.proxy.kernels.friction.torsion import scale_torsion
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import ActiveSet, Texture, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into, turn_into, turn_out_of
from softfinger.proxy.kernels.numerics.scalars import clamp, compute_spline_weights, weigh
from softfinger.proxy.kernels.shapes.charts import Chart, chart
from softfinger.proxy.kernels.shapes.composite import shade_normal

CELLS_CEILING = 1e15
"""Limit of a coordinate in cells: beyond it, float64 resolves no fraction of a cell, and farther out no whole cells."""


class TextureSample(NamedTuple):
    """Value of a texture, 0 to 1, and its derivatives by u and v, 1/m."""

    value: float
    by_u: float
    by_v: float


@jit
def wrap_index(index: float, count: float, period: float) -> int:
    """Return the index in an array of that `count`; it is valid for a coordinate that is not finite, too."""
    if period != 0.0:
        index -= count * floor(index / count)
    if not index > 0.0:
        return 0
    return int(min(index, count - 1.0))


@jit
def sum_line(texture: Texture, row: float, columns: Any, weight: Any, slope: Any) -> tuple[float, float]:
    """Return the weighted sum of four neighbours of one row, and its derivative along the row."""
    start = wrap_index(row, texture.rows, texture.period_v) * int(texture.columns)
    z0, z1 = texture.values[start + columns[0]], texture.values[start + columns[1]]
    z2, z3 = texture.values[start + columns[2]], texture.values[start + columns[3]]
    return weigh(weight, z0, z1, z2, z3), weigh(slope, z0, z1, z2, z3)


@jit
def sample(texture: Texture, u: float, v: float) -> TextureSample:
    """Return the spline at u, v (m); its coefficients are at the centres of the array's cells."""
    column = clamp(u * texture.per_u, CELLS_CEILING) + 0.5 * (texture.columns - 1.0)
    row = clamp(v * texture.per_v, CELLS_CEILING) + 0.5 * (texture.rows - 1.0)
    left, top = floor(column), floor(row)
    a, da, _ = compute_spline_weights(column - left)
    b, db, _ = compute_spline_weights(row - top)
    i0 = wrap_index(left - 1.0, texture.columns, texture.period_u)
    i1 = wrap_index(left, texture.columns, texture.period_u)
    i2 = wrap_index(left + 1.0, texture.columns, texture.period_u)
    i3 = wrap_index(left + 2.0, texture.columns, texture.period_u)
    columns = (i0, i1, i2, i3)
    z0, d0 = sum_line(texture, top - 1.0, columns, a, da)
    z1, d1 = sum_line(texture, top, columns, a, da)
    z2, d2 = sum_line(texture, top + 1.0, columns, a, da)
    z3, d3 = sum_line(texture, top + 2.0, columns, a, da)
    by_u, by_v = weigh(b, d0, d1, d2, d3), weigh(db, z0, z1, z2, z3)
    return TextureSample(weigh(b, z0, z1, z2, z3), by_u * texture.per_u, by_v * texture.per_v)


@jit
def compute_chart(body: Any, x: Vec3, normal: Vec3) -> Chart:
    """Return `chart` for a point and a normal in the world frame."""
    return chart(body.shape, body.texture.fade, into(body.pose, x), turn_into(body.pose, normal))


# --- heights -------------------------------------------------------------------------------------


@jit
def apply_relief(body: Any, depth: float, normal: Vec3, position: Vec3) -> tuple[float, Vec3]:
    """Return the surface depth d (m) and m (3,) on one object; the probe at `position` is `depth` behind the proxy.

    The height is h = -H w (1 - z): z the texture's value, H its height, w the chart's `inside`.
    """
    if body.texture is None or body.texture.columns == 0.0:  # no texture, in a scene with textured objects
        return depth, shade_normal(body.shape, body.pose, normal, position)
    if body.texture.relief is None:
        return depth, normal
    texture, relief = body.texture, body.texture.relief
    place = compute_chart(body, position, normal)
    z = sample(texture, place.u, place.v)
    drop = relief.height * (1.0 - z.value)
    rise = vec3.add(vec3.scale(z.by_u, place.along_u), vec3.scale(z.by_v, place.along_v))
    uphill = vec3.add_scaled(vec3.scale(relief.height * place.inside, rise), -drop, place.inward)
    return depth - place.inside * drop, vec3.sub(normal, turn_out_of(body.pose, uphill))


# --- friction ------------------------------------------------------------------------------------


@jit
def apply_grip(body: Any, index: float, active: ActiveSet, center: Vec3) -> Any:
    """Return object `index`; if it supports the proxy, with its friction under the proxy's `center` (3,) m."""
    if body.texture is None or body.texture.grip is None:
        return body
    texture, grip, factor = body.texture, body.texture.grip, 1.0
    one, two, three = active
    if texture.columns != 0.0 and (
        index == one.object_index or index == two.object_index or index == three.object_index
    ):
        normal = one.normal if index == one.object_index else two.normal if index == two.object_index else three.normal
        place = compute_chart(body, center, normal)
        # At an edge of the object, the texture fades to its highest value.
        z = 1.0 - place.inside * (1.0 - sample(texture, place.u, place.v).value)
        factor = grip.low + (grip.high - grip.low) * z
    material = body.material
    friction, torsion = scale_law(material.friction, factor), scale_torsion(material.torsion, factor)
    return replace(body, "material", replace(material, "friction", friction, "torsion", torsion))
