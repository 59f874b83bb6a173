"""Grasp by MuJoCo's contact: the fingers are spheres, each welded to a mocap body, as is usual for hands.

Their contact has torsional friction (condim 4), or also rolling friction (condim 6), with the elliptic cone and the
impratio that MuJoCo's documentation recommends for grasps. A bisection finds the squeeze that gives the grip.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from softfinger.config.mjcf import mujoco_module
from softfinger.tools.bench import grasp_case as case
from softfinger.tools.bench.grasp_case import Held, Peer
from softfinger.tools.measure import Array

THEIRS: Final = f"""
<mujoco>
  <option timestep="{case.DT}" integrator="implicitfast" gravity="0 0 0" cone="elliptic" impratio="10" {{option}}/>
  <worldbody><body name="box"><freejoint/>
    <geom name="box" type="box" size="{case.HALF_M} {case.HALF_M} {case.HALF_M}" mass="{case.MASS_KG}" {{contact}}/>
  </body>
    {{fingers}}
  </worldbody>
  <equality>
    <weld body1="thumb-mocap" body2="thumb"/><weld body1="index-mocap" body2="index"/>
  </equality>
</mujoco>"""
FINGER: Final = f"""
    <body name="{{name}}-mocap" mocap="true" pos="{{x}} {case.BESIDE_M} 0"/>
    <body name="{{name}}" pos="{{x}} {case.BESIDE_M} 0" gravcomp="1"><freejoint/>
      <geom name="{{name}}" type="sphere" size="{case.RADIUS_M}" mass="{case.FINGER_KG}" {{contact}}/>
    </body>"""
FRICTIONS: Final = f'friction="{case.FRICTION} {case.SPIN_LENGTH_M} 0.0001"'
CONTACTS: Final = {
    "MuJoCo, condim 4": (f'condim="4" {FRICTIONS}', ""),
    "MuJoCo, condim 6": (f'condim="6" {FRICTIONS}', ""),
    "MuJoCo, condim 6, noslip": (f'condim="6" {FRICTIONS}', 'noslip_iterations="10"'),
}


imported: Final = mujoco_module


class MuJoCo(Peer):
    """MuJoCo with one of CONTACTS."""

    def __init__(self, contact: str, option: str) -> None:
        fingers = "".join(
            FINGER.format(name=name, x=case.x_of(side, -case.APART_M), contact=contact)
            for name, side in case.SIDES.items()
        )
        self._package: Final = imported()
        text = THEIRS.format(contact=contact, option=option, fingers=fingers)
        self._model: Final = self._package.MjModel.from_xml_string(text)
        self._data: Final = self._package.MjData(self._model)
        self._thumb: Final = self._model.geom("thumb").id

    def lead(self, depth: float, height: float) -> None:
        self._data.mocap_pos[:, 0] = [case.x_of(side, depth) for side in case.SIDES.values()]
        self._data.mocap_pos[:, 2] = height

    def weigh(self) -> None:
        self._model.opt.gravity[2] = -case.GRAVITY

    def step(self) -> None:
        self._package.mj_step(self._model, self._data)

    def box(self) -> Array:
        pose: Array = self._data.qpos[:7].copy()
        return pose

    def force(self) -> Array:
        total, wrench = np.zeros(3), np.zeros(6)
        for index in range(self._data.ncon):
            contact = self._data.contact[index]
            if self._thumb in (contact.geom1, contact.geom2):
                self._package.mj_contactForce(self._model, self._data, index, wrench)
                world = np.asarray(contact.frame).reshape(3, 3).T @ wrench[:3]
                total += world if contact.geom2 == self._thumb else -world
        return total


def contacts(seconds: float) -> Iterator[tuple[str, Held]]:
    """Yield each of CONTACTS with its grasp."""
    for name, given in CONTACTS.items():
        low, high = 0.0, 0.02
        for _ in range(20):
            middle = 0.5 * (low + high)
            grip = abs(float(case.take(MuJoCo(*given), middle).force()[0]))
            low, high = (middle, high) if grip < case.GRIP_N else (low, middle)
        yield name, case.hold(MuJoCo(*given), 0.5 * (low + high), seconds)
