"""Scene, and the conditions between its tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, NamedTuple, TypeVar

import msgspec

from softfinger.config import limits
from softfinger.config.fields import Complaint, Table, is_usable, sized
from softfinger.config.schema.contact import (
    Coupling,
    Finger,
    Fingertip,
    FingertipShape,
    Passivity,
    Patch,
    Probe,
    Rolling,
)
from softfinger.config.schema.effects import Effect
from softfinger.config.schema.materials import Material
from softfinger.config.schema.object_parts import Body
from softfinger.config.schema.shapes import Mesh, Object
from softfinger.config.schema.world import World

Item = TypeVar("Item")


class FingerParts(NamedTuple):
    """Fingertip of a finger, from [fingertip] or [[finger]]; the one of [fingertip] has an empty name.

    radius_m is the radius of a sphere, or the smallest of the radii_m of an ellipsoid.
    """

    name: str
    device: str
    radius_m: float
    radii_m: tuple[float, float, float] | None
    orientation_wxyz: tuple[float, float, float, float]
    patch: Patch | None
    coupling: Coupling
    probe: Probe


class Scene(Table, frozen=True, kw_only=True):
    """Fingertips, objects and effects."""

    fingertip: Fingertip | None = None
    finger: Annotated[tuple[Finger, ...], sized(limits.FINGERS, "several fingertips, in place of [fingertip]")] = ()
    rolling: Rolling | None = None
    coupling: Coupling = Coupling()
    probe: Probe = Probe()
    passivity: Passivity | None = None
    object: Annotated[tuple[Object, ...], sized(limits.OBJECTS, "objects to touch")] = ()
    effect: Annotated[tuple[Effect, ...], sized(limits.EFFECTS, "effects of the workspace")] = ()
    world: World | None = None

    @property
    def fingers(self) -> tuple[FingerParts, ...]:
        """All fingers: one, or several. [coupling] and [probe] apply to a finger without such tables."""
        if self.fingertip is not None:
            tip = self.fingertip
            return (self._make_parts(tip, "", "", self.coupling, self.probe),)
        return tuple(
            self._make_parts(
                finger,
                finger.name,
                finger.device or finger.name,
                finger.coupling or self.coupling,
                finger.probe or self.probe,
            )
            for finger in self.finger
        )

    @staticmethod
    def _make_parts(tip: Fingertip | Finger, name: str, device: str, coupling: Coupling, probe: Probe) -> FingerParts:
        turn = tip.orientation_wxyz or (1.0, 0.0, 0.0, 0.0)
        return FingerParts(name, device, tip.radius_range_m[0], tip.radii_m, turn, tip.patch, coupling, probe)

    @property
    def elastic_object(self) -> Mesh | None:
        """The elastic object, which is the only object of its scene; None: no elastic object."""
        obj = self.object[0] if len(self.object) == 1 else None
        return obj if isinstance(obj, Mesh) and obj.elastic is not None else None

    @property
    def soft(self) -> bool:
        """True if the fingertips have a contact patch; either all have one, or none has."""
        return any(finger.patch is not None for finger in self.fingers)

    def faults(self) -> Iterator[Complaint]:
        yield from _check_fingers(self)
        yield from _check_world(self)
        yield from _check_patches(self)
        yield from _check_couplings(self)
        yield from _check_objects(self)
        yield from _check_laws(self)
        yield from _check_torsion(self)
        yield from _check_method(self)
        yield from _check_ellipsoids(self)
        yield from _check_room(self)
        yield from _check_elastic(self)


def _iter_usable(key: str, items: tuple[Item, ...], *names: str) -> Iterator[tuple[str, Item]]:
    """Yield path and item of each usable entry of a list whose fields `names` are usable, too."""
    for index, item in enumerate(items if is_usable(items) else ()):
        if is_usable(item) and is_usable(*(getattr(item, name) for name in names)):
            yield f"{key}[{index}]", item


def _check_fingers(scene: Scene) -> Iterator[Complaint]:
    if not is_usable(scene.fingertip, scene.finger):
        return
    if scene.fingertip is None and not scene.finger:
        fault = "is missing: add the table [fingertip], or a table [[finger]] for each of several fingers"
        yield "fingertip", msgspec.UNSET, fault
    if scene.fingertip is not None and scene.finger:
        fault = (
            "cannot be combined with [[finger]]: it is the short form for one finger; remove it, or remove the "
            "tables [[finger]]"
        )
        yield "fingertip", msgspec.UNSET, fault
    fingers = list(_iter_usable("finger", scene.finger, "name", "device"))
    for index, (path, item) in enumerate(fingers):
        for earlier_path, earlier in fingers[:index]:
            if item.name.startswith(earlier.name) or earlier.name.startswith(item.name):
                fault = (
                    f"overlaps with the name of {earlier_path}, {earlier.name!r}: a subscriber to the shorter name "
                    "would receive the telemetry of both; choose another name"
                )
                yield f"{path}.name", item.name, fault
            device = item.device or item.name
            if device == (earlier.device or earlier.name) and (item.device or earlier.device):
                yield f"{path}.device", device, f"already moves {earlier_path}: use another device"


def _check_world(scene: Scene) -> Iterator[Complaint]:
    if not is_usable(scene.world, scene.object):
        return
    if scene.world is None and not scene.object:
        yield "object", msgspec.UNSET, "is missing: add at least one table [[object]]"
    for path, item in _iter_usable("object", scene.object):
        if not isinstance(item.motion, Body):
            continue
        if scene.world is None:
            yield f"{path}.motion", "body", "needs a table [world] with the model that contains the body"
        elif is_usable(item.effect) and item.effect:
            fault = "would push the hand but not the body: remove the effect, or the motion of the object"
            yield f"{path}.effect", item.effect[0].kind, fault


def _check_patches(scene: Scene) -> Iterator[Complaint]:
    """Check that all fingers have a patch, or none: one law of torsion is compiled for all of them."""
    fingers = list(_iter_usable("finger", scene.finger, "patch"))
    if not any(item.patch is not None for _, item in fingers):
        return
    for path, item in fingers:
        if item.patch is None:
            fault = "is missing, but another finger has a patch: add one to every finger, or remove all"
            yield f"{path}.patch", msgspec.UNSET, fault


def _check_couplings(scene: Scene) -> Iterator[Complaint]:
    if not is_usable(scene.rolling, scene.coupling, scene.finger) or scene.rolling is None:
        return
    couplings = [(f"{path}.coupling", item.coupling) for path, item in _iter_usable("finger", scene.finger)]
    k_tau = scene.rolling.torque_stiffness_n_per_m
    for path, coupling in [("coupling", scene.coupling), *couplings]:
        if not is_usable(k_tau, coupling) or k_tau is None or coupling is None:
            continue
        k_t = coupling.stiffness_n_per_m
        if is_usable(k_t) and k_tau > k_t:
            fault = (
                f"must be at most {path}.stiffness_n_per_m = {k_t:g} N/m, otherwise rolling generates energy: lower it "
                "or, to use the stiffness of the coupling, remove it"
            )
            yield "rolling.torque_stiffness_n_per_m", k_tau, fault


def _check_method(scene: Scene) -> Iterator[Complaint]:
    if not is_usable(scene.rolling, scene.object) or scene.rolling is None or scene.rolling.method != "rotation_vector":
        return
    for path, item in _iter_usable("object", scene.object, "shape"):
        if not item.unrolls:
            fault = f"has no closed form for the {item.shape} {path}: use montana_rk4, or midpoint at half the cost"
            yield "rolling.method", "rotation_vector", fault


def _check_ellipsoids(scene: Scene) -> Iterator[Complaint]:
    if not is_usable(scene.fingertip, scene.finger):
        return
    fingertips: list[tuple[str, FingertipShape]] = [*_iter_usable("finger", scene.finger, "radii_m")]
    if scene.fingertip is not None and is_usable(scene.fingertip.radii_m):
        fingertips.append(("fingertip", scene.fingertip))
    tip_path = next((path for path, tip in fingertips if tip.radii_m is not None), None)
    if tip_path is None:
        return
    key = f"{tip_path}.radii_m"
    if is_usable(scene.rolling) and scene.rolling is not None and is_usable(scene.rolling.method):
        method = scene.rolling.method
        if method not in ("midpoint", "montana_rk4", "montana_rk45"):
            fault = f"needs a spherical fingertip, but {key} is set: use midpoint, or montana_rk4 for long ticks"
            yield "rolling.method", method, fault
    for path, item in _iter_usable("object", scene.object, "shape"):
        if all(is_usable(getattr(item, name)) for name in item.__struct_fields__) and not item.bears_ellipsoid:
            fault = (
                f"cannot be touched by an ellipsoidal fingertip ({key}): use a plane, a sphere or infinite cylinder "
                "touched from outside, or a box touched from inside; or use radius_m"
            )
            yield f"{path}.shape", item.shape, fault
        texture = getattr(item, "texture", None)
        if is_usable(texture) and texture is not None:
            fault = f"needs a spherical fingertip, but {key} is set: remove the texture, or use radius_m"
            yield f"{path}.texture", msgspec.UNSET, fault


def _list_tips(scene: Scene) -> list[Fingertip | Finger]:
    return [scene.fingertip] if scene.fingertip is not None else [item for item in scene.finger if is_usable(item)]


def _check_room(scene: Scene) -> Iterator[Complaint]:
    if not is_usable(scene.fingertip, scene.finger, scene.object):
        return
    tips = _list_tips(scene)
    radii = [tip.radius_range_m[1] for tip in tips if is_usable(tip.radius_m, tip.radii_m)]
    for path, item in _iter_usable("object", scene.object):
        if any(radii):  # if the largest fits, all fit
            for key, value, text in item.check_room(max(radii)):
                yield f"{path}.{key}", value, text


def _iter_materials(scene: Scene) -> Iterator[tuple[str, Material]]:
    """Yield the path of each object and its material, if friction and torsion are usable."""
    for path, item in _iter_usable("object", scene.object, "material"):
        if is_usable(item.material.friction, item.material.torsion):
            yield path, item.material


def _check_laws(scene: Scene) -> Iterator[Complaint]:
    """Check that the laws of all objects can be combined: one law is compiled for all of them."""
    if not is_usable(scene.object, scene.rolling):
        return
    literal = scene.rolling is not None and scene.rolling.state_machine == "paper"
    coupled: dict[bool, str] = {}
    for object_path, material in _iter_materials(scene):
        friction, torsion, path = material.friction, material.torsion, f"{object_path}.material"
        if literal and friction is not None:
            for key in ("stribeck_speed_m_per_s", "viscous_s_per_m", "direction_x"):
                if getattr(friction, key) is not None:
                    yield (
                        f"{path}.friction.{key}",
                        getattr(friction, key),
                        _describe_missing_in_paper("Coulomb friction"),
                    )
        if torsion is None or not is_usable(torsion.model):
            continue
        if literal and torsion.model == "limit_surface":
            yield f"{path}.torsion.model", torsion.model, _describe_missing_in_paper("independent limits")
        coupled.setdefault(torsion.model == "limit_surface", object_path)
        if len(coupled) > 1:
            fault = (
                f"differs from {coupled[torsion.model != 'limit_surface']}: use limit_surface for all objects with "
                "torsion, or for none"
            )
            yield f"{path}.torsion.model", torsion.model, fault
            return


def _check_torsion(scene: Scene) -> Iterator[Complaint]:
    if not is_usable(scene.fingertip, scene.finger, scene.object):
        return
    tips = _list_tips(scene)
    if not tips or not is_usable(*(tip.patch for tip in tips)):
        return
    soft = any(tip.patch is not None for tip in tips)
    for object_path, material in _iter_materials(scene):
        torsion, path = material.torsion, f"{object_path}.material.torsion"
        if torsion is None:
            continue
        lacking = [key for key in ("stiffness_nm_per_rad", "friction_length_m") if getattr(torsion, key) is None]
        if not soft:
            table = "[fingertip.patch]" if scene.fingertip is not None else "[finger.patch]"
            for key in lacking:
                yield f"{path}.{key}", msgspec.UNSET, f"is missing: add it, or add {table}"
        elif lacking and material.friction is None:
            fault = "is derived from patch and friction, but the material has no friction: remove it, or add friction"
            yield path, msgspec.UNSET, fault


def _describe_missing_in_paper(known_law: str) -> str:
    return (
        f'is not supported by rolling.state_machine = "paper", which has {known_law} only: remove it, or use "default"'
    )


def _check_objects(scene: Scene) -> Iterator[Complaint]:
    first: dict[str, str] = {}
    for path, item in _iter_usable("object", scene.object, "name"):
        if item.name.partition(".")[0].isdecimal():
            why = "starts with a digit, but object.1 selects the second object: start the name with a letter"
            yield f"{path}.name", item.name, why
        if item.name in first:
            yield f"{path}.name", item.name, f"is already the name of {first[item.name]}: choose another name"
        first.setdefault(item.name, path)
    if not is_usable(scene.object, scene.rolling) or scene.rolling is None:
        return
    if not is_usable(*(item.material if is_usable(item) else item for item in scene.object)):
        return
    if scene.object and all(item.material.friction is None for item in scene.object):
        fault = (
            "needs friction, but no object has any: add `friction = { static = 0.6, kinetic = 0.5 }` to a material, "
            "or remove [rolling]"
        )
        yield "rolling", msgspec.UNSET, fault


def _check_elastic(scene: Scene) -> Iterator[Complaint]:
    """Check that an elastic object is the only one, and touched by one or two fingers."""
    if not is_usable(scene.object, scene.finger, scene.world):
        return
    for object_path, item in _iter_usable("object", scene.object):
        if not isinstance(item, Mesh) or not is_usable(item.elastic) or item.elastic is None:
            continue
        path = f"{object_path}.elastic"
        if len(scene.object) > 1:
            yield path, msgspec.UNSET, "needs a scene with a single object: remove the other objects, or this table"
        if len(scene.finger) > 2:
            fault = f"supports one or two fingers, but the scene has {len(scene.finger)}: remove some"
            yield path, msgspec.UNSET, fault
        for key, table in (("[world]", scene.world), ("[[effect]]", scene.effect or None)):
            if is_usable(table) and table is not None:
                yield path, msgspec.UNSET, f"cannot be combined with {key}: remove one of them"
        return
