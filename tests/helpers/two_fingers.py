"""Scene for two fingers, and rigs with two devices for it."""

import tomllib
from typing import Any

from softfinger.config.load import build
from softfinger.config.schema import Rig, Scene

NAMES = ("thumb", "index")
SCENE = """
[[finger]]
name = "thumb"
radius_m = 0.01
[[finger]]
name = "index"
radius_m = 0.0095
[[object]]
name = "table"
shape = "plane"
motion = { kind = "driven" }
[object.material]
stiffness_n_per_m = 1000.0
friction = { static = 0.6, kinetic = 0.5 }
[[effect]]
kind = "constant_force"
force_n = [0.0, 0.0, 0.0]
"""
"""Scene file with fingertips of 10 and 9.5 mm on a plane with friction, which can be driven and has a constant force,
for the tests of commands: one scene type, compiled once."""


def two_fingers(**tables: Any) -> Scene:
    """Return the scene of the file, with these tables instead."""
    return build(Scene, tomllib.loads(SCENE) | tables, "two fingers")


def pressed_by_two() -> Scene:
    """Return the same plane without damping, with 1 N along z for each finger: F_z = k d + f."""
    described = tomllib.loads(SCENE)
    described["object"][0]["name"] = "lid.top"
    described["object"][0]["material"]["damping_ns_per_m"] = 0.0
    described["effect"][0]["force_n"] = [0.0, 0.0, 1.0]
    return build(Scene, described | {"probe": {"velocity_time_constant_s": 0.0}}, "pressed by two")


def two_devices(thumb: dict[str, Any], index: dict[str, Any], **tables: Any) -> Rig:
    """Return a rig with [devices.thumb] and [devices.index] on separate ports, without real-time settings."""
    quiet = {"servo": {"realtime": "off"}, "telemetry": {"endpoint": "tcp://127.0.0.1:*"}}
    return build(Rig, {"devices": {"thumb": thumb, "index": index}, **quiet, **tables}, "two devices")
