"""`bench grasp`: two fingertips lift and hold a box, with the contact of this program and of other simulators.

The box of 40 mm and 100 g is gripped 8 mm off its centre of mass with 3 N, lifted by 100 mm and held. Here the fingers
are soft fingertips. In the other simulators they are spheres of the same radius: `grasp_mujoco`, and the modules that
`--peer` names.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Final

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.proxy.engine import Engine
from softfinger.server.offline.figures import figure, save
from softfinger.server.progress import progress
from softfinger.tools.bench import grasp_bullet, grasp_drake, grasp_mujoco
from softfinger.tools.bench import grasp_case as case
from softfinger.tools.bench.grasp_case import Held
from softfinger.tools.measure import Array, add_output_options, show

PEERS: Final = {"mujoco": grasp_mujoco, "bullet": grasp_bullet, "drake": grasp_drake}
OURS: Final = f"""
<mujoco><option timestep="{case.DT}" integrator="implicitfast" gravity="0 0 0"/><worldbody><body name="box"><freejoint/>
  <geom name="box" type="box" size="{case.HALF_M} {case.HALF_M} {case.HALF_M}" mass="{case.MASS_KG}"/>
</body></worldbody></mujoco>"""


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, default=10.0, help="how long the box hangs (default: %(default)s)")
    parser.add_argument(
        "--peer",
        nargs="+",
        choices=PEERS,
        default=["mujoco"],
        help="whose contacts are beside it; bullet needs `pip install pybullet`, drake `pip install drake` "
        "(default: mujoco)",
    )
    add_output_options(parser)


def run(args: argparse.Namespace) -> int:
    if not 1.0 <= args.seconds <= 1000.0:
        raise ConfigError(f"--seconds {args.seconds:g}: give 1 to 1000")
    for peer in args.peer:
        PEERS[peer].imported()
    held = {"softfinger": ours(args.seconds)}
    with progress("holding", len(args.peer)) as done:
        for number, peer in enumerate(args.peer):
            held |= dict(PEERS[peer].contacts(args.seconds))
            done(number + 1)
    rows = [{"contact": name} | figures_of(each) for name, each in held.items()]
    expected = float(np.degrees(case.MASS_KG * case.GRAVITY * case.BESIDE_M / (2.0 * case.TORSION)))
    lines = [
        f"{1e3 * case.MASS_KG:g} g taken {1e3 * case.BESIDE_M:g} mm off centre with {case.GRIP_N:g} N, lifted, "
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
    """Return the figures of a grasp.

    They are the largest force change per tick after WEIGHT_S, the creep down and in rotation after LOADED_S, and the
    turn at the end.
    """
    first = round(case.LOADED_S / case.DT)
    seconds = case.DT * (len(held.height) - 1 - first)
    changes = np.diff(held.force[round(case.WEIGHT_S / case.DT) :], axis=0)
    return {
        "ripple_mn": 1e3 * float(np.linalg.norm(changes, axis=1).max()),
        "creep_um_per_s": 1e6 * float(held.height[first] - held.height[-1]) / seconds,
        "turn_deg": float(np.degrees(held.turn[-1])),
        "turn_creep_deg_per_s": float(np.degrees(held.turn[-1] - held.turn[first])) / seconds,
    }


def ours(seconds: float) -> Held:
    """Return the grasp by two soft fingertips."""
    material = {
        "stiffness_n_per_m": case.STIFFNESS,
        "damping_ns_per_m": case.DAMPING,
        "friction": {"static": case.FRICTION, "kinetic": 0.7},
        "torsion": {"stiffness_nm_per_rad": case.TORSION, "friction_length_m": case.SPIN_LENGTH_M},
    }
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder, "box.xml")
        model.write_text(OURS, encoding="utf-8")
        mapping = {
            "finger": [{"name": name, "radius_m": case.RADIUS_M} for name in case.SIDES],
            "rolling": {"method": "midpoint"},
            "coupling": {
                "stiffness_n_per_m": case.STIFFNESS,
                "damping_ns_per_m": 1.0,
                "torsional_damping_nms_per_rad": 0.0015,
            },
            "world": {"model": str(model), "material": material},
        }
        engine = Engine(mapping, 1.0 / case.DT)
    way, states = case.lift(seconds), list[Array]()
    settle = round(case.SETTLE_S / case.DT)
    depth = case.GRIP_N / case.STIFFNESS * np.minimum(np.arange(settle) / (0.5 * settle), 1.0)
    engine.run({name: _poses(side, depth) for name, side in case.SIDES.items()})
    engine.model.opt.gravity[2] = -case.GRAVITY
    force = np.empty((len(way), 3))
    for tick, height in enumerate(way):
        hold = {name: _poses(side, depth[-1:], height) for name, side in case.SIDES.items()}
        force[tick] = engine.run(hold)["thumb"]["force"][0]
        states.append(engine.data.qpos.copy())
    return case.held_as(np.array(states), way, force)


def _poses(side: float, depth: Array, height: float = 0.0) -> Array:
    poses = np.zeros((len(depth), 7))
    poses[:, 0], poses[:, 1], poses[:, 2] = case.x_of(side, depth), case.BESIDE_M, height
    poses[:, 3] = 1.0
    return poses


def draw(held: dict[str, Held], path: Path) -> None:
    """Draw height and turn of each grasp over time."""
    drawing = figure(height=4.0)
    above, below = drawing.subplots(2, 1, sharex=True)
    for name, each in held.items():
        seconds = case.DT * np.arange(len(each.height))
        above.plot(seconds, 1e3 * each.height, label=name)
        below.plot(seconds, np.degrees(each.turn))
    above.set_ylabel("box above the grip [mm]")
    below.set(xlabel="time [s]", ylabel="turn of the box [deg]")
    above.legend(fontsize="small")
    save(drawing, path)
