"""Contact patch of a soft fingertip."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from softfinger.config import limits
from softfinger.config.fields import Complaint, Table, is_usable, within


class Patch(Table, frozen=True, kw_only=True):
    """Contact patch of a soft fingertip; it determines the torsional stiffness and limit in place of the material."""

    shear_modulus_pa: Annotated[
        float, within(limits.SHEAR_MODULUS_PA, "shear modulus of the incompressible pad (G)", 45e3)
    ]
    radius_m: (
        Annotated[
            float,
            within(
                limits.PATCH_RADIUS_M,
                "patch radius at 1 N (c), in a = c (f_N / 1 N)^gamma; default: Hertz, a = (3 f_N r / 16 G)^(1/3)",
                0.004,
            ),
        ]
        | None
    ) = None
    exponent: (
        Annotated[
            float,
            within(limits.TORSION_EXPONENT, "exponent of the patch radius (gamma); needs radius_m; default: 1/3", 0.25),
        ]
        | None
    ) = None
    pressure_exponent: (
        Annotated[
            float,
            within(
                limits.PRESSURE_EXPONENT,
                "exponent of the pressure p ~ (1 - (s / a)^k)^(1/k) at the distance s from the centre (k); needs "
                "radius_m; default: 2, Hertz",
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
                "share of the elastic work lost in rolling (alpha), a resistance of 3/16 alpha a f_N; default: none",
                0.3,
            ),
        ]
        | None
    ) = None

    def faults(self) -> Iterator[Complaint]:
        if not is_usable(self.radius_m) or self.radius_m is not None:
            return
        for key in ("exponent", "pressure_exponent"):
            value = getattr(self, key)
            if is_usable(value) and value is not None:
                yield key, value, "applies to a patch with radius_m, not to that of Hertz: add radius_m, or remove it"
