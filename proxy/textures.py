"""A scene's texture as the numbers that its kernel takes: from its file, without what 1 kHz cannot carry.

A hand that strokes at v feels what has the wavelength L at the frequency v / L. What comes at more than half the tick
rate would come out as something else, coarser: it is removed beforehand by a filter on the array.

The filter is Gaussian, in the frequency domain, alike in all directions: what has the wavelength L keeps the share
REST^((CUTOFF / L)^2), and at the cutoff v / (tick rate / 2) that is REST. A Gaussian has no side lobes, so what is
filtered does not overshoot: heights stay between those of the file, and factors of friction between those of the
scene. The same is true of the spline between the filtered numbers.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from softfinger.config import limits, schema
from softfinger.config.arrays.grids import Grid, read_grid
from softfinger.config.errors import ConfigError
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.jit.arrays import ReadOnly

FREQUENCY_MAX_HZ: Final = limits.FREQUENCY_HZ.high
"""Half of the usual 1 kHz."""
REST: Final = 0.01
"""Share of an amplitude at the cutoff that is left."""


class Made(NamedTuple):
    """A texture as it is rendered.

    values   (rows, columns)  in [0, 1], filtered: coefficients of the spline
    size     m                of the array on the surface; round a cylinder such that it meets itself
    around   whether it goes round a cylinder
    """

    values: Grid
    size: tuple[float, float]
    around: bool


def cutoff_m(texture: schema.Texture) -> float:
    """Wavelength at which REST is left, m."""
    return texture.speed_m_per_s / FREQUENCY_MAX_HZ


def make(thing: schema.Textured) -> Made:
    """The texture that an object has, from its file. Raises ConfigError for a file that cannot be used."""
    texture = thing.texture
    assert texture is not None
    try:
        grid = read_grid(texture.file)
    except ConfigError as error:
        raise ConfigError(f"object '{thing.name}': texture.file: {error}") from error
    width, depth = texture.size_m
    around = isinstance(thing, schema.Cylinder)
    if isinstance(thing, schema.Cylinder):
        whole = 2.0 * math.pi * thing.radius_m
        width = whole / max(round(whole / width), 1)
    low, high = float(grid.min()), float(grid.max())
    repeats = texture.border == "period"
    rows, columns = grid.shape
    pitch = width / columns, depth / rows
    return Made(filtered((grid - low) / (high - low), pitch, cutoff_m(texture), (around or repeats, repeats)),
                (width, depth), around)  # fmt: skip


def bounds(thing: schema.Textured) -> tuple[float, float, float]:
    """Of the heights as rendered: lowest to highest, m; steepest slope at most, 1; sharpest bend at most, 1/m.

    Derivatives of a B-spline are B-splines of differences of its coefficients, and stay between those. The bend is that
    in the direction in which it is sharpest: of the second derivatives h_uu, h_vv, h_uv no more than the larger of the
    first two and the third together.
    """
    assert thing.texture is not None and thing.texture.height_m is not None
    values, size, around = make(thing)
    repeats = thing.texture.border == "period"
    heights = thing.texture.height_m * values
    for axis, on in ((1, around or repeats), (0, repeats)):
        heights = np.pad(heights, [(0, 0), (1, 1)] if axis else [(1, 1), (0, 0)], mode="wrap" if on else "edge")
    pitches = size[1] / values.shape[0], size[0] / values.shape[1]

    def most(*axes: int) -> float:
        differences = heights
        for axis in axes:
            differences = np.diff(differences, axis=axis) / pitches[axis]
        return float(np.abs(differences).max())

    return float(np.ptp(heights)), math.hypot(most(0), most(1)), max(most(0, 0), most(1, 1)) + most(0, 1)


def filtered(grid: Grid, pitch: tuple[float, float], cutoff: float, repeats: tuple[bool, bool]) -> Grid:
    """The numbers (rows, columns) without what has a wavelength below `cutoff` (m).

    pitch    m  between columns and between rows
    repeats     along the columns and the rows; what does not repeat is mirrored at its border, so that it ends level
    """
    rows, columns = grid.shape
    pads = ((0, 0 if repeats[1] else rows), (0, 0 if repeats[0] else columns))
    wide = np.pad(grid, pads, mode="symmetric")
    u = np.fft.rfftfreq(wide.shape[1], pitch[0])
    v = np.fft.fftfreq(wide.shape[0], pitch[1])[:, None]
    spectrum = np.fft.rfft2(wide) * REST ** (cutoff**2 * (u**2 + v**2))
    smooth = np.fft.irfft2(spectrum, s=wide.shape)[:rows, :columns]
    # Where the array is too coarse for the filter it is cut off at the array's own limit, and rings by a little.
    return np.clip(smooth, grid.min(), grid.max())


def kernel_texture(thing: schema.Object) -> model.Texture | None:
    """The texture of an object for its kernels; None without one. Raises ConfigError as `make` does."""
    texture = getattr(thing, "texture", None)
    if texture is None:
        return None
    values, (width, depth), around = make(thing)  # type: ignore[arg-type]
    rows, columns = values.shape
    repeats = texture.border == "period"
    return model.Texture(
        values=ReadOnly(values),
        columns=float(columns),
        rows=float(rows),
        per_u=columns / width,
        per_v=rows / depth,
        period_u=float(around or repeats),
        period_v=float(repeats),
        fade=cutoff_m(texture),
        relief=None if texture.height_m is None else model.Relief(texture.height_m),
        grip=None if texture.friction_scale is None else model.Grip(*texture.friction_scale),
    )
