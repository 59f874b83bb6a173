"""URDF models: a mesh lid on a hinge, names of geoms, files of packages, time step."""

import math
from pathlib import Path

import pytest
import trimesh

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.mjcf_geoms import convert_geoms
from softfinger.proxy.engine import Engine
from softfinger.proxy.meshes.prepared import describe_mesh

pytestmark = pytest.mark.plain

R = 0.008
STIFFNESS, DAMPING = 500.0, 0.2
"""N/m of the contact, N m s/rad of the hinge."""
WOOD = {"stiffness_n_per_m": STIFFNESS, "damping_ns_per_m": 0.0}
URDF = """
<robot name="box_with_lid">
  <link name="base">
    <inertial><mass value="2"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://toys/lid.stl"/></geometry></visual>
    <collision name="bottom"><geometry><box size="0.2 0.2 0.02"/></geometry></collision>
  </link>
  <link name="lid">
    <inertial><origin xyz="0.05 0 0"/><mass value="0.3"/>
      <inertia ixx="0.0002" iyy="0.0005" izz="0.0005" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.05 0 0"/><geometry>
      <mesh filename="{file}" scale="0.001 0.001 0.001"/></geometry></collision>
    <collision><origin xyz="0.1 0 0"/><geometry><sphere radius="0.004"/></geometry></collision>
  </link>
  <joint name="hinge" type="revolute">
    <parent link="base"/><child link="lid"/><origin xyz="-0.1 0 0.05"/><axis xyz="0 1 0"/>
    <limit lower="-1.5" upper="1.5" effort="10" velocity="5"/><dynamics damping="{damping}"/>
  </joint>
</robot>
"""


def write_model(folder: Path, file: str = "package://toys/lid.stl", location: str = "lid.stl") -> str:
    """Write the URDF and the lid, a plate of 80 x 60 x 10 mm in mm; return the URDF's path."""
    place = folder / location
    place.parent.mkdir(exist_ok=True)
    trimesh.creation.box(extents=(80.0, 60.0, 10.0)).export(place)
    path = folder / "lid.urdf"
    path.write_text(URDF.format(file=file, damping=DAMPING))
    return str(path)


@pytest.mark.parametrize("location", ["lid.stl", "toys/lid.stl"])
def test_geoms_have_the_names_of_links_and_meshes_are_found(location: str, tmp_path: Path) -> None:
    """`package://toys/lid.stl` is lid.stl next to the URDF or toys/lid.stl below it; visual geometry is ignored."""
    rule = schema.GeomMaterial(name="lid", material=schema.Material(stiffness_n_per_m=2.0))
    world = schema.World(
        model=write_model(tmp_path, location=location), material=schema.Material(stiffness_n_per_m=1.0), geom=(rule,)
    )
    objects = {geom.name: geom.object for geom in convert_geoms(world)}
    assert list(objects) == ["bottom", "lid", "lid 2"] and all(entry is not None for entry in objects.values())
    bottom, lid, ball = (entry for entry in objects.values() if entry is not None)
    assert isinstance(lid, schema.Mesh) and lid.mesh == "lid"
    # Along the principal axes of inertia, and in 32 bits.
    assert sorted(describe_mesh(lid).report.size_m) == pytest.approx([0.01, 0.06, 0.08], rel=1e-6)
    assert [entry.material.stiffness_n_per_m for entry in (bottom, lid, ball)] == [1.0, 2.0, 1.0]
    assert bottom.motion is None and lid.motion == schema.Body(body="lid")


@pytest.mark.parametrize("prefix", ["package://toys", "package:///toys", "model://toys"])
def test_a_package_is_searched_in_the_folders_above(prefix: str, tmp_path: Path) -> None:
    """The search covers all folders up to the root, with the package's name and without. MuJoCo permits white space
    before the XML. A root that would contain the package is suggested."""
    folder = tmp_path / "toys" / "robots" / "urdf"
    folder.mkdir(parents=True)
    model = Path(write_model(folder, f"{prefix}/meshes/lid.stl", "../../meshes/lid.stl"))
    model.write_text(f"\n<?xml version='1.0'?>{model.read_text()}\n")
    material = schema.Material(stiffness_n_per_m=1.0)
    for root in (tmp_path, tmp_path / "toys"):
        world = schema.World(model=str(model), root=str(root), material=material)
        assert [geom.name for geom in convert_geoms(world)] == ["bottom", "lid", "lid 2"]
    with pytest.raises(ConfigError, match=r'toys/meshes/lid\.stl is in no folder .* \[world\] root = "\.\./\.\."'):
        list(convert_geoms(schema.World(model=str(model), material=material)))


@pytest.mark.parametrize("substeps", [1, 2])
def test_a_lid_turns_about_its_hinge(substeps: int, tmp_path: Path) -> None:
    """I theta' + c theta equals force times arm times time. A URDF has no time step: that of a tick."""
    scene = {
        "fingertip": {"radius_m": R},
        "world": {"model": write_model(tmp_path), "geom": [{"name": "lid", "material": WOOD}], "substeps": substeps},
    }
    engine = Engine(scene)
    engine.model.opt.gravity[:] = 0.0
    top, arm = 0.05 + 0.005, 0.06
    pose = [-0.1 + arm, 0.0, top + R - 0.001, 1.0, 0.0, 0.0, 0.0]
    engine.run([pose] * 20)
    assert engine.model.opt.timestep == pytest.approx(1e-3 / substeps, rel=1e-12)
    start = engine.data.qpos[0], engine.data.qvel[0]
    pressing = engine.run([pose] * 20)["contact.normal_force"]
    turned, faster = engine.data.qpos[0] - start[0], engine.data.qvel[0] - start[1]
    inertia = 0.0005 + 0.3 * 0.05**2
    assert pressing.min() > 0.3 and turned > 1e-3
    # The plate tilts by at most 0.01 rad, and its top is 5 mm above the hinge: the arm changes by 0.2 %.
    assert inertia * faster + DAMPING * turned == pytest.approx(1e-3 * pressing.sum() * arm, rel=5e-3)
    assert 0.0 < engine.data.qpos[0] < math.atan2(0.001, arm)


@pytest.mark.parametrize("file", ["package://toys/../../secret.stl", "package://../secret.stl", "../secret.stl"])
def test_no_file_outside_of_its_folder_is_read(file: str, tmp_path: Path) -> None:
    world = schema.World(model=write_model(tmp_path, file), material=schema.Material(stiffness_n_per_m=1.0))
    with pytest.raises(ConfigError, match="outside of its folder"):
        list(convert_geoms(world))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    world = schema.World(
        model=write_model(tmp_path, "package://toys/none.stl"), material=schema.Material(stiffness_n_per_m=1.0)
    )
    with pytest.raises(ConfigError, match=r"toys/none\.stl"):
        list(convert_geoms(world))
