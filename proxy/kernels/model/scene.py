"""What a scene is made of: objects with their material, and all that the contact step is compiled for."""

from typing import Any, NamedTuple


class Material(NamedTuple):
    """Normal stiffness N/m and damping N s/m, a friction law or None, a torsion law or None."""

    stiffness: float
    damping: float
    friction: Any
    torsion: Any


class Object(NamedTuple):
    """One shape to touch.

    shape     in the frame of `pose`
    pose      None (in the world), Place or Pose; Pose if it moves
    motion    None, or how it moves
    material  Material, of the same parts for all objects of a scene
    number    of the object in the scene file; several shapes may make one object
    effects   tuple of effects
    """

    shape: Any
    pose: Any
    motion: Any
    material: Material
    number: float
    effects: Any


class Coupling(NamedTuple):
    """Tangential spring (N/m) and damper (N s/m) between computed and measured position."""

    stiffness: float
    damping: float


class Scene(NamedTuple):
    """Everything the contact step is compiled for.

    radius                  m    fingertip
    objects                      tuple of Object
    rolling                      a rolling method or None
    coupling                     Coupling
    velocity_time_constant  s    low-pass of the probe velocity, 0 for the plain difference
    position_resolution     m    encoder step of the probe
    effects                      tuple of effects of the workspace
    """

    radius: float
    objects: Any
    rolling: Any
    coupling: Coupling
    velocity_time_constant: float
    position_resolution: float
    effects: Any
