"""Scene and its parts: objects with materials, fingers, bodies. The contact step is compiled for a type of Scene."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.model.motions import Motion, Pose
from softfinger.proxy.kernels.model.shapes import AnyShape
from softfinger.proxy.kernels.model.vectors import Quaternion, Vec3


class Material(NamedTuple):
    """Law of the normal force, friction law or None, torsion law or None.

    compliance  m^2/N  1/G, G its shear modulus; None in a scene without contact patches
    """

    normal: Any
    friction: Any
    torsion: Any
    compliance: Any = None


class Object(NamedTuple):
    """Element of a scene: one shape with pose, material and effects.

    shape        in the frame of `pose`
    pose         None (shape in the world), Place or Pose; Pose if it moves
    motion       None, or the law of its motion
    material     Material, with the same types of laws for all objects of a scene
    scene_index  index of its entry in the scene file; several shapes may form one object
    last_pose    Pose at the last tick of an object that can move; None otherwise, and in a Scene (set in each tick)
    texture      Texture or None; its coordinates are in the frame of `pose`
    """

    shape: Any
    pose: Any
    motion: Any
    material: Material
    scene_index: float
    last_pose: Any = None
    texture: Any = None


class Carrier(NamedTuple):
    """Effects of an object, and its row, 0 of a single one."""

    row: float
    effects: Any


class Entry(NamedTuple):
    """Shape, place and normal law of one of many objects.

    shape        AnyShape in the frame of `pose`
    pose         Pose at rest
    motion       Motion
    normal       law of the normal force, of the same type for all objects of a scene
    scene_index  index of the object in the scene file
    """

    shape: AnyShape
    pose: Pose
    motion: Motion
    normal: Any
    scene_index: float


class SmoothSearch(NamedTuple):
    """Type of the search in a scene without meshes and height maps."""

    meshes: float


class FacetedSearch(NamedTuple):
    """Type of the search in a scene with meshes, but without height maps."""

    meshes: float


class CreasedSearch(NamedTuple):
    """Type of the search in a scene with height maps.

    meshes   number of meshes, may be 0
    is_near  0 in a tick in which no height map is within reach; it then must not change the result
    """

    meshes: float
    is_near: float = 1.0


class Single(NamedTuple):
    """The only object of a scene, of a shape that is known when the scene is compiled.

    effects  tuple of Carrier, one or none
    search   SmoothSearch, FacetedSearch or CreasedSearch
    """

    body: Object
    effects: Any = ()
    search: Any = SmoothSearch(0.0)


class FingertipForm(NamedTuple):
    """Form of an ellipsoidal fingertip in a tick.

    semi_axes    (3,)  m
    orientation  (4,)     of the axes, to the world
    radius             m  of the finger
    """

    semi_axes: Vec3
    orientation: Quaternion
    radius: float


class Many(NamedTuple):
    """Objects of any number and kinds, as arrays.

    An object's index is its row, plus MAX_ENTRIES times the index of the triangle if it is a mesh (`query.container`).

    entries        Rows of Entry
    size           number of entries
    movable_rows   int64 rows of entries that can move
    movable_count  number of these rows
    search         SmoothSearch, FacetedSearch or CreasedSearch
    materials      Rows of Material without the normal law, None among bare objects
    textures       Rows of Texture, with 0 columns for an object without one; None in a scene without textures
    effects        tuple of Carrier
    poses          in a tick the World's memory of objects that can move, in a scene None
    tip            in a tick the FingertipForm of an ellipsoidal fingertip, else None
    """

    entries: Any
    size: float
    movable_rows: ReadOnly
    movable_count: float
    search: Any
    materials: Any
    textures: Any
    effects: Any
    poses: Any = None
    tip: Any = None


class Coupling(NamedTuple):
    """Tangential spring (N/m) and damper (N s/m) between computed and measured position; torsion damper (N m s/rad)."""

    stiffness: float
    damping: float
    torsional_damping: float = 0.0


class EllipsoidTip(NamedTuple):
    """Shape of an ellipsoidal fingertip, centred at the probe.

    semi_axes    (3,)  m
    orientation  (4,)     of its axes in the fingertip's frame
    """

    semi_axes: Vec3
    orientation: Quaternion


class Finger(NamedTuple):
    """Fingertip and its probe.

    radius                  m    r; of an ellipsoid the shortest semi-axis
    coupling                     Coupling
    torque_stiffness        N/m  k_tau: force per length of roll that the hand has not followed
    velocity_time_constant  s    of the probe's velocity filter, 0 for the unfiltered difference
    position_resolution     m    encoder step of the probe
    patch                        HertzPatch, PowerPatch or None
    form                         EllipsoidTip, or None for a ball
    """

    radius: float
    coupling: Coupling
    torque_stiffness: float
    velocity_time_constant: float
    position_resolution: float
    patch: Any = None
    form: Any = None


class Bodies(NamedTuple):
    """Simulation of rigid bodies, and the objects attached to them.

    block     ReadOnly  addresses of the simulation (query.bodies)
    movable   ReadOnly  numbers of the bodies that can move
    attached  ReadOnly  for each object of the scene file the number of its body, 0 if it is not attached to one
    objects             number of objects in the scene file
    """

    block: Any
    movable: Any
    attached: Any
    objects: float


class Scene(NamedTuple):
    """Scene, the type for which the contact step is compiled.

    fingers   tuple of Finger, one or more
    objects   Single or Many
    rolling   rolling method or None
    effects   tuple of effects of the workspace
    bodies    Bodies, or None without a simulation
    elastic   Elastic of the only object, or None
    """

    fingers: Any
    objects: Any
    rolling: Any
    effects: Any
    bodies: Any = None
    elastic: Any = None
