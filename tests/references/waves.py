"""A sampled wave behind a Gaussian filter and a cubic B-spline, in closed form.

Samples c_j = exp(2 pi i f u_j) at the spacing p, as coefficients of a B-spline of degree 3, give sum over k of sinc(f p
+ k)^4 exp(2 pi i (f + k / p) (u - u_0)) exp(2 pi i f u_0). This is Poisson's sum of the B-spline, whose transform is
sinc^4. A Gaussian multiplies each wave by REST^((cutoff f)^2).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from references.rotation import Array

TERMS = 4000
REST = 0.01
"""Amplitude at the cutoff, as defined by the scene format."""


def tail(turns: int, count: int) -> float:
    """Bound of the terms left out, relative to a derivative's largest, for count / turns samples a wave: each is under
    (pi k)^-4 2 pi k / p, on both sides."""
    return 2.0 / (np.pi**4 * TERMS**2) * count / abs(turns)


class Wave(NamedTuple):
    """cos 2 pi (turns_u u / width + turns_v v / depth), sampled in the middles of columns x rows cells about 0."""

    columns: int
    rows: int
    width: float
    depth: float
    turns: tuple[int, int]

    def middles(self) -> tuple[Array, Array]:
        u = ((np.arange(self.columns) + 0.5) / self.columns - 0.5) * self.width
        v = ((np.arange(self.rows) + 0.5) / self.rows - 0.5) * self.depth
        return u, v

    def samples(self) -> Array:
        u, v = self.middles()
        phase = self.turns[0] * u / self.width + self.turns[1] * v[:, None] / self.depth
        return np.cos(2.0 * np.pi * phase)

    def frequency(self) -> float:
        """Waves per length, 1/m."""
        return float(np.hypot(self.turns[0] / self.width, self.turns[1] / self.depth))

    def texture(self, cutoff: float, u: ArrayLike, v: ArrayLike) -> tuple[Array, Array, Array]:
        """Values in [0, 1] at u, v (m) after the filter, and their derivatives by u and v, 1/m."""
        samples = self.samples()
        low, span = samples.min(), np.ptp(samples)
        amplitude = REST ** ((cutoff * self.frequency()) ** 2)
        first_u, first_v = (middle[0] for middle in self.middles())
        a, da = _spline(self.turns[0] / self.width, self.width / self.columns, first_u, u)
        b, db = _spline(self.turns[1] / self.depth, self.depth / self.rows, first_v, v)
        z = (amplitude * (a * b).real - low) / span
        return z, amplitude * (da * b).real / span, amplitude * (a * db).real / span


def _spline(f: float, p: float, first: float, u: ArrayLike) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    k = np.arange(-TERMS, TERMS + 1)
    shares = np.sinc(f * p + k) ** 4
    turn = 2j * np.pi * (f + k / p)
    start = np.exp(2j * np.pi * f * first)
    values = [np.exp(turn * (point - first)) * shares for point in np.atleast_1d(u)]
    value = np.array([terms.sum() for terms in values]) * start
    slope = np.array([(turn * terms).sum() for terms in values]) * start
    return value, slope
