"""Parameters that are changed while the loop runs go to their new values tick by tick.

A stiffness that falls to half in contact takes half of the force away at once; over a tenth of a second the hand
follows. What acts on the force is ramped: materials, the fingertip's coupling, patch and radius, how strong effects
are. All of it is on its way for the same ticks, so that what belongs together stays together: the sum of a spring and
a push, friction that is kinetic and below the static one. Everything else, such as where an object is, a direction, a
frequency, a limit of the guard, takes effect at once.
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

AT_ONCE: Final = 0
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
"""Fields all of whose numbers are ramped, by kind of node."""


class Way(NamedTuple):
    """From the parameters of now to those that are wanted.

    kinds        (n,)  of each leaf: AT_ONCE, LINEAR, GEOMETRIC
    now, target  (n,)  what `leaves` gives
    left         (1,)  ticks to go, the last of them takes over the target to the bit; -1 when there
    rows         (k,)  leaves that are addresses of rows of objects
    addresses    (k,)  what they are in `now`, whose end has those objects: a kernel reads them there
    ticks              that a change takes, 1 or more
    """

    kinds: NDArray[np.int64]
    now: NDArray[np.float64]
    target: NDArray[np.float64]
    left: NDArray[np.int64]
    rows: NDArray[np.int64]
    addresses: NDArray[np.float64]
    ticks: int


def leaves(tuning: Any) -> NDArray[np.float64]:
    """Leaves (n,) of a tuning, as `flatten` gives them, and behind them those of objects in rows."""
    return np.concatenate([flatten(tuning), *(rows.array for _, rows in _rows(tuning))])


def make_way(tuning: Any, ticks: int) -> Way:
    """The way of a tuning that takes so many ticks; at once where it is none."""
    now, rows = leaves(tuning), _rows(tuning)
    behind = [tree for _, those in rows for tree in those.trees]
    kinds = [kind for tree in (tuning, *behind) for kind in _kinds(tree, AT_ONCE)]
    begins = len(now) - np.cumsum([len(those.array) for _, those in rows][::-1], dtype=np.int64)[::-1]
    return Way(
        np.array(kinds, np.int64),
        now,
        now.copy(),
        np.full(1, -1, np.int64),
        np.array([leaf for leaf, _ in rows], np.int64),
        (now.ctypes.data + now.itemsize * begins).view(np.float64),
        max(ticks, 1),
    )


def _rows(tuning: Any) -> list[tuple[int, Rows]]:
    """Objects in rows, each with which leaf their address is."""
    found, leaf = list[tuple[int, Rows]](), 0

    def walk(node: Any) -> None:
        nonlocal leaf
        if isinstance(node, tuple):
            for child in node:
                walk(child)
            return
        if isinstance(node, Rows) and isinstance(node[0], model.Entry | model.Material | model.Texture):
            found.append((leaf, node))
        leaf += 1

    walk(tuning)
    return found


def _kinds(node: Any, kind: int) -> list[int]:
    """What each leaf of a tree is, in the order of `flatten`, below a field that is of this kind."""
    if not isinstance(node, tuple):
        return [AT_ONCE if isinstance(node, ReadOnly) else kind]  # an array's leaf is its address
    named = dict(zip(getattr(node, "_fields", range(len(node))), node, strict=True))
    return [each for name, child in named.items() for each in _kinds(child, _kind_of(node, name, kind))]


def _kind_of(node: Any, field: Any, kind: int) -> int:
    match node, field:
        case model.PowerNormal(), "coefficient":  # its unit has the exponent: the force at any depth goes geometrically
            return GEOMETRIC
        case model.Anisotropic(), "direction":
            return AT_ONCE
        case model.Finger(form=model.EllipsoidTip()), "radius":  # it is one of the form's, which is not ramped
            return AT_ONCE
    return LINEAR if field in _RAMPED.get(type(node), ()) else kind


@jit
def stay(way: Way, values: NDArray[np.float64]) -> None:
    """Be at `values` (n,), with nowhere to go."""
    for i in range(values.shape[0]):
        way.now[i] = way.target[i] = values[i]
    way.left[0] = -1
    _keep_rows(way)


@jit
def head_for(way: Way, values: NDArray[np.float64]) -> None:
    """Want `values` (n,). Where one that is ramped has changed, all are on their way anew from where they are."""
    changed = False
    for i in range(values.shape[0]):
        changed |= way.kinds[i] != AT_ONCE and values[i] != way.target[i]
        way.target[i] = values[i]
    if changed:
        way.left[0] = way.ticks
    elif way.left[0] < 0:
        way.left[0] = 1


@jit
def advance(way: Way) -> None:
    """Go on by one tick; only where there is a way to go."""
    left = way.left[0]
    for i in range(way.now.shape[0]):
        if way.kinds[i] == AT_ONCE or left <= 1:
            way.now[i] = way.target[i]
        elif way.kinds[i] == LINEAR:
            way.now[i] += (way.target[i] - way.now[i]) / left
        else:
            way.now[i] *= (way.target[i] / way.now[i]) ** (1.0 / left)
    way.left[0] = left - 1 if left > 1 else -1
    _keep_rows(way)


@jit
def _keep_rows(way: Way) -> None:
    for k in range(way.rows.shape[0]):
        way.now[way.rows[k]] = way.addresses[k]
