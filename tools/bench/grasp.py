"""`bench grasp`: two fingertips lift a box and hold it, by this program's contact and by MuJoCo's own.

The same box of 40 mm and 100 g is taken 8 mm beside its centre of mass with 3 N, lifted by 100 mm and held. Here the
fingers are soft fingertips; there they are spheres of the same radius, each welded to a mocap body, the usual way to
lead a hand in MuJoCo. Their contact has torsional friction (condim 4), or rolling friction too (condim 6),
with the elliptic cone and the impratio that MuJoCo's documentation advises for grasps. The squeeze that gives the grip
is searched for.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.config.mjcf import mujoco_module
from softfinger.proxy.engine import Engine
from softfinger.server.offline.figures import figure, save
from softfinger.server.progress import progress
from softfinger.tools.measure import Array, add_output_options, show

GRIP_N: Final = 3.0
BESIDE_M: Final = 0.008
RADIUS_M: Final = 0.01
HALF_M: Final = 0.02
MASS_KG: Final = 0.1
GRAVITY: Final = 9.81
FRICTION: Final = 0.8
STIFFNESS: Final = 1000.0
TORSION: Final = 0.05
SETTLE_S: Final = 0.2
"""The box is taken without weight for so long, and then has it."""
WEIGHT_S: Final = 0.3
"""The weight comes at once; so long after it the lift begins, and the forces are looked at."""
LIFT_S: Final = 1.0
LIFT_M: Final = 0.1
LOADED_S: Final = 1.8
"""After it was lifted the swing has died away; what moves then is creep."""
DT: Final = 1e-3

BOX: Final = f"""
<body name="box"><freejoint/>
  <geom name="box" type="box" size="{HALF_M} {HALF_M} {HALF_M}" mass="{MASS_KG}" {{contact}}/>
</body>"""
OURS: Final = f"""
<mujoco><option timestep="{DT}" integrator="implicitfast" gravity="0 0 0"/><worldbody>{BOX}</worldbody></mujoco>"""
THEIRS: Final = f"""
<mujoco>
  <option timestep="{DT}" integrator="implicitfast" gravity="0 0 0" cone="elliptic" impratio="10" {{option}}/>
  <worldbody>{BOX}
    {{fingers}}
  </worldbody>
  <equality>
    <weld body1="thumb-mocap" body2="thumb"/><weld body1="index-mocap" body2="index"/>
  </equality>
</mujoco>"""
FINGER: Final = f"""
    <body name="{{name}}-mocap" mocap="true" pos="{{x}} {BESIDE_M} 0"/>
    <body name="{{name}}" pos="{{x}} {BESIDE_M} 0" gravcomp="1"><freejoint/>
      <geom name="{{name}}" type="sphere" size="{RADIUS_M}" mass="0.05" {{contact}}/>
    </body>"""
FRICTIONS: Final = f'friction="{FRICTION} 0.004 0.0001"'
CONTACTS: Final = {
    "MuJoCo, condim 4": (f'condim="4" {FRICTIONS}', ""),
    "MuJoCo, condim 6": (f'condim="6" {FRICTIONS}', ""),
    "MuJoCo, condim 6, noslip": (f'condim="6" {FRICTIONS}', 'noslip_iterations="10"'),
}


class Held(NamedTuple):
    """A grasp over time: height of the box's taken point above the fingers (n,) m, its turn (n,) rad, the thumb's force
    (n, 3)."""

    height: Array
    turn: Array
    force: Array


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, default=10.0, help="how long the box hangs (default: %(default)s)")
    add_output_options(parser)


def run(args: argparse.Namespace) -> int:
    if not 1.0 <= args.seconds <= 1000.0:
        raise ConfigError(f"--seconds {args.seconds:g}: give 1 to 1000")
    held: dict[str, Held] = {}
    with progress("holding", 1 + len(CONTACTS)) as done:
        held["softfinger"] = ours(args.seconds)
        done(1)
        for name, (contact, option) in CONTACTS.items():
            held[name] = theirs(contact, option, args.seconds)
            done(len(held))
    rows = [{"contact": name} | figures_of(each) for name, each in held.items()]
    expected = float(np.degrees(MASS_KG * GRAVITY * BESIDE_M / (2.0 * TORSION)))
    lines = [
        f"{1e3 * MASS_KG:g} g taken {1e3 * BESIDE_M:g} mm off centre with {GRIP_N:g} N, lifted, "
        f"held {args.seconds:g} s; "
        f"m g d / (2 k_z) = {expected:.2f} degrees",
        f"  {'contact':<26}{'ripple, mN':>12}{'creep, um/s':>13}{'turn, deg':>11}{'creep of it, deg/s':>20}",
    ]
    lines += [
        f"  {row['contact']:<26}{row['ripple_mn']:>12.3g}{row['creep_um_per_s']:>13.3g}{row['turn_deg']:>11.2f}"
        f"{row['turn_creep_deg_per_s']:>20.3g}"
        for row in rows
    ]
    show({"seconds": args.seconds, "expected_turn_deg": expected, "contacts": rows}, args.json, lines)
    if args.plot:
        draw(held, args.plot)
    return 0


def figures_of(held: Held) -> dict[str, float]:
    """Largest change of the force in a tick after WEIGHT_S, creep down and round after LOADED_S, turn at the end."""
    first = round(LOADED_S / DT)
    seconds = DT * (len(held.height) - 1 - first)
    return {
        "ripple_mn": 1e3 * float(np.linalg.norm(np.diff(held.force[round(WEIGHT_S / DT) :], axis=0), axis=1).max()),
        "creep_um_per_s": 1e6 * float(held.height[first] - held.height[-1]) / seconds,
        "turn_deg": float(np.degrees(held.turn[-1])),
        "turn_creep_deg_per_s": float(np.degrees(held.turn[-1] - held.turn[first])) / seconds,
    }


def ours(seconds: float) -> Held:
    """Held by two soft fingertips."""
    material = {
        "stiffness_n_per_m": STIFFNESS,
        "damping_ns_per_m": 2.0,
        "friction": {"static": FRICTION, "kinetic": 0.7},
        "torsion": {"stiffness_nm_per_rad": TORSION, "friction_length_m": 0.004},
    }
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder, "box.xml")
        model.write_text(OURS.format(contact=""), encoding="utf-8")
        mapping = {
            "finger": [{"name": name, "radius_m": RADIUS_M} for name in ("thumb", "index")],
            "rolling": {"method": "midpoint"},
            "coupling": {
                "stiffness_n_per_m": STIFFNESS,
                "damping_ns_per_m": 1.0,
                "torsional_damping_nms_per_rad": 0.0015,
            },
            "world": {"model": str(model), "material": material},
        }
        engine = Engine(mapping, 1.0 / DT)
    way, states = lift(seconds), list[Array]()
    settle = round(SETTLE_S / DT)
    depth = GRIP_N / STIFFNESS * np.minimum(np.arange(settle) / (0.5 * settle), 1.0)
    engine.run({name: _poses(side, depth) for name, side in (("thumb", -1.0), ("index", 1.0))})
    engine.model.opt.gravity[2] = -GRAVITY
    force = np.empty((len(way), 3))
    for tick, height in enumerate(way):
        hold = {name: _poses(side, depth[-1:], height) for name, side in (("thumb", -1.0), ("index", 1.0))}
        force[tick] = engine.run(hold)["thumb"]["force"][0]
        states.append(engine.data.qpos.copy())
    return _held(np.array(states), way, force)


def lift(seconds: float) -> Array:
    """Height of the hands (n,) m, a lift by a minimum-jerk move and a hold: LOADED_S and `seconds`."""
    u = np.clip((np.arange(round((LOADED_S + seconds) / DT)) * DT - WEIGHT_S) / LIFT_S, 0.0, 1.0)
    way: Array = LIFT_M * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    return way


def theirs(contact: str, option: str, seconds: float) -> Held:
    """Held by two spheres that mocap bodies lead; the squeeze is searched for that gives the grip without weight."""
    fingers = "".join(
        FINGER.format(name=name, x=x, contact=contact) for name, x in (("thumb", -0.031), ("index", 0.031))
    )
    model = mujoco_module().MjModel.from_xml_string(THEIRS.format(contact=contact, option=option, fingers=fingers))
    low, high = 0.0, 0.02
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _taken(model, middle)[1] < GRIP_N else (low, middle)
    data, _ = _taken(model, 0.5 * (low + high))
    model.opt.gravity[2] = -GRAVITY
    way, states, force = lift(seconds), list[Array](), list[Array]()
    for height in way:
        data.mocap_pos[:, 2] = height
        mujoco_module().mj_step(model, data)
        states.append(data.qpos[:7].copy())
        force.append(_force_on(model, data, "thumb"))
    return _held(np.array(states), way, np.array(force))


def _taken(model: Any, squeeze: float) -> tuple[Any, float]:
    """The box taken with a squeeze (m) beyond touch: MuJoCo's data, and the force of the grip."""
    package = mujoco_module()
    model.opt.gravity[2] = 0.0
    data = package.MjData(model)
    for tick in range(round(SETTLE_S / DT)):
        way = -0.001 + (0.001 + squeeze) * min(tick * DT / (0.5 * SETTLE_S), 1.0)
        data.mocap_pos[:, 0] = np.array([-1.0, 1.0]) * (HALF_M + RADIUS_M - way)
        package.mj_step(model, data)
    return data, abs(float(_force_on(model, data, "thumb")[0]))


def _force_on(model: Any, data: Any, finger: str) -> Array:
    """Sum of the contacts' forces on a finger (3,), world."""
    package, total, wrench = mujoco_module(), np.zeros(3), np.zeros(6)
    number = model.geom(finger).id
    for index in range(data.ncon):
        contact = data.contact[index]
        if number in (contact.geom1, contact.geom2):
            package.mj_contactForce(model, data, index, wrench)
            world = np.asarray(contact.frame).reshape(3, 3).T @ wrench[:3]
            total += world if contact.geom2 == number else -world
    return total


def _poses(side: float, depth: Array, height: float = 0.0) -> Array:
    poses = np.zeros((len(depth), 7))
    poses[:, 0], poses[:, 1], poses[:, 2] = side * (HALF_M + RADIUS_M - depth), BESIDE_M, height
    poses[:, 3] = 1.0
    return poses


def _held(states: Array, way: Array, force: Array) -> Held:
    """States (n, 7) of the box as a Held: the point that is taken goes with the box; `way` (n,) is the hands'."""
    turn = np.unwrap(2.0 * np.arctan2(states[:, 4], states[:, 3]))
    return Held(states[:, 2] - way + BESIDE_M * np.sin(turn), -turn if turn[-1] < 0.0 else turn, force)


def draw(held: dict[str, Held], path: Path) -> None:
    """Height and turn of each over time."""
    drawing = figure(height=4.0)
    above, below = drawing.subplots(2, 1, sharex=True)
    for name, each in held.items():
        seconds = DT * np.arange(len(each.height))
        above.plot(seconds, 1e3 * each.height, label=name)
        below.plot(seconds, np.degrees(each.turn))
    above.set_ylabel("box above the grip [mm]")
    below.set(xlabel="time [s]", ylabel="turn of the box [deg]")
    above.legend(fontsize="small")
    save(drawing, path)
