"""Result of one tick for Python, with typed attributes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Generic, Self, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.record import CAUSE_NAMES, NAMED, ContactMode

T = TypeVar("T")

Array = NDArray[np.float64]


class Part(Generic[T]):
    """Descriptor of a record field as an attribute of Step, converted on access: most fields are never read."""

    def __init__(self, read: Callable[[Any], T], name: str) -> None:
        self.field: Final = NAMED[name]
        self._read: Final = read
        at, size = self.field.at, self.field.size
        self._at: Final = slice(at, at + size) if size > 1 else at
        self.__doc__ = f"{name}: {self.field.meaning}; {self.field.unit}, {self.field.frame}".rstrip(", ")

    @overload
    def __get__(self, step: None, owner: type[Step]) -> Self: ...

    @overload
    def __get__(self, step: Step, owner: type[Step]) -> T: ...

    def __get__(self, step: Step | None, owner: type[Step]) -> Self | T:
        return self if step is None else self._read(step.record[self._at])


def _read_vector(values: Array) -> Array:
    return values


def _read_mode(number: float) -> ContactMode:
    return ContactMode(int(number))


def _read_cause(number: float) -> str:
    return CAUSE_NAMES[int(number)]


class Step:
    """Result of one tick: the fields of the record that a contact step computes, with `cause` as a name.

    Vectors are (3,) float64 in the world frame; `finger_point`, `patch_normal` and `patch_stretch` in the fingertip
    frame. `record` is the complete row.
    """

    __slots__ = ("record",)

    mode = Part(_read_mode, "contact.mode")
    object = Part(int, "contact.object")
    cause = Part(_read_cause, "contact.cause")
    velocity = Part(_read_vector, "probe.velocity")
    proxy_position = Part(_read_vector, "proxy.position")
    penetration = Part(float, "contact.penetration")
    point = Part(_read_vector, "contact.point")
    normal = Part(_read_vector, "contact.normal")
    finger_point = Part(_read_vector, "contact.finger_point")
    rolled = Part(float, "contact.rolled")
    spin = Part(float, "contact.spin")
    normal_force = Part(float, "contact.normal_force")
    tangential_force = Part(float, "contact.tangential_force")
    force = Part(_read_vector, "force")
    torque = Part(_read_vector, "torque")
    torsion = Part(float, "contact.torsion")
    patch_radius = Part(float, "contact.patch_radius")
    patch_normal = Part(_read_vector, "contact.patch_normal")
    patch_stretch = Part(_read_vector, "contact.patch_stretch")
    budget = Part(int, "contact.budget")
    displacement = Part(_read_vector, "contact.displacement")
    nonlinear = Part(int, "contact.nonlinear")

    def __init__(self, record: Array) -> None:
        self.record = record

    def __repr__(self) -> str:
        return f"Step({', '.join(f'{name}={getattr(self, name)!r}' for name in STEP_FIELDS)})"


STEP_FIELDS: Final = {name: part.field for name, part in vars(Step).items() if isinstance(part, Part)}
"""Field of the record for each attribute of Step."""
