"""A scene as a whole, and what its tables demand of each other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Final

import msgspec

from softfinger.config import limits
from softfinger.config.schema.contact import Coupling, Fingertip, Passivity, Probe, Rolling
from softfinger.config.schema.effects import Effect
from softfinger.config.schema.fields import Complaint, Table, known, sized
from softfinger.config.schema.shapes import Object


class Scene(Table, frozen=True, kw_only=True):
    """What is touched and which effects are modelled."""

    fingertip: Fingertip
    rolling: Rolling | None = None
    coupling: Coupling = Coupling()
    probe: Probe = Probe()
    passivity: Passivity | None = None
    object: Annotated[tuple[Object, ...], sized(limits.OBJECTS, "what can be touched")]
    effect: Annotated[tuple[Effect, ...], sized(limits.EFFECTS, "what the workspace does to the hand")] = ()

    def faults(self) -> Iterator[Complaint]:
        yield from _coupling_faults(self)
        yield from _object_faults(self)
        yield from _law_faults(self)
        yield from _method_faults(self)
        yield from _tight_faults(self)


def _coupling_faults(scene: Scene) -> Iterator[Complaint]:
    if not known(scene.rolling, scene.coupling) or scene.rolling is None:
        return
    k_tau, k_t = scene.rolling.torque_stiffness_n_per_m, scene.coupling.stiffness_n_per_m
    if known(k_tau, k_t) and k_tau is not None and k_tau > k_t:
        yield (
            "rolling.torque_stiffness_n_per_m",
            k_tau,
            f"must be at most coupling.stiffness_n_per_m = {k_t:g} N/m, or a roll gives back more than was put in; "
            "leave it out to have the coupling's",
        )


_CLOSED_FORM: Final = ("plane", "sphere", "cylinder", "capsule", "box")
"""Shapes on which `rotation_vector` is in closed form."""


def _method_faults(scene: Scene) -> Iterator[Complaint]:
    if not known(scene.rolling, scene.object) or scene.rolling is None or scene.rolling.method != "rotation_vector":
        return
    for index, item in enumerate(scene.object):
        if known(item) and item.shape not in _CLOSED_FORM:
            yield (
                "rolling.method",
                "rotation_vector",
                f"has no closed form on object[{index}], which is of shape {item.shape}: choose montana_rk4, "
                "or midpoint for half the cost",
            )


def _tight_faults(scene: Scene) -> Iterator[Complaint]:
    if not known(scene.fingertip, scene.object) or not known(scene.fingertip.radius_m):
        return
    for index, item in enumerate(scene.object):
        if known(item):
            for key, seen, text in item.tight(scene.fingertip.radius_m):
                yield f"object[{index}].{key}", seen, text


def _law_faults(scene: Scene) -> Iterator[Complaint]:
    """Laws that cannot stand in one scene: one law is compiled for all objects."""
    if not known(scene.object, scene.rolling):
        return
    literal = scene.rolling is not None and scene.rolling.state_machine == "paper"
    coupled: dict[bool, str] = {}
    for index, item in enumerate(scene.object):
        if not known(item) or not known(item.material) or not known(item.material.friction, item.material.torsion):
            continue
        friction, torsion = item.material.friction, item.material.torsion
        where = f"object[{index}].material"
        if literal and friction is not None:
            for key in ("stribeck_speed_m_per_s", "viscous_s_per_m", "direction_x"):
                if getattr(friction, key) is not None:
                    yield f"{where}.friction.{key}", getattr(friction, key), _not_in_the_paper("Coulomb friction")
        if torsion is None or not known(torsion.model):
            continue
        if literal and torsion.model == "limit_surface":
            yield f"{where}.torsion.model", torsion.model, _not_in_the_paper("independent limits")
        coupled.setdefault(torsion.model == "limit_surface", f"object[{index}]")
        if len(coupled) > 1:
            yield (
                f"{where}.torsion.model",
                torsion.model,
                f"{coupled[torsion.model != 'limit_surface']} has another: either all objects with torsion have the "
                "model limit_surface, or none has",
            )
            return


def _not_in_the_paper(known_law: str) -> str:
    return f'rolling.state_machine = "paper" has {known_law} only: leave this out, or take the default machine'


def _object_faults(scene: Scene) -> Iterator[Complaint]:
    if not known(scene.object):
        return
    first: dict[str, int] = {}
    for index, item in enumerate(scene.object):
        if not known(item) or not known(item.name):
            continue
        if item.name in first:
            earlier = f"object[{first[item.name]}]"
            yield f"object[{index}].name", item.name, f"is the name of {earlier} already: choose another"
        first.setdefault(item.name, index)
    materials = [item.material if known(item) else msgspec.UNSET for item in scene.object]
    if scene.rolling is None or not known(scene.rolling, *materials):
        return
    if all(item.material.friction is None for item in scene.object):
        yield (
            "rolling",
            msgspec.UNSET,
            "needs friction to roll on, and no object has any: give one "
            "`friction = { static = 0.6, kinetic = 0.5 }` in its material, or leave [rolling] out",
        )
