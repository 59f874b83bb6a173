"""What a scene and a rig may say: structs whose field names carry their unit.

An absent table is `None` for whatever is then not modelled (rolling, friction, torsion): the
contact step is compiled without it. Values are SI. Structs built in code are not range-checked;
`load.build` does that, with the ranges given here and in `limits`.

A struct may have `faults()`, for what concerns several of its fields. `load.build` calls it on the
struct as far as it could be read: a field with an unusable value holds `UNSET`, hence `known`.
"""

from softfinger.config.schema.contact import (
    Coupling,
    Fingertip,
    Passivity,
    PassivityMode,
    Probe,
    Rolling,
    RollingMethod,
    StateMachine,
)
from softfinger.config.schema.effects import (
    Boundary,
    ConstantForce,
    Effect,
    EffectBase,
    Magnet,
    ObjectEffect,
    ObjectForce,
    ObjectVibration,
    ObjectViscosity,
    Region,
    Spring,
    StickSlip,
    Vibration,
    Viscosity,
)
from softfinger.config.schema.fields import (
    Complaint,
    Component,
    Coordinate,
    Length,
    Table,
    known,
    said,
    sized,
    unit,
    within,
)
from softfinger.config.schema.materials import Friction, Material, Torsion, TorsionModel
from softfinger.config.schema.motions import Driven, Motion, Sinusoid, Turntable
from softfinger.config.schema.rig import DeviceConfig, Guard, RealtimeMode, Rig, Servo, Telemetry, endpoint_complaint
from softfinger.config.schema.scene import Scene
from softfinger.config.schema.shapes import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Object,
    ObjectBase,
    Plane,
    Sphere,
    Torus,
)

__all__ = [
    "Boundary",
    "Box",
    "Capsule",
    "Complaint",
    "Component",
    "ConstantForce",
    "Coordinate",
    "Coupling",
    "Cylinder",
    "DeviceConfig",
    "Driven",
    "Effect",
    "EffectBase",
    "Ellipsoid",
    "Fingertip",
    "Friction",
    "Guard",
    "Length",
    "Magnet",
    "Material",
    "Motion",
    "Object",
    "ObjectBase",
    "ObjectEffect",
    "ObjectForce",
    "ObjectVibration",
    "ObjectViscosity",
    "Passivity",
    "PassivityMode",
    "Plane",
    "Probe",
    "RealtimeMode",
    "Region",
    "Rig",
    "Rolling",
    "RollingMethod",
    "Scene",
    "Servo",
    "Sinusoid",
    "Sphere",
    "Spring",
    "StateMachine",
    "StickSlip",
    "Table",
    "Telemetry",
    "Torsion",
    "TorsionModel",
    "Torus",
    "Turntable",
    "Vibration",
    "Viscosity",
    "endpoint_complaint",
    "known",
    "said",
    "sized",
    "unit",
    "within",
]
