"""Conversion of a scene's texture to the arrays of its kernel: from its file, without wavelengths too short for 1 kHz.

A hand that strokes at the speed v feels the wavelength L as the frequency v / L. Frequencies above half the tick
rate would alias to lower ones, so a filter removes them from the array in advance.

The filter is an isotropic Gaussian in the frequency domain: the amplitude of a wavelength L is multiplied by
REMAINING_SHARE^((CUTOFF / L)^2); at the cutoff v / (tick rate / 2) that is REMAINING_SHARE. A Gaussian has no side
lobes, so the result does not overshoot: heights remain in the range of the file, and factors of friction in the range
of the scene. The same is true of the spline between the filtered numbers.
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
REMAINING_SHARE: Final = 0.01
"""Fraction of an amplitude that remains at the cutoff."""


class RenderedTexture(NamedTuple):
    """Texture as rendered.

    values   (rows, columns)  in [0, 1], filtered: coefficients of the spline
    size     m                of the array on the surface; around a cylinder adjusted such that its ends meet
    around   True if it extends around a cylinder
    """

    values: Grid
    size: tuple[float, float]
    around: bool


def compute_cutoff_m(texture: schema.Texture) -> float:
    """Return the cutoff wavelength, m."""
    return texture.speed_m_per_s / FREQUENCY_MAX_HZ


def make(obj: schema.Textured) -> RenderedTexture:
    """Return the texture of an object from its file. Raises ConfigError if the file cannot be used."""
    texture = obj.texture
    assert texture is not None
    try:
        grid = read_grid(texture.file)
    except ConfigError as error:
        raise ConfigError(f"object '{obj.name}': texture.file: {error}") from error
    width, depth = texture.size_m
    around = isinstance(obj, schema.Cylinder)
    if isinstance(obj, schema.Cylinder):
        whole = 2.0 * math.pi * obj.radius_m
        width = whole / max(round(whole / width), 1)
    low, high = float(grid.min()), float(grid.max())
    repeats = texture.border == "period"
    rows, columns = grid.shape
    pitch = width / columns, depth / rows
    values = filter_texture((grid - low) / (high - low), pitch, compute_cutoff_m(texture), (around or repeats, repeats))
    return RenderedTexture(values, (width, depth), around)


def compute_bounds(obj: schema.Textured) -> tuple[float, float, float]:
    """Return bounds of the heights as rendered: range, m; largest slope, 1; largest curvature, 1/m.

    Derivatives of a B-spline are B-splines of differences of its coefficients, and bounded by their range. The
    curvature is that of the direction where it is largest: from the second derivatives h_uu, h_vv, h_uv, at most the
    larger of the first two plus the third.
    """
    assert obj.texture is not None and obj.texture.height_m is not None
    values, size, around = make(obj)
    repeats = obj.texture.border == "period"
    heights = obj.texture.height_m * values
    for axis, on in ((1, around or repeats), (0, repeats)):
        heights = np.pad(heights, [(0, 0), (1, 1)] if axis else [(1, 1), (0, 0)], mode="wrap" if on else "edge")
    pitches = size[1] / values.shape[0], size[0] / values.shape[1]

    def most(*axes: int) -> float:
        differences = heights
        for axis in axes:
            differences = np.diff(differences, axis=axis) / pitches[axis]
        return float(np.abs(differences).max())

    return float(np.ptp(heights)), math.hypot(most(0), most(1)), max(most(0, 0), most(1, 1)) + most(0, 1)


def filter_texture(grid: Grid, pitch: tuple[float, float], cutoff: float, repeats: tuple[bool, bool]) -> Grid:
    """Return the numbers (rows, columns) without wavelengths below `cutoff` (m).

    pitch    m  between columns and between rows
    repeats     along the columns and the rows; otherwise the array is mirrored, so that the slope at its border is zero
    """
    rows, columns = grid.shape
    pads = ((0, 0 if repeats[1] else rows), (0, 0 if repeats[0] else columns))
    wide = np.pad(grid, pads, mode="symmetric")
    u = np.fft.rfftfreq(wide.shape[1], pitch[0])
    v = np.fft.fftfreq(wide.shape[0], pitch[1])[:, None]
    spectrum = np.fft.rfft2(wide) * REMAINING_SHARE ** (cutoff**2 * (u**2 + v**2))
    smooth = np.fft.irfft2(spectrum, s=wide.shape)[:rows, :columns]
    # If the array is too coarse for the filter, the array's resolution is the cutoff, with a little ringing.
    return np.clip(smooth, grid.min(), grid.max())


def compile_texture(obj: schema.Object) -> model.Texture | None:
    """Return the texture of an object for its kernels; None without one. Raises ConfigError as `make` does."""
    texture = getattr(obj, "texture", None)
    if texture is None:
        return None
    values, (width, depth), around = make(obj)  # type: ignore[arg-type]
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
        fade=compute_cutoff_m(texture),
        relief=None if texture.height_m is None else model.Relief(texture.height_m),
        grip=None if texture.friction_scale is None else model.Grip(*texture.friction_scale),
    )
