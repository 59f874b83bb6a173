"""`world.mass_kg`, and `mass.BODY` of an experiment, compared with MuJoCo's compilation of a model with these
masses."""

from pathlib import Path
from typing import Final

import mujoco
import numpy as np
import pytest
import trimesh
from helpers.refusals import refusal

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene
from softfinger.config.mjcf import read_model
from softfinger.proxy.engine import Engine
from softfinger.server.experiment.checks import load
from softfinger.server.experiment.haptics import to_file_mapping
from softfinger.server.experiment.parameters import load_changed_scene

pytestmark = pytest.mark.plain

MODEL: Final = """
<mujoco>
  <option timestep="0.001"/>
  <compiler {compiler}/>
  <worldbody>
    <body name="a" pos="0 0 1"><freejoint/>{body}
      <body name="arm" pos="0.1 0 0"><joint type="hinge"/><geom size="0.02" mass="0.05"/></body>
    </body>
    <body name="stand"><geom name="floor" type="plane" size="1 1 1"/></body>
  </worldbody>
  <actuator><position joint="turn" kp="10"/></actuator>
</mujoco>"""
ROD: Final = '<joint name="turn" type="hinge"/><geom size="0.01" mass="0.001"/>'
KINDS: Final = {
    "mass of one geom": ('<geom name="g" size="0.03 0.02 0.01" type="box" mass="{m}"/>', ""),
    "masses of two geoms": (
        '<geom name="g" size="0.03" mass="{m}"/>'
        '<geom name="h" type="box" size="0.01 0.02 0.03" pos="0.05 0 0" mass="{m}"/>',
        "",
    ),
    "density": ('<geom name="g" type="box" size="0.05 0.04 0.03" density="{d}"/>', ""),
    "inertial": (
        '<inertial pos="0 0 0.01" mass="{m}" diaginertia="{m}e-3 {m}e-3 {m}e-3"/><geom name="g" size="0.03" mass="7"/>',
        "",
    ),
    "full inertia": (
        '<inertial pos="0 0 0" mass="{m}" fullinertia="{m}e-3 {m}e-3 {m}e-3 {m}e-4 0 0"/><geom name="g" size="0.03"/>',
        "",
    ),
    "inertia from geoms": (
        '<inertial pos="0 0 1" mass="9" diaginertia="1 1 1"/><geom name="g" size="0.03" mass="{m}"/>',
        'inertiafromgeom="true"',
    ),
}


def model(kind: str, scale: int) -> str:
    """Return a model in which body `a` has `scale` times its first mass."""
    body, compiler = KINDS[kind]
    return MODEL.replace("{compiler}", compiler).replace(
        "{body}", body.replace("{m}", str(scale)).replace("{d}", str(100 * scale)) + f'<body name="b">{ROD}</body>'
    )


@pytest.mark.parametrize("kind", list(KINDS))
def test_the_model_is_the_one_with_that_mass(kind: str, tmp_path: Path) -> None:
    (tmp_path / "one.xml").write_text(model(kind, 1))
    expected = mujoco.MjModel.from_xml_string(model(kind, 3))
    mass = {"a": float(expected.body("a").mass[0])}
    read = read_model(schema.World(model=str(tmp_path / "one.xml"), mass_kg=mass))
    for name in ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0"):
        # Of the compiler's rounding.
        np.testing.assert_allclose(getattr(read, name), getattr(expected, name), rtol=1e-12, err_msg=name)
    for name in ("body_ipos", "body_iquat", "actuator_acc0"):
        np.testing.assert_allclose(getattr(read, name), getattr(expected, name), atol=1e-12, rtol=1e-12, err_msg=name)
    assert read.stat.meaninertia == pytest.approx(expected.stat.meaninertia, rel=1e-12)


@pytest.mark.parametrize(("body", "mass"), [("stand", 1.0), ("nobody", 1.0), ("world", 1.0), ("a", 0.0), ("a", -1.0)])
def test_a_mass_for_an_unknown_or_massless_body_is_refused(body: str, mass: float, tmp_path: Path) -> None:
    (tmp_path / "one.xml").write_text(model("density", 1))
    world = {"model": str(tmp_path / "one.xml"), "material": {"stiffness_n_per_m": 500.0}}
    scene = {"fingertip": {"radius_m": 0.01}, "world": world}
    with pytest.raises(ConfigError, match=r"level 3: .*mass_kg.*(it has a, b, arm|must be a number from 1e-06)"):
        load_changed_scene(scene, {f"mass.{body}": mass}, "level 3")


def test_a_model_of_several_files(tmp_path: Path) -> None:
    body = '<body name="ball" pos="0 0 1"><freejoint/><geom name="skin" type="mesh" mesh="ball"/></body>'
    (tmp_path / "part.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    trimesh.creation.icosphere(subdivisions=1, radius=0.05).export(tmp_path / "ball.stl")
    (tmp_path / "whole.xml").write_text(
        '<mujoco><option timestep="0.001"/><asset><mesh name="ball" file="ball.stl"/></asset>'
        '<include file="part.xml"/></mujoco>'
    )
    file = tmp_path / "scene.toml"
    world = '[world]\nmodel = "whole.xml"\n[world.material]\nstiffness_n_per_m = 500'
    file.write_text(f"[fingertip]\nradius_m = 0.01\n{world}\n")
    engine = Engine(load_changed_scene(file, {"mass.ball": 0.2, "fingertip.radius_m": 0.02}, "overrides"))
    assert engine.model.body("ball").mass[0] == 0.2 and engine.config.fingertip.radius_m == 0.02


def test_masses_of_overrides_pass_the_check_and_stay_in_the_scene() -> None:
    changes = {"overrides": {"mass.box": 0.2}, "scene": "lift-a-box"}
    message = refusal(load, "stiffness-discrimination", changes)
    assert "there is no object.table" in message and "mass" not in message  # of the parameter: the mass is good
    scene = load_changed_scene("lift-a-box", {"mass.box": 0.2}, "overrides")
    assert Engine(scene).model.body("box").mass[0] == 0.2
    assert Engine(load_scene(to_file_mapping(scene))).model.body("box").mass[0] == 0.2
