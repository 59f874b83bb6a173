"""Rigid bodies that MuJoCo moves, and the materials of their geoms."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec

from softfinger.config import limits
from softfinger.config.fields import Complaint, Table, doc, is_usable, sized, within
from softfinger.config.schema.materials import Material


class GeomMaterial(Table, frozen=True, kw_only=True):
    """Material of the geoms that match all keys given here."""

    name: Annotated[str, sized(limits.NAME_LENGTH, "name of the geom", "box")] | None = None
    group: Annotated[int, within(limits.GEOM_GROUP, "group", 0)] | None = None
    default: Annotated[str, sized(limits.NAME_LENGTH, "class of defaults", "rubber")] | None = None
    material: Material

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.name, self.group, self.default) and not any(
            condition is not None for condition in (self.name, self.group, self.default)
        ):
            fault = "is missing, as are group and default: set one of the three, or use world.material"
            yield "name", msgspec.UNSET, fault


BodyMass = Annotated[float, msgspec.Meta(ge=limits.BODY_MASS_KG.low, le=limits.BODY_MASS_KG.high)]


class World(Table, frozen=True, kw_only=True):
    """Bodies of a MuJoCo model. MuJoCo moves them, and fingers touch their geoms. Needs softfinger[world]."""

    model: Annotated[str, sized(limits.FILE_NAME_LENGTH, "MJCF or URDF file", "box.xml")]
    root: (
        Annotated[
            str,
            sized(
                limits.FILE_NAME_LENGTH, "folder that contains all files of the model; default: that of the model", ".."
            ),
        ]
        | None
    ) = None
    timestep: Annotated[
        Literal["tick", "file"],
        doc(
            "tick: a tick divided by substeps, instead of the model's; file: the model's, which must fit the tick",
            "tick",
        ),
    ] = "tick"
    keyframe: (
        Annotated[
            str,
            sized(limits.NAME_LENGTH, "<key> of the model with the initial state of the bodies and its ctrl", "home"),
        ]
        | None
    ) = None
    substeps: Annotated[
        int, within(limits.SUBSTEPS, "contact and simulation steps per tick; very light bodies need several", 1)
    ] = 1
    budget_us: (
        Annotated[float, within(limits.STEP_BUDGET_US, "time limit of a step of the bodies; default: none", 300.0)]
        | None
    ) = None
    mass_kg: Annotated[
        dict[str, BodyMass],
        doc(
            "masses that replace those of the model, by name of the body; its inertia is scaled by the same factor",
            {"box": 0.2},
        ),
    ] = msgspec.field(default_factory=dict)
    material: Annotated[
        Material | None,
        doc("material of every geom without a material in [[world.geom]]; without it these geoms are not touched"),
    ] = None
    geom: Annotated[
        tuple[GeomMaterial, ...],
        sized(limits.GEOM_MATERIALS, "materials of selected geoms; if several match, the last one applies"),
    ] = ()

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.model) and not self.model.lower().endswith((".xml", ".mjcf", ".urdf")):
            yield "model", self.model, "must end in .xml, .mjcf or .urdf: name a MuJoCo model file"
