"""What is fine about a surface: heights and friction from numbers of a file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec

from softfinger.config import limits
from softfinger.config.schema.fields import Complaint, Length, Table, known, said, sized, within
from softfinger.config.schema.materials import Scale

Border = Literal["period", "clamp"]


class Texture(Table, frozen=True, kw_only=True):
    """Height and friction of a surface from the numbers of a file, the lowest to the highest."""

    file: Annotated[
        str,
        sized(
            limits.FILE_NAME_LENGTH,
            "array as .npy, .npz or .csv, or grey picture as .pgm; where its name has no root, in the scene's folder",
            "ribs.csv",
        ),
    ]
    size_m: Annotated[
        tuple[Length, Length], said("extent of the array on the surface, along its columns and rows", [0.02, 0.02])
    ]
    border: Annotated[
        Border, said("period: the array is laid side by side; clamp: its border goes on; around a cylinder period only")
    ] = "period"
    height_m: (
        Annotated[
            float, within(limits.TEXTURE_HEIGHT_M, "from the lowest value to the highest, which is the surface", 1e-4)
        ]
        | None
    ) = None
    friction_scale: (
        Annotated[tuple[Scale, Scale], said("factors of friction at the lowest and at the highest value", [0.5, 1.5])]
        | None
    ) = None
    speed_m_per_s: Annotated[
        float, within(limits.STROKE_M_PER_S, "fastest stroke that 1 kHz is to carry; what is too fine is removed", 0.1)
    ] = 0.1

    def faults(self) -> Iterator[Complaint]:
        if known(self.height_m, self.friction_scale) and self.height_m is None and self.friction_scale is None:
            yield "height_m", msgspec.UNSET, "give height_m or friction_scale or both: this texture does nothing"
