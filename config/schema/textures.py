"""Texture of a surface: height and friction from an array in a file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec

from softfinger.config import limits
from softfinger.config.fields import Complaint, Length, Table, doc, is_usable, sized, within
from softfinger.config.schema.materials import Scale

Border = Literal["period", "clamp"]


class Texture(Table, frozen=True, kw_only=True):
    """Height and friction of a plane, cylinder or box from an array; its smallest value maps to 0, its largest to 1."""

    file: Annotated[str, sized(limits.FILE_NAME_LENGTH, "array (.npy, .npz, .csv) or grey picture (.pgm)", "ribs.csv")]
    size_m: Annotated[tuple[Length, Length], doc("size on the surface, along columns and rows", [0.02, 0.02])]
    border: Annotated[
        Border, doc("period: repeats; clamp: the border value continues; around a cylinder period only")
    ] = "period"
    height_m: (
        Annotated[
            float, within(limits.TEXTURE_HEIGHT_M, "height from value 0 to value 1; value 1 is on the surface", 1e-4)
        ]
        | None
    ) = None
    friction_scale: Annotated[tuple[Scale, Scale], doc("factors on friction at values 0 and 1", [0.5, 1.5])] | None = (
        None
    )
    speed_m_per_s: Annotated[
        float, within(limits.STROKE_M_PER_S, "fastest stroke to render at 1 kHz; finer detail is filtered out", 0.1)
    ] = 0.1

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.height_m, self.friction_scale) and self.height_m is None and self.friction_scale is None:
            fault = "is missing, as is friction_scale, so the texture has no effect: set one or both"
            yield "height_m", msgspec.UNSET, fault
