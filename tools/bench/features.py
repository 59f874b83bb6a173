"""Features of scene files, each as a pair of scenes that differ by that feature only.

The difference in cost is the cost of the feature in this combination: on a bare plane if it needs nothing else, on the
paper's plane if it needs friction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple, get_args

import numpy as np

from softfinger.config import schema
from softfinger.config.load import build
from softfinger.config.sources import FOLDERS
from softfinger.server.offline.cost import BLOCK, make_touching_poses
from softfinger.tools.measure import Array

Table = dict[str, Any]

FRICTION: Final[Table] = {"static": 0.6, "kinetic": 0.5}
TORSION: Final[Table] = {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004}
MATERIAL: Final[Table] = {"stiffness_n_per_m": 1000.0}
GRIP: Final[Table] = MATERIAL | {"friction": FRICTION, "torsion": TORSION}
ROLLING: Final[Table] = {"rolling": {"method": "euler_zxz"}}

SHAPES: Final[dict[str, Table]] = {
    "plane": {"shape": "plane"},
    "sphere": {"shape": "sphere", "radius_m": 0.05},
    "cylinder": {"shape": "cylinder", "radius_m": 0.05},
    "cylinder with ends": {"shape": "cylinder", "radius_m": 0.05, "length_m": 0.2},
    "capsule": {"shape": "capsule", "radius_m": 0.05, "length_m": 0.1},
    "box": {"shape": "box", "size_m": [0.1, 0.12, 0.14]},
    "ellipsoid": {"shape": "ellipsoid", "semi_axes_m": [0.06, 0.05, 0.04]},
    "torus": {"shape": "torus", "major_radius_m": 0.06, "minor_radius_m": 0.02},
    "heightmap": {
        "shape": "heightmap",
        "file": str(FOLDERS[schema.Scene] / "hills.pgm"),
        "pitch_m": 0.0015,
        "level_m": 1e-7,
    },
}
"""Every shape with an inside has room for a fingertip of 10 mm, and so has the hole of the torus."""

NORMALS: Final[dict[str, Table]] = {
    "power law": {"normal": {"exponent": 1.5}},
    "Hunt-Crossley": {"normal": {"damping_s_per_m": 0.5}},
}
LAWS: Final[dict[str, Table]] = {
    "Stribeck": {"stribeck_speed_m_per_s": 0.02},
    "viscous": {"viscous_s_per_m": 0.5},
    "anisotropic": {"direction_x": [1.0, 0.0, 0.0], "kinetic_scale": [1.0, 0.5]},
}
TORSIONS: Final[dict[str, Table]] = {
    "linear": {},
    "power law": {"exponent": 0.25},
    "limit_surface": {"model": "limit_surface"},
    "soft_finger_proxy": {"model": "soft_finger_proxy", "kinetic_friction_length_m": 0.003},
}
PAD: Final[Table] = {"shear_modulus_pa": 45e3}
PATCHES: Final[dict[str, Table]] = {
    "Hertz": PAD,
    "power law": PAD | {"radius_m": 0.004, "exponent": 0.25},
    "Hertz, with a loss in rolling": PAD | {"rolling_loss": 0.3},
}
BAND: Final[Table] = {"stiffness_n_per_m": 400.0, "damping_ns_per_m": 2.0, "force_max_n": 5.0}
WORKSPACE: Final[dict[str, Table]] = {
    "viscosity": {"kind": "viscosity", "damping_ns_per_m": 2.0},
    "constant_force": {"kind": "constant_force", "force_n": [0.0, 0.0, -1.0]},
    "spring": {"kind": "spring", "position_m": [0.0, 0.0, 0.05], "stiffness_n_per_m": 200.0, "force_max_n": 3.0},
    "vibration": {"kind": "vibration", "amplitude_n": 0.5, "frequency_hz": 100.0, "direction": [0.0, 0.0, 1.0]},
    # So small that the fingertip is outside while it is timed.
    "boundary, a box": {"kind": "boundary", "size_m": [0.01, 0.01, 0.01]} | BAND,
    "boundary, a ball": {"kind": "boundary", "radius_m": 0.005} | BAND,
}
REGIONS: Final[dict[str, Table]] = {"box": {"size_m": [0.1, 0.1, 0.1]}, "ball": {"radius_m": 0.05}}
OF_OBJECTS: Final[dict[str, Table]] = {
    "viscosity": {"kind": "viscosity", "damping_ns_per_m": 2.0},
    "constant_force": {"kind": "constant_force", "force_n": [0.0, 0.0, -1.0]},
    "vibration": {"kind": "vibration", "amplitude_n": 0.5, "frequency_hz": 100.0, "direction": [0.0, 0.0, 1.0]},
    "vibration along the normal": {"kind": "vibration", "amplitude_n": 0.5, "frequency_hz": 100.0},
    "magnet": {"kind": "magnet", "force_n": 1.5, "range_m": 0.02, "exponent": 2.0},
    "stick_slip": {"kind": "stick_slip", "stiffness_n_per_m": 200.0, "force_max_n": 0.5},
}
MOTIONS: Final[dict[str, Table]] = {
    "sinusoid": {"kind": "sinusoid", "translation_m": [1e-4, 0.0, 0.0], "rotation_rad": 1e-3, "frequency_hz": 1.0},
    "turntable": {"kind": "turntable", "rate_rad_per_s": 0.5},
    "driven": {"kind": "driven"},
}
RIBS: Final = FOLDERS[schema.Scene] / "ribs.csv"
TEXTURES: Final[dict[str, Table]] = {"heights": {"height_m": 1e-4}, "friction": {"friction_scale": [0.5, 1.5]}}
ROUND_M: Final = 2.0 * math.pi * 0.05 / 64.0
"""Width of the texture, for 64 ribs around the cylinder."""
WALLS: Final[list[Table]] = [
    {"name": "left wall", "shape": "plane", "orientation_wxyz": [1.0, 0.0, 1.0, 0.0]},
    {"name": "back wall", "shape": "plane", "orientation_wxyz": [1.0, -1.0, 0.0, 0.0]},
]
"""Planes at right angles to the floor and to each other, with normals along x and y."""


class Feature(NamedTuple):
    """Feature: scenes without and with it, the description of their common part, and poses for each scene if needed."""

    name: str
    base: str
    without: schema.Scene
    having: schema.Scene
    poses: Callable[[], tuple[Array, Array]] | None = None


def make_corner_poses() -> Array:
    """Return poses (BLOCK, 7) that press about 1 mm into three walls at right angles and turn; the radius is 10 mm."""
    poses = np.zeros((BLOCK, 7))
    t = 2.0 * np.pi * np.arange(BLOCK) / BLOCK
    poses[:, :3] = 0.009 + 0.0005 * np.stack([np.sin(3.0 * t), np.sin(2.0 * t), np.sin(5.0 * t)], axis=1)
    poses[:, 3], poses[:, 4], poses[:, 6] = 1.0, 0.02 * np.sin(5.0 * t), 0.05 * np.sin(t)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
    return poses


def _carry_poses(first: schema.Scene, second: schema.Scene) -> tuple[Array, Array]:
    """Return poses (n, 7) that touch the object of `first`, and the same poses relative to that object in `second`."""
    poses = make_touching_poses(first)
    w, *v = second.object[0].orientation_wxyz
    position, scalar, vector = poses[:, :3], poses[:, 3:4], poses[:, 4:]
    across = np.cross(v, position)
    position = position + 2.0 * (w * across + np.cross(v, across)) + second.object[0].position_m
    orientation = w * scalar - vector @ np.array([v]).T, w * vector + scalar * v + np.cross(v, vector)
    return poses, np.hstack([position, *orientation])


def iter_features() -> Iterator[Feature]:
    """Yield every feature, in the order of the tables of a scene file."""
    bare, full = _make_scene(), _make_scene(material=GRIP, **ROLLING)
    on_bare, on_full = ("bare plane", bare), ("plane with friction, torsion, rolling", full)

    yield from _iter_table("normal force {}", NORMALS, *on_bare, lambda keys: {"material": MATERIAL | keys})
    yield from _iter_rolling()

    spun = _make_scene(material=MATERIAL | {"torsion": TORSION})
    yield Feature("friction static and kinetic", "plane with torsion", spun, _make_scene(material=GRIP))
    yield from _iter_table(
        "friction {}", LAWS, *on_full, lambda keys: {"material": GRIP | {"friction": FRICTION | keys}}
    )
    paper = _make_scene(material=GRIP, rolling={"method": "euler_zxz", "state_machine": "paper"})
    yield Feature("state machine paper, for default", *on_full, paper)

    flat = "plane with friction, rolling", _make_scene(material=MATERIAL | {"friction": FRICTION}, **ROLLING)
    yield from _iter_table("torsion {}", TORSIONS, *flat, lambda keys: {"material": GRIP | {"torsion": TORSION | keys}})
    yield from _iter_table("patch {}", PATCHES, *on_full, lambda keys: {"fingertip": {"radius_m": 0.01, "patch": keys}})
    yield from _iter_forms()
    yield from _iter_shapes()
    yield from _iter_several()
    yield from _iter_table("motion {}", MOTIONS, *on_full, lambda keys: {"object_motion": keys})
    yield from _iter_textures()

    yield from _iter_table("effect {}, workspace", WORKSPACE, *on_bare, lambda keys: {"effect": [keys]})
    oil = WORKSPACE["viscosity"]
    oiled = "bare plane with viscosity", _make_scene(effect=[oil])
    yield from _iter_table(
        "region {}", REGIONS, *oiled, lambda keys: {"effect": [oil | {"region": keys | {"edge_m": 0.005}}]}
    )
    yield from _iter_table("effect {}, object", OF_OBJECTS, *on_bare, lambda keys: {"object_effect": [keys]})


def _iter_table(
    name: str, table: Mapping[str, Table], base: str, without: schema.Scene, changes: Callable[[Table], Table]
) -> Iterator[Feature]:
    """Yield a feature for each entry of a table; a scene with friction also has torsion and rolling."""
    rest = {"material": GRIP, **ROLLING} if "friction" in base else {}
    for entry, keys in table.items():
        yield Feature(name.format(entry), base, without, _make_scene(**rest | changes(keys)))


def _make_scene(
    shape: str = "plane", material: Mapping[str, Any] = MATERIAL, others: list[Table] | None = None, **changes: Any
) -> schema.Scene:
    """Return a scene with an object of that shape.

    `changes` are keys of the scene or, with the prefix `object_`, of the object.
    """
    object_keys = {key.removeprefix("object_"): value for key, value in changes.items() if key.startswith("object_")}
    tables = {key: value for key, value in changes.items() if not key.startswith("object_")}
    tables_of_shapes = [{"name": shape, **SHAPES[shape], **object_keys}, *(others or [])]
    objects = [{"material": dict(material), **shape_table} for shape_table in tables_of_shapes]
    return build(schema.Scene, {"fingertip": {"radius_m": 0.01}, "object": objects, **tables}, f"bench, {shape}")


def _iter_rolling() -> Iterator[Feature]:
    for shape, methods in {
        "plane": get_args(schema.RollingMethod),
        "sphere": ("rotation_vector",),
        "box": ("rotation_vector",),
        "ellipsoid": tuple(m for m in get_args(schema.RollingMethod) if m != "rotation_vector"),
    }.items():
        for method in methods:
            without, having = _make_scene(shape, GRIP), _make_scene(shape, GRIP, rolling={"method": method})
            yield Feature(f"rolling {method}, {shape}", f"{shape} with friction and torsion", without, having)


def _iter_forms() -> Iterator[Feature]:
    tip = {"radii_m": [0.01, 0.009, 0.012], "orientation_wxyz": [0.8, 0.36, 0.48, 0.0]}
    for shape in ("plane", "sphere", "cylinder"):
        having = _make_scene(shape, fingertip=tip)
        yield Feature(f"fingertip an ellipsoid, on a {shape}", f"bare {shape}", _make_scene(shape), having)
    rolled: Table = {"rolling": {"method": "midpoint"}}
    without, having = _make_scene(material=GRIP, **rolled), _make_scene(material=GRIP, fingertip=tip, **rolled)
    yield Feature("fingertip an ellipsoid, rolling", "plane with friction, torsion, midpoint", without, having)


def _iter_shapes() -> Iterator[Feature]:
    plane = _make_scene()
    for name in SHAPES:
        if name != "plane":
            yield Feature(f"shape {name}, for plane", "bare plane", plane, _make_scene(name))
    for name in SHAPES:
        if name not in ("plane", "heightmap"):
            yield Feature(
                f"inside {name}, for outside", f"bare {name}", _make_scene(name), _make_scene(name, object_inside=True)
            )
    bare, place, turn = _make_scene("ellipsoid"), [0.01, 0.02, 0.03], [0.8, 0.36, 0.48, 0.0]
    moved, turned = (
        _make_scene("ellipsoid", object_position_m=place),
        _make_scene("ellipsoid", object_orientation_wxyz=turn),
    )
    yield Feature("object moved", "bare ellipsoid", bare, moved, lambda: _carry_poses(bare, moved))
    yield Feature("object turned", "bare ellipsoid", bare, turned, lambda: _carry_poses(bare, turned))


def _iter_several() -> Iterator[Feature]:
    far_plane = {"name": "far below", "shape": "plane", "position_m": [0.0, 0.0, -1.0]}
    yield Feature("second object, apart", "bare plane", _make_scene(), _make_scene(others=[far_plane]))
    yield Feature(
        "second object, apart from a sphere",
        "bare sphere",
        _make_scene("sphere"),
        _make_scene("sphere", others=[far_plane]),
    )
    two, three = _make_scene(others=WALLS[:1]), _make_scene(others=WALLS)
    yield Feature(
        "second object, touched too",
        "bare plane",
        _make_scene(),
        two,
        lambda: (make_corner_poses(), make_corner_poses()),
    )
    yield Feature(
        "third object, touched too", "two bare planes", two, three, lambda: (make_corner_poses(), make_corner_poses())
    )


def _iter_textures() -> Iterator[Feature]:
    for shape in ("plane", "cylinder", "box"):
        for name, keys in TEXTURES.items():
            texture = {"file": str(RIBS), "size_m": [ROUND_M, 0.004], **keys}
            base = f"{shape} with friction and torsion"
            yield Feature(
                f"texture {name}, {shape}",
                base,
                _make_scene(shape, GRIP),
                _make_scene(shape, GRIP, object_texture=texture),
            )
