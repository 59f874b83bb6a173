"""Ramps of parameters that change while the loop runs, advanced by the loop once per tick.

If the stiffness halves in contact, half of the force disappears at once; with a ramp of a tenth of a second the hand
can follow. Parameters that act on the force are ramped: materials, the fingertip's coupling, patch and radius, and the
strength of effects. All of them are ramped over the same ticks, so that related values remain consistent: the sum of a
spring and a push, or kinetic friction below static friction. All other parameters, such as the position of an object, a
direction, a frequency or a limit of the guard, change at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.pack import flatten
from softfinger.proxy.kernels.jit.rows import Rows

IMMEDIATE: Final = 0
LINEAR: Final = 1
GEOMETRIC: Final = 2

_EFFECTS: Final[Mapping[type, frozenset[str]]] = {
    model.Viscosity: frozenset({"damping"}),
    model.ConstantForce: frozenset({"force"}),
    model.Spring: frozenset({"stiffness", "force_max"}),
    model.BoxBoundary: frozenset({"stiffness", "damping", "force_max"}),
    model.SphereBoundary: frozenset({"stiffness", "damping", "force_max"}),
    model.Vibration: frozenset({"amplitude"}),
    model.NormalVibration: frozenset({"amplitude"}),
    model.Magnet: frozenset({"force"}),
    model.StickSlip: frozenset({"stiffness", "force_max"}),
}
_RAMPED: Final[Mapping[type, frozenset[str]]] = {
    **_EFFECTS,
    model.Object: frozenset({"material"}),
    model.Entry: frozenset({"normal"}),
    model.Material: frozenset(model.Material._fields),
    model.Finger: frozenset({"radius", "coupling", "torque_stiffness", "patch"}),
    model.Relief: frozenset({"height"}),
    model.Grip: frozenset({"low", "high"}),
}
"""Fields whose numbers are all ramped, by type of node."""


class ParameterRamp(NamedTuple):
    """Ramp from the present parameters to the requested ones.

    kinds        (n,)  kind of each leaf: IMMEDIATE, LINEAR, GEOMETRIC
    now, target  (n,)  values as returned by `flatten_tuning`
    ticks_left   (1,)  remaining ticks, of which the last sets the exact target; -1 when the ramp is finished
    rows         (k,)  indices of leaves that are addresses of rows of objects
    addresses    (k,)  their values: addresses inside `now`, which ends with those objects; kernels read them there
    ticks              length of the ramp, at least 1
    """

    kinds: NDArray[np.int64]
    now: NDArray[np.float64]
    target: NDArray[np.float64]
    ticks_left: NDArray[np.int64]
    rows: NDArray[np.int64]
    addresses: NDArray[np.float64]
    ticks: int


def flatten_tuning(tuning: Any) -> NDArray[np.float64]:
    """Return the leaves (n,) of a tuning as `flatten` orders them, followed by the leaves of objects in rows."""
    return np.concatenate([flatten(tuning), *(rows.array for _, rows in _list_rows(tuning))])


def make_ramp(tuning: Any, ticks: int) -> ParameterRamp:
    """Return a ramp for a tuning that takes `ticks` ticks; 0 changes parameters at once."""
    now, rows = flatten_tuning(tuning), _list_rows(tuning)
    row_trees = [tree for _, objects in rows for tree in objects.trees]
    kinds = [kind for tree in (tuning, *row_trees) for kind in _list_kinds(tree, IMMEDIATE)]
    offsets = len(now) - np.cumsum([len(objects.array) for _, objects in rows][::-1], dtype=np.int64)[::-1]
    return ParameterRamp(
        np.array(kinds, np.int64),
        now,
        now.copy(),
        np.full(1, -1, np.int64),
        np.array([leaf for leaf, _ in rows], np.int64),
        (now.ctypes.data + now.itemsize * offsets).view(np.float64),
        max(ticks, 1),
    )


def _list_rows(tuning: Any) -> list[tuple[int, Rows]]:
    """Return the objects in rows, each with the index of the leaf that is their address."""
    arrays, leaf = list[tuple[int, Rows]](), 0

    def walk(node: Any) -> None:
        nonlocal leaf
        if isinstance(node, tuple):
            for child in node:
                walk(child)
            return
        if isinstance(node, Rows) and isinstance(node[0], model.Entry | model.Material | model.Texture):
            arrays.append((leaf, node))
        leaf += 1

    walk(tuning)
    return arrays


def _list_kinds(node: Any, kind: int) -> list[int]:
    """Return the kind of each leaf of a tree, in the order of `flatten`; `kind` is inherited from the parent field."""
    if not isinstance(node, tuple):
        return [IMMEDIATE if isinstance(node, ReadOnly) else kind]  # the leaf of an array is its address
    children = dict(zip(getattr(node, "_fields", range(len(node))), node, strict=True))
    return [
        kind_of_leaf
        for name, child in children.items()
        for kind_of_leaf in _list_kinds(child, _find_kind(node, name, kind))
    ]


def _find_kind(node: Any, field: Any, kind: int) -> int:
    match node, field:
        case model.PowerNormal(), "coefficient":  # its unit contains the exponent: force scales geometrically
            return GEOMETRIC
        case model.AnisotropicFriction(), "direction":
            return IMMEDIATE
        case model.Finger(form=model.EllipsoidTip()), "radius":  # follows from the form, which is not ramped
            return IMMEDIATE
    return LINEAR if field in _RAMPED.get(type(node), ()) else kind


@jit
def set_now(ramp: ParameterRamp, values: NDArray[np.float64]) -> None:
    """Set the parameters to `values` (n,) at once."""
    for i in range(values.shape[0]):
        ramp.now[i] = ramp.target[i] = values[i]
    ramp.ticks_left[0] = -1
    _restore_addresses(ramp)


@jit
def set_target(ramp: ParameterRamp, values: NDArray[np.float64]) -> None:
    """Set the target to `values` (n,); restart the ramp of all values if a ramped one changes."""
    changed = False
    for i in range(values.shape[0]):
        changed |= ramp.kinds[i] != IMMEDIATE and values[i] != ramp.target[i]
        ramp.target[i] = values[i]
    if changed:
        ramp.ticks_left[0] = ramp.ticks
    elif ramp.ticks_left[0] < 0:
        ramp.ticks_left[0] = 1


@jit
def advance(ramp: ParameterRamp) -> None:
    """Advance by one tick; call it only while ticks remain."""
    ticks_left = ramp.ticks_left[0]
    for i in range(ramp.now.shape[0]):
        if ramp.kinds[i] == IMMEDIATE or ticks_left <= 1:
            ramp.now[i] = ramp.target[i]
        elif ramp.kinds[i] == LINEAR:
            ramp.now[i] += (ramp.target[i] - ramp.now[i]) / ticks_left
        else:
            ramp.now[i] *= (ramp.target[i] / ramp.now[i]) ** (1.0 / ticks_left)
    ramp.ticks_left[0] = ticks_left - 1 if ticks_left > 1 else -1
    _restore_addresses(ramp)


@jit
def _restore_addresses(ramp: ParameterRamp) -> None:
    for k in range(ramp.rows.shape[0]):
        ramp.now[ramp.rows[k]] = ramp.addresses[k]
