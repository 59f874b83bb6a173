"""Objects: their common keys, and the dimensions of each shape."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal, TypeVar, get_args

import msgspec
from msgspec import Struct

from softfinger.config import limits
from softfinger.config.fields import (
    Complaint,
    Lengths,
    Orientation,
    Point,
    Table,
    check_orientation,
    doc,
    is_usable,
    make_tag_attribute,
    normalise_orientation,
    sized,
    within,
)
from softfinger.config.schema.effects import ObjectEffect
from softfinger.config.schema.materials import Material
from softfinger.config.schema.object_parts import Elastic, Motion, Texture

WRAP_TOLERANCE = 1e-3
"""Tolerated mismatch of a texture around a cylinder, as a fraction of its width; sizes are written with few digits."""

Shading = Literal["none", "normals"]
ModelRoot = (
    Annotated[
        str,
        sized(
            limits.FILE_NAME_LENGTH,
            "folder that contains all files of a MuJoCo model; default: the folder of the model",
            "..",
        ),
    ]
    | None
)
Inside = Annotated[bool, doc("true: a cavity, touched from inside", False)]


class ObjectBase(Table, frozen=True, kw_only=True):
    """Common keys of all objects. A shape adds its dimensions and its tag."""

    shape: ClassVar[str] = make_tag_attribute()
    unrolls: ClassVar[bool] = False
    """True if the rolling method `rotation_vector` has a closed form on this shape."""
    added: ClassVar[list[type[Struct]]] = []
    """Tables of shapes from other packages, in the order of the calls of `add_shape`."""

    name: Annotated[str, sized(limits.NAME_LENGTH, "name, unique in the scene", "table")]
    position_m: Annotated[Point, doc("origin of the object frame in the world", [0.0, 0.0, 0.0])] = (0.0, 0.0, 0.0)
    orientation_wxyz: Annotated[
        Orientation, doc("object to world: quaternion w, x, y, z, normalised on load", [1.0, 0.0, 0.0, 0.0])
    ] = (1.0, 0.0, 0.0, 0.0)
    material: Material
    effect: Annotated[tuple[ObjectEffect, ...], sized(limits.EFFECTS, "further forces on the hand")] = ()
    motion: Annotated[Motion | None, doc("motion of the object; without this table it is fixed")] = None

    def __post_init__(self) -> None:
        normalise_orientation(self)

    def faults(self) -> Iterator[Complaint]:
        yield from check_orientation(self.orientation_wxyz)
        if is_usable(self.name) and not (self.name.isprintable() and self.name.strip()):
            yield "name", self.name, "must have printable characters only, and not only blanks"

    @property
    def bears_ellipsoid(self) -> bool:
        """True if an ellipsoidal fingertip can touch the object."""
        return False

    def check_room(self, fingertip_m: float) -> Iterator[Complaint]:
        """Yield the dimensions that leave no room for a fingertip of this radius, m, on the touched side."""
        yield from ()


class Textured(ObjectBase, frozen=True, kw_only=True):
    """Shape with coordinates on its surface, for a texture."""

    texture: Annotated[Texture | None, doc("surface texture; without this table the surface is even")] = None

    def faults(self) -> Iterator[Complaint]:
        yield from super().faults()
        if not is_usable(self.texture, self.material) or self.texture is None or not is_usable(self.material.friction):
            return
        if self.texture.friction_scale is not None and self.material.friction is None:
            fault = "scales the friction of the material, which has none: add material.friction"
            yield "texture.friction_scale", self.texture.friction_scale, fault


class Plane(Textured, frozen=True, kw_only=True, tag_field="shape", tag="plane"):
    """Half-space below the plane z = 0 of the object frame."""

    unrolls: ClassVar[bool] = True

    @property
    def bears_ellipsoid(self) -> bool:
        return True


class Sphere(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="sphere"):
    """Sphere about the origin."""

    unrolls: ClassVar[bool] = True
    radius_m: Annotated[float, within(limits.LENGTH_M, "radius", 0.05)]
    inside: Inside = False

    @property
    def bears_ellipsoid(self) -> bool:
        return not self.inside

    def check_room(self, fingertip_m: float) -> Iterator[Complaint]:
        if is_usable(self.radius_m, self.inside) and self.inside and self.radius_m <= fingertip_m:
            yield "radius_m", self.radius_m, _describe_lack_of_room(fingertip_m)


class Cylinder(Textured, frozen=True, kw_only=True, tag_field="shape", tag="cylinder"):
    """Cylinder about the z axis, centred on the origin, with flat ends or infinite."""

    unrolls: ClassVar[bool] = True
    radius_m: Annotated[float, within(limits.LENGTH_M, "radius", 0.05)]
    length_m: Annotated[float, within(limits.LENGTH_M, "length; default: infinite", 0.2)] | None = None
    inside: Inside = False

    @property
    def bears_ellipsoid(self) -> bool:
        return self.length_m is None and not self.inside

    def faults(self) -> Iterator[Complaint]:
        yield from super().faults()
        if not is_usable(self.radius_m, self.texture) or self.texture is None or not is_usable(self.texture.size_m):
            return
        around, wide = 2.0 * math.pi * self.radius_m, self.texture.size_m[0]
        if abs(around / wide - max(round(around / wide), 1)) > WRAP_TOLERANCE:
            nearest = around / max(round(around / wide), 1)
            fault = (
                f"fits {around / wide:g} times round the cylinder; must be an integer, so that the ends meet: set the "
                f"width to {nearest:.6g} m"
            )
            yield "texture.size_m", self.texture.size_m, fault

    def check_room(self, fingertip_m: float) -> Iterator[Complaint]:
        if not is_usable(self.inside) or not self.inside:
            return
        if is_usable(self.radius_m) and self.radius_m <= fingertip_m:
            yield "radius_m", self.radius_m, _describe_lack_of_room(fingertip_m)
        if is_usable(self.length_m) and self.length_m is not None and self.length_m <= 2.0 * fingertip_m:
            yield "length_m", self.length_m, _describe_lack_of_room(2.0 * fingertip_m, "diameter")


class Capsule(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="capsule"):
    """Capsule about the z axis, centred on the origin."""

    unrolls: ClassVar[bool] = True
    radius_m: Annotated[float, within(limits.LENGTH_M, "radius", 0.02)]
    length_m: Annotated[float, within(limits.LENGTH_M, "distance between the centres of the caps", 0.1)]
    inside: Inside = False

    def check_room(self, fingertip_m: float) -> Iterator[Complaint]:
        if is_usable(self.radius_m, self.inside) and self.inside and self.radius_m <= fingertip_m:
            yield "radius_m", self.radius_m, _describe_lack_of_room(fingertip_m)


class Box(Textured, frozen=True, kw_only=True, tag_field="shape", tag="box"):
    """Box along the axes, centred on the origin."""

    unrolls: ClassVar[bool] = True
    size_m: Annotated[Lengths, doc("edge lengths along x, y, z", [0.1, 0.1, 0.04])]
    inside: Inside = False

    @property
    def bears_ellipsoid(self) -> bool:
        return self.inside

    def check_room(self, fingertip_m: float) -> Iterator[Complaint]:
        if is_usable(self.size_m, self.inside) and self.inside and min(self.size_m) <= 2.0 * fingertip_m:
            yield "size_m", self.size_m, _describe_lack_of_room(2.0 * fingertip_m, "diameter", "every edge")


class Ellipsoid(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="ellipsoid"):
    """Ellipsoid along the axes, centred on the origin."""

    semi_axes_m: Annotated[Lengths, doc("semi-axes along x, y, z", [0.06, 0.04, 0.03])]
    inside: Inside = False

    def check_room(self, fingertip_m: float) -> Iterator[Complaint]:
        if not is_usable(self.semi_axes_m, self.inside) or not self.inside:
            return
        sharpest = min(self.semi_axes_m) ** 2 / max(self.semi_axes_m)
        if sharpest <= fingertip_m:
            limit = f"the smallest radius of curvature, shortest^2 / longest = {sharpest:g} m,"
            yield "semi_axes_m", self.semi_axes_m, _describe_lack_of_room(fingertip_m, "radius", limit)


class Torus(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="torus"):
    """Torus about the z axis, centred on the origin."""

    major_radius_m: Annotated[float, within(limits.LENGTH_M, "radius of the centre circle of the tube", 0.06)]
    minor_radius_m: Annotated[float, within(limits.LENGTH_M, "radius of the tube; below major_radius_m", 0.02)]
    inside: Inside = False

    def faults(self) -> Iterator[Complaint]:
        yield from super().faults()
        major, minor = self.major_radius_m, self.minor_radius_m
        if is_usable(major, minor) and minor >= major:
            yield "minor_radius_m", minor, f"must be below major_radius_m = {major:g} m, or the ring has no hole"

    def check_room(self, fingertip_m: float) -> Iterator[Complaint]:
        major, minor = self.major_radius_m, self.minor_radius_m
        if not is_usable(major, minor, self.inside):
            return
        if self.inside and minor <= fingertip_m:
            yield "minor_radius_m", minor, _describe_lack_of_room(fingertip_m)
        # A fingertip stuck in the hole would touch a whole circle of points at once.
        if not self.inside and minor < major <= minor + fingertip_m:
            hole = f"major_radius_m - minor_radius_m = {major - minor:g} m, the radius of the hole,"
            yield "major_radius_m", major, _describe_lack_of_room(fingertip_m, "radius", hole)


class Heightmap(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="heightmap"):
    """Solid below a height field over the x and y axes, read from a file; level beyond the rim."""

    file: Annotated[
        str,
        sized(
            limits.FILE_NAME_LENGTH,
            "grey picture (.png of 8 or 16 bits, .pgm; white is high) or array (.npy, .npz, .csv); columns along x, "
            "rows along y; or a MuJoCo model",
            "hills.npy",
        ),
    ]
    hfield: (
        Annotated[str, sized(limits.NAME_LENGTH, "height field of a MuJoCo model; elevations are 0 to 1", "hills")]
        | None
    ) = None
    root: ModelRoot = None
    pitch_m: Annotated[float, within(limits.HEIGHT_PITCH_M, "distance between neighbouring pixels", 0.001)]
    level_m: Annotated[
        float, within(limits.HEIGHT_LEVEL_M, "height of one unit of the file; 1 for an array in metres", 1.0)
    ]


class Mesh(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="mesh"):
    """Triangle mesh from a file, in the object frame. A mesh with holes is a sheet that is touched from both sides."""

    unrolls: ClassVar[bool] = True  # triangle by triangle, each in its plane
    endings: ClassVar[tuple[str, ...]] = (".ply", ".stl", ".obj", ".glb")
    volumes: ClassVar[tuple[str, ...]] = (".msh", ".vtu")
    """Files of tetrahedra, for elastic bodies."""
    file: Annotated[str, sized(limits.FILE_NAME_LENGTH, ".ply, .stl, .obj or .glb; or a MuJoCo model", "part.ply")]
    mesh: (
        Annotated[str, sized(limits.NAME_LENGTH, "mesh of a MuJoCo model, in its frame of inertia, m", "handle")] | None
    ) = None
    root: ModelRoot = None
    scale: Annotated[float, within(limits.MESH_SCALE, "metres per unit of the file; 0.001 for mm", 0.001)] = 1.0
    inside: Inside = False
    shading: Annotated[Shading, doc("normals: force direction interpolated between vertex normals", "none")] = "none"
    elastic: Annotated[Elastic | None, doc("linear elastic body; without this table the object is rigid")] = None

    def faults(self) -> Iterator[Complaint]:
        yield from super().faults()
        if not is_usable(self.file, self.mesh, self.elastic):
            return
        endings = self.endings if self.elastic is None else (*self.endings, *self.volumes)
        if self.mesh is None and not self.file.lower().endswith(endings):
            yield "file", self.file, f"must end in {', '.join(endings)}: export the mesh as one of these"
        if self.elastic is None:
            return
        # keys that a deformable surface cannot support
        for key, table in (("motion", self.motion), ("effect", self.effect or None)):
            if is_usable(table) and table is not None:
                yield key, msgspec.UNSET, "cannot be combined with [object.elastic]: remove one of them"
        if is_usable(self.inside) and self.inside:
            yield "inside", True, "is not supported by an elastic body: remove it"
        if self.mesh is not None:
            yield "mesh", self.mesh, "cannot be elastic as part of a MuJoCo model: export it to a file"


def _describe_lack_of_room(least_m: float, measure: str = "radius", part: str = "") -> str:
    """Return the fault of a shape without room for the fingertip; `least_m` is its radius or diameter."""
    room = f"must be above {least_m:g} m, the {measure} of the fingertip, so that it fits in"
    return f"{part} {room}".strip() + ": increase it, or use a smaller fingertip"


Object = Plane | Sphere | Cylinder | Capsule | Box | Ellipsoid | Torus | Heightmap | Mesh
"""Any object; the key `shape` selects the table."""

Added = TypeVar("Added", bound=type[ObjectBase])


def add_shape(table: Added) -> Added:
    """Register a shape of another package for scene files: a decorator for its table, a subclass of ObjectBase.

    Call it before the scene is read. Raises TypeError for a table without a tag, or with a tag that is in use.
    """
    tag = table.__struct_config__.tag
    if table.__struct_config__.tag_field != "shape" or not isinstance(tag, str) or getattr(table, "shape", None) != tag:
        raise TypeError(f'{table.__name__}: a shape has tag_field="shape", and a tag that is its class\'s `shape` too')
    if any(tag == kind.shape for kind in (*get_args(Object), *ObjectBase.added)):
        raise TypeError(f"{table.__name__}: there is a shape {tag!r} already: take another tag")
    ObjectBase.added.append(table)
    return table
