"""Scene and its parts: objects with materials, fingers, bodies. The contact step is compiled for a type of Scene."""

from typing import Any, NamedTuple

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

    shape     in the frame of `pose`
    pose      None (shape in the world), Place or Pose; Pose if it moves
    motion    None, or the law of its motion
    material  Material, with the same types of laws for all objects of a scene
    number    index of its entry in the scene file; several shapes may form one object
    effects   tuple of effects
    was       Pose at the last tick of an object that can move; None otherwise, and in a Scene (set in each tick)
    texture   Texture or None; its coordinates are in the frame of `pose`
    """

    shape: Any
    pose: Any
    motion: Any
    material: Material
    number: float
    effects: Any
    was: Any = None
    texture: Any = None


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

    block   ReadOnly  addresses of the simulation (query.bodies)
    moving  ReadOnly  numbers of the bodies that can move
    riders            number of the attached body for each object of the scene file, 0 if it is not attached to one
    """

    block: Any
    moving: Any
    riders: tuple[float, ...]


class Scene(NamedTuple):
    """Scene, the type for which the contact step is compiled.

    fingers   tuple of Finger, one or more
    objects   tuple of Object
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
