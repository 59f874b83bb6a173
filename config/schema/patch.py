"""The soft fingertip's contact patch."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from softfinger.config import limits
from softfinger.config.schema.fields import Complaint, Table, known, within


class Patch(Table, frozen=True, kw_only=True):
    """What a soft fingertip touches with; torsion follows from it, and not from the numbers of the material's."""

    shear_modulus_pa: Annotated[
        float,
        within(limits.SHEAR_MODULUS_PA, "shear modulus of the pad (G), which is incompressible", 45e3),
    ]
    radius_m: (
        Annotated[
            float,
            within(
                limits.PATCH_RADIUS_M,
                "its radius under 1 N (c): c (f_N / 1 N)^gamma; left out: Hertz's, (3 f_N r / 16 G)^(1/3)",
                0.004,
            ),
        ]
        | None
    ) = None
    exponent: (
        Annotated[
            float,
            within(limits.TORSION_EXPONENT, "growth of radius_m with the force (gamma); left out: 1/3, Hertz's", 0.25),
        ]
        | None
    ) = None
    pressure_exponent: (
        Annotated[
            float,
            within(
                limits.PRESSURE_EXPONENT,
                "how even the pressure on a patch of radius_m is (k): (1 - (s / a)^k)^(1/k) at s from its centre; left "
                "out: 2, Hertz's",
                3.0,
            ),
        ]
        | None
    ) = None
    rolling_loss: (
        Annotated[
            float,
            within(
                limits.ROLLING_LOSS,
                "share of the elastic work that a roll loses (alpha): resists rolling by 3/16 alpha a f_N; left out: "
                "nothing resists",
                0.3,
            ),
        ]
        | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        if not known(self.radius_m) or self.radius_m is not None:
            return
        for key in ("exponent", "pressure_exponent"):
            given = getattr(self, key)
            if known(given) and given is not None:
                yield key, given, "belongs to a patch of radius_m, this one is Hertz's: give radius_m, or leave it out"
