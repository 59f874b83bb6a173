"""MuJoCo models from other sources: files in other folders, mirrored meshes, pairs, keyframes, any time step; models
that are hostile or impossible, each refused with one clear line."""

import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import merged
from helpers.refusals import refusal

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene
from softfinger.config.mjcf_geoms import convert_geoms
from softfinger.proxy.engine import Engine
from softfinger.proxy.meshes.prepared import describe_mesh
from softfinger.server.cli import main

pytestmark = pytest.mark.plain
RUBBER = {"stiffness_n_per_m": 500.0}
FAR = [0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0]
WEDGE = np.array([(-2, -2, -2), (2, -2, -2), (-2, 2, -2), (2, 2, -2), (-2, -2, 0), (2, -2, 0), (-2, 2, 2), (2, 2, 2)])
"""Corners, cm: a prism that is higher at y = 2 cm than at y = -2 cm."""
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
FACES = [face for a, b, c, d in QUADS for face in ((a, b, c), (a, c, d))]
FLOAT32 = 1e-8
"""m: MuJoCo stores and rotates vertices of some centimetres in 32 bits."""


def stl(path: Path, points: Any = 0.01 * WEDGE, faces: Any = FACES) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *np.asarray(points)[list(face)].ravel(), 0) for face in faces)
    path.write_bytes(b"".ljust(80) + struct.pack("<I", len(faces)) + body)


def write_model(path: Path, body: str, option: str = "", **world: Any) -> Path:
    """Write a model of these elements and a scene with it to the same folder; return the scene's path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"<mujoco>{option}{body}</mujoco>")
    keys = "".join(f'{name} = "{value}"\n' for name, value in world.items())
    scene = path.with_suffix(".toml")
    scene.write_text(
        f'[fingertip]\nradius_m = 0.01\n[world]\nmodel = "{path.name}"\n{keys}'
        "[world.material]\nstiffness_n_per_m = 500.0\n"
    )
    return scene


def test_xml_that_mujoco_reads_is_read(tmp_path: Path) -> None:
    scene = write_model(tmp_path / "m.xml", '<!-- the robot\'s -- own -->\n<worldbody><geom size="1"/></worldbody>')
    assert len(load_scene(scene).object) == 1
    urdf = tmp_path / "m.urdf"
    urdf.write_text(
        '<robot name="r"><link name="a" drake:mass="1"><collision><geometry><sphere radius="1"/></geometry></collision>'
        "</link><gazebo:plugin/></robot>"
    )
    scene.write_text(scene.read_text().replace("m.xml", "m.urdf"))
    assert [entry.name for entry in load_scene(scene).object] == ["a"]


def test_included_files_are_found_as_mujoco_finds_them(tmp_path: Path) -> None:
    """Includes are searched in the model's folder, then in the including file's, also upwards; Latin-1 is read."""
    scene = write_model(tmp_path / "m.xml", '<include file="sub/part.xml"/>')
    (tmp_path / "sub").mkdir()
    both = '<mujoco><include file="own.xml"/><include file="../upper.xml"/></mujoco>'
    (tmp_path / "sub" / "part.xml").write_text(both)
    for name in ("sub/own.xml", "upper.xml"):
        text = f'<mujoco><!-- \xe9 --><worldbody><geom name="{name}" size="1"/></worldbody></mujoco>'
        (tmp_path / name).write_bytes(text.encode("latin-1"))
    assert [entry.name for entry in load_scene(scene).object] == ["sub/own.xml", "upper.xml"]


def placed(mesh: schema.Object) -> np.ndarray:
    w, x, y, z = mesh.orientation_wxyz
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.array([w, x, y, z]))
    return describe_mesh(mesh).picture.vertices @ turn.reshape(3, 3).T + mesh.position_m


def by_row(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(np.round(points, 6).T)]


BOX_GEOM = '<geom name="part" type="mesh" mesh="wedge"/>'
MESH = '<asset><mesh name="wedge" file="{}"/></asset><worldbody>' + BOX_GEOM + "</worldbody>"


def test_files_of_a_sibling_folder_need_a_root(tmp_path: Path) -> None:
    stl(tmp_path / "stls/wedge.stl")
    path = tmp_path / "models/part.xml"
    for option, file in (("", "../stls/wedge.stl"), ('<compiler meshdir="../stls"/>', "wedge.stl")):
        with pytest.raises(ConfigError, match=r"stls/wedge\.stl.* outside of its folder: .*\[world\] root = \"\.\.\""):
            load_scene(write_model(path, MESH.format(file), option))
        (part,) = load_scene(write_model(path, MESH.format(file), option, root="..")).object
        np.testing.assert_allclose(by_row(placed(part)), by_row(0.01 * WEDGE), atol=FLOAT32)
    stl(tmp_path.parent / "above.stl")
    with pytest.raises(ConfigError, match=r"above\.stl.* outside of its folder: .*root = \"\.\.\""):
        load_scene(write_model(path, MESH.format("../../above.stl"), root=".."))


ATTACHED = (
    '<asset><model name="part" file="part/part.xml"/></asset><worldbody><geom name="floor" type="plane" size="1 1 1"/>'
    '<frame pos="0 0 0.1"><attach model="part" body="part" prefix="left_"/></frame></worldbody>'
)
PART = '<asset><mesh name="wedge" file="{}"/></asset><worldbody><body name="part">' + BOX_GEOM + "</body></worldbody>"


def test_folders_are_found_as_mujoco_finds_them(tmp_path: Path) -> None:
    """Covers `strippath` and a `meshdir` that an included file sets for all; MuJoCo's list of files has neither."""
    stl(tmp_path / "meshes/wedge.stl")
    (tmp_path / "inner").mkdir()
    more = f'<mujocoinclude><compiler meshdir="meshes"/>{MESH.format("wedge.stl")}</mujocoinclude>'
    (tmp_path / "inner/more.xml").write_text(more)
    scenes = [
        write_model(
            tmp_path / "strip.xml", MESH.format("../far/wedge.stl"), '<compiler meshdir="meshes" strippath="true"/>'
        ),
        write_model(tmp_path / "outer.xml", '<include file="inner/more.xml"/>'),
        write_model(tmp_path / "last.xml", '<include file="inner/more.xml"/>', '<compiler meshdir="none"/>'),
    ]
    for scene in scenes:
        (part,) = load_scene(scene).object
        np.testing.assert_allclose(by_row(placed(part)), by_row(0.01 * WEDGE), atol=FLOAT32)
    flex = (
        '<worldbody><body name="b"><flexcomp name="f" type="mesh" file="../wedge.obj" dim="2" mass="1"/></body>'
        '<geom name="ball" size="0.1"/></worldbody>'
    )
    (tmp_path / "a").mkdir()
    with pytest.raises(ConfigError, match=r"<flexcomp file='\.\./wedge\.obj'> is outside"):
        load_scene(write_model(tmp_path / "a/flex.xml", flex, '<compiler meshdir="sub"/>'))


def test_a_mesh_next_to_an_included_file_loads_from_any_working_directory(tmp_path, monkeypatch):
    """MuJoCo prepends the path of the included file's folder, which starts with that of the model."""
    stl(tmp_path / "models/inner/wedge.stl")
    write_model(tmp_path / "models/inner/part.xml", MESH.format("wedge.stl"))
    scene = write_model(tmp_path / "models/outer.xml", '<include file="inner/part.xml"/>')
    for folder in (tmp_path, tmp_path / "models", tmp_path / "models/inner"):
        monkeypatch.chdir(folder)
        (part,) = load_scene(Path(os.path.relpath(scene))).object
        np.testing.assert_allclose(by_row(placed(part)), by_row(0.01 * WEDGE), atol=FLOAT32)


def test_groups_of_an_obj_file_are_refused(tmp_path: Path) -> None:
    """MuJoCo would silently read only the first group."""
    lines = [f"v {x} {y} {z}" for x, y, z in (0.01 * WEDGE).tolist()]
    faces = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES]
    path = tmp_path / "part.obj"
    scene = write_model(tmp_path / "part.xml", MESH.format("part.obj"))
    path.write_text("\n".join(["o part", *lines, "g a", *faces[:6], "g b", *faces[6:]]))
    with pytest.raises(ConfigError, match=r"geom 'part': .*part\.obj has faces in several groups"):
        load_scene(scene)
    path.write_text("\n".join(["o part", *lines, "g a", *faces]))
    (part,) = load_scene(scene).object
    np.testing.assert_allclose(by_row(placed(part)), by_row(0.01 * WEDGE), atol=FLOAT32)


def test_an_attached_model_reads_only_its_folder(tmp_path: Path) -> None:
    stl(tmp_path / "wedge.stl")
    scene = write_model(tmp_path / "scene/scene.xml", ATTACHED)
    for option, file in (("", "../../wedge.stl"), ('<compiler meshdir=".."/>', "../wedge.stl")):
        write_model(tmp_path / "scene/part/part.xml", PART.format(file), option)
        with pytest.raises(ConfigError, match=r"wedge\.stl is outside of its folder"):
            load_scene(scene)
    stl(tmp_path / "scene/part/meshes/sub/wedge.stl")
    write_model(tmp_path / "scene/part/part.xml", PART.format("sub/wedge.stl"), '<compiler meshdir="meshes"/>')
    floor, part = load_scene(scene).object
    assert (floor.name, part.name) == ("floor", "left_part")
    np.testing.assert_allclose(by_row(placed(part)), by_row(0.01 * WEDGE + [0, 0, 0.1]), atol=FLOAT32)


def test_textures_are_not_read(tmp_path: Path) -> None:
    looks = (
        '<asset><texture name="a" type="2d" file="../none/grey.png"/><material name="a" texture="a"/>'
        '<texture name="b" type="skybox" fileright="../r.png" fileleft="l.png"/>'
        '<texture name="c" type="cube" file="c.png" gridsize="3 4" gridlayout=".U..LFRB.D.."/></asset>'
        '<worldbody><geom name="can" type="cylinder" size="0.03 0.05" material="a"/></worldbody>'
    )
    (can,) = load_scene(write_model(tmp_path / "a/can.xml", looks)).object
    assert isinstance(can, schema.Cylinder)
    stl(tmp_path / "x.stl")
    both = f'<asset><texture name="a" type="2d" file="x.stl"/></asset>{MESH.format("../x.stl")}'
    with pytest.raises(ConfigError, match=r"x\.stl is outside of its folder"):
        load_scene(write_model(tmp_path / "a/both.xml", both))


def test_meshes_have_the_position_of_mujoco(tmp_path: Path) -> None:
    stl(tmp_path / "wedge.stl")
    inline = " ".join(f"{coordinate:g}" for coordinate in (0.01 * WEDGE).ravel())
    turn = "refpos='0.01 0 0' refquat='0.7071067811865476 0 0 0.7071067811865476'"
    meshes = {"right": "", "left": "scale='1 -1 1'", "wide": "scale='2 1 1'", "turned": turn}
    assets = "".join(f'<mesh name="{name}" file="wedge.stl" {keys}/>' for name, keys in meshes.items())
    assets += f'<mesh name="inline" vertex="{inline}"/>'
    geoms = "".join(f'<geom name="{name}" type="mesh" mesh="{name}" pos="0 0 1"/>' for name in (*meshes, "inline"))
    scene = load_scene(write_model(tmp_path / "all.xml", f"<asset>{assets}</asset><worldbody>{geoms}</worldbody>"))
    corners = 0.01 * WEDGE
    x, y, z = (corners - [0.01, 0, 0]).T
    expected = {
        "right": corners,
        "left": corners * [1, -1, 1],
        "wide": corners * [2, 1, 1],
        "turned": np.stack([y, -x, z], axis=1),  # the reference is rotated by 90 degrees
        "inline": corners,
    }
    for entry in scene.object:
        np.testing.assert_allclose(by_row(placed(entry)), by_row(expected[entry.name] + [0, 0, 1]), atol=2 * FLOAT32)
        report = describe_mesh(entry).report
        assert report.watertight and report.turned_triangles == 0, entry.name


def test_a_changed_mesh_is_read_again(tmp_path: Path) -> None:
    stl(tmp_path / "wedge.stl")
    path = write_model(tmp_path / "part.xml", MESH.format("wedge.stl"))
    np.testing.assert_allclose(by_row(placed(load_scene(path).object[0])), by_row(0.01 * WEDGE), atol=FLOAT32)
    stl(tmp_path / "wedge.stl", 0.02 * WEDGE)
    (part,) = load_scene(path).object
    np.testing.assert_allclose(by_row(placed(part)), by_row(0.02 * WEDGE), atol=2 * FLOAT32)


def test_a_hull_that_differs_from_its_mesh_is_reported(tmp_path: Path) -> None:
    """An L of three cubes has a hull with half a cube more; a wedge equals its hull."""
    outline = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]) * 0.01
    corners = np.array([(x, y, z) for z in (0.0, 0.01) for x, y in outline])
    lid = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    sides = [face for k in range(6) for face in ((k, (k + 1) % 6, k + 6), ((k + 1) % 6, (k + 1) % 6 + 6, k + 6))]
    faces = [face[::-1] for face in lid] + [tuple(k + 6 for k in face) for face in lid] + sides
    stl(tmp_path / "wedge.stl")
    stl(tmp_path / "l.stl", corners, faces)
    body = (
        '<asset><mesh name="wedge" file="wedge.stl"/><mesh name="l" file="l.stl"/></asset><worldbody>'
        f'{BOX_GEOM}<body><freejoint/><geom name="l" type="mesh" mesh="l"/></body></worldbody>'
    )
    world = load_scene(write_model(tmp_path / "two.xml", body)).world
    notes = {geom.name: geom.note for geom in convert_geoms(world)}
    assert notes["part"] == ""
    hull = "other geoms collide with its convex hull, which has 1.17 times its volume"
    assert notes["l"] == f"has its own shape for fingers; {hull}"


def test_rules_select_the_material_of_each_geom(tmp_path: Path) -> None:
    path = tmp_path / "some.xml"
    path.write_text(
        '<mujoco><default><default class="soft"><geom rgba="1 0 0 1"/></default></default><worldbody>'
        '<geom name="a" type="sphere" size="1"/><geom name="b" type="sphere" size="1" group="2"/>'
        '<geom name="c" class="soft" type="sphere" size="1"/><geom type="sphere" size="1" contype="0" conaffinity="0"/>'
        '<geom name="d" type="plane" size="1 1 1"/></worldbody></mujoco>'
    )
    rules = [
        {"group": 2, "material": {"stiffness_n_per_m": 2.0}},
        {"default": "soft", "material": {"stiffness_n_per_m": 3.0}},
        {"name": "a", "material": {"stiffness_n_per_m": 4.0}},
        {"name": "d", "material": {"stiffness_n_per_m": 5.0}},
    ]
    scene = load_scene({"fingertip": {"radius_m": 0.008}, "world": {"model": str(path), "geom": rules}})
    assert {entry.name: entry.material.stiffness_n_per_m for entry in scene.object} == {"a": 4, "b": 2, "c": 3, "d": 5}
    notes = {geom.name: geom.note for geom in convert_geoms(scene.world)}
    assert "does not collide" in notes["geom-3"] and "without an end" in notes["d"]


def test_geoms_of_pairs_collide(tmp_path: Path) -> None:
    body = (
        '<default><geom contype="0" conaffinity="0"/></default><worldbody>'
        '<geom name="floor" type="plane" size="1 1 1"/>'
        '<geom name="seen" size="0.1"/><body><freejoint/><geom name="ball" size="0.02"/></body></worldbody>'
        '<contact><pair geom1="floor" geom2="ball"/></contact>'
    )
    assert [entry.name for entry in load_scene(write_model(tmp_path / "pairs.xml", body)).object] == ["floor", "ball"]


ARM = """
<worldbody><body name="arm" pos="0 0 0.2"><joint name="hinge" type="hinge" axis="0 1 0" damping="0.05"/>
  <geom name="link" type="capsule" fromto="0 0 0 0.15 0 0" size="0.01" mass="0.2"/></body></worldbody>
<actuator><position name="servo" joint="hinge" kp="20" kv="0.5"/></actuator>
<keyframe><key name="home" qpos="-0.8" ctrl="-0.8"/><key name="down" qpos="1.0"/></keyframe>
"""


def test_bodies_start_at_a_keyframe(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    option = '<option timestep="0.005"/>'
    path = write_model(tmp_path / "arm.xml", ARM, option, keyframe="home")
    engine = Engine(str(path))
    for _ in range(2):
        engine.reset()
        assert (engine.data.qpos[0], engine.data.ctrl[0]) == (-0.8, -0.8)
        engine.run([FAR] * 400)
        assert engine.model.opt.timestep == 0.001 and engine.data.time == pytest.approx(0.4)
        # gravity deflects the servo by less than m g l / kp
        assert abs(engine.data.qpos[0] + 0.8) < 0.2 * 9.81 * 0.075 / 20.0
    assert main(["check", str(path)]) == 0
    output = capsys.readouterr().out
    assert "a tick's, 0.001 s at 1000 Hz; the model's own is 0.005 s" in output and "home" in output
    write_model(tmp_path / "arm.xml", ARM, option, keyframe="hme")
    assert main(["check", str(path)]) == 2
    assert "world.keyframe = 'hme'" in (output := capsys.readouterr().err) and "it has: home, down" in output
    write_model(tmp_path / "arm.xml", ARM, option, timestep="file")
    assert main(["check", str(path)]) == 2
    assert "its timestep of 0.005 s, world.substeps = 1 times, is not a tick of 0.001 s" in capsys.readouterr().err
    (tmp_path / "slow.toml").write_text('[device]\ndriver = "simulated"\n[servo]\nrate_hz = 200.0\n')
    assert main(["check", str(path), str(tmp_path / "slow.toml")]) == 0
    assert "0.005 s, the model's own: a tick at servo.rate_hz = 200" in capsys.readouterr().out
    write_model(tmp_path / "arm.xml", ARM, '<option timestep="0.0005"/>')
    assert main(["check", str(path)]) == 0 and "substeps = 2 would match it" in capsys.readouterr().out


def test_check_refuses_bodies_that_cannot_start(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`check` fails as `run` does, here because the initial contacts exceed the memory."""
    boxes = '<body><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>' * 4
    path = write_model(tmp_path / "full.xml", f"<worldbody>{boxes}</worldbody>", '<size memory="30K"/>')
    assert main(["check", str(path)]) == 2
    assert "cannot be simulated from its initial state" in capsys.readouterr().err


R = 0.008
OPTION = '<option timestep="0.001"/>'
BALL = '<body><freejoint/><geom size="0.1"/></body>'
BOMB = (
    '<!DOCTYPE mujoco [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">'
    '<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]><mujoco model="&c;"/>'
)
INERTIA = '<body><freejoint/><inertial pos="0 0 0" mass="{}" diaginertia="{}"/><geom size="0.1"/></body>'
COPIES = '<replicate count="{}" offset="1 0 0">{}</replicate>'
FLEXIBLE = '<flexcomp name="f" type="grid" count="{}" spacing=".1 .1 .1" dim="3" {}/>'
OUTSIDE = {
    "a file": '<mujoco><include file="../../etc/passwd"/></mujoco>',
    "a file, in a namespace": '<mujoco xmlns="a"><include file="../secret.xml"/></mujoco>',
    "a file, in an element of a namespace": '<mujoco><include xmlns="a" file="../secret.xml"/></mujoco>',
    "a file, in a part that is not a UTF-8": '<mujoco><include file="latin.xml"/></mujoco>',
    "a file, in a part beside a part": '<mujoco><include file="sub/part.xml"/></mujoco>',
    "a file, included twice": '<mujoco><include file="inner.xml"/></mujoco>',
    "a folder": '<mujoco><compiler meshdir="/etc"/><asset><mesh name="m" file="hosts.stl"/></asset></mujoco>',
    "a file, of an attached model": '<mujoco><asset><model name="m" file="outer.xml"/></asset>'
    '<worldbody><frame><attach model="m" body="b" prefix="p"/></frame></worldbody></mujoco>',
}
IN_BODY = f"<mujoco>{OPTION}<worldbody>{{}}</worldbody></mujoco>"
LARGE_ASSET = "<mujoco><asset>{}</asset></mujoco>"
HOSTILE = {
    **{f"outside: {name}": (text, "outside of its folder") for name, text in OUTSIDE.items()},
    "nothing": ("", "not well-formed XML"),
    "no XML": ("<mujoco", "not well-formed XML"),
    "another root": ("<robots/>", "robots"),
    "an entity that grows": (BOMB, "declares a document type"),
    "an unknown element": ("<mujoco><wheel/></mujoco>", "wheel"),
    "no mass": (IN_BODY.format('<body><freejoint/><geom size="0.1" mass="0"/></body>'), "mass"),
    "an inertia that is none": (IN_BODY.format(INERTIA.format("nan", "1 1 1")), ""),
    "an inertia of which a part is none": (IN_BODY.format(INERTIA.format("1", "nan 1 1")), "inertia"),
    "a missing mesh": (LARGE_ASSET.format('<mesh name="m" file="none.stl"/>'), "none.stl"),
    "a file outside, in a declaration that MuJoCo does not know": (
        "<!DOCTYPE mujoco [<!NOTATION n SYSTEM \"> <mujoco><include file='../secret.xml'/></mujoco><!--\">]>"
        "<mujoco/><!-- -->",
        "declares a document type",
    ),
    "a name that is not a UTF-8": ('<mujoco model="\N{REPLACEMENT CHARACTER}"/>', "is not text in UTF-8"),
    "too many bodies": (IN_BODY.format(BALL * 6000), "1,001 bodies"),
    "too many copies": (IN_BODY.format(COPIES.format(1100, BALL)), "1,100 bodies"),
    "too many copies of copies": (IN_BODY.format(COPIES.format(100, COPIES.format(100, BALL))), "10,000 bodies"),
    "too many copies of a file": (IN_BODY.format(COPIES.format(2000, '<include file="ball.xml"/>')), "at most 1,000"),
    "a file that includes itself": ('<mujoco><include file="hostile.xml"/></mujoco>', "includes hostile.xml twice"),
    "too many bodies by an attached model": (
        f'<mujoco>{OPTION}<asset><model name="m" file="model.xml"/></asset><worldbody><replicate count="400">'
        '<attach model="m" prefix="p"/></replicate></worldbody></mujoco>',
        "bodies or more; at most 1,000",
    ),
    "too many bodies of a flexible one": (IN_BODY.format(FLEXIBLE.format("20 20 20", "")), "8,000 bodies"),
    "too fine a flexible body": (IN_BODY.format(FLEXIBLE.format("60 60 60", 'dof="trilinear"')), "at most 16,000"),
    "too many copies of sites": (IN_BODY.format(COPIES.format(10_000, '<site size="0.1"/>')), "at most 5,000"),
    "too many elements": (f"<mujoco>{'<site/>' * 500_000}</mujoco>", "more than 20,000 elements"),
    "a height field of 14 GB": (
        LARGE_ASSET.format('<hfield name="h" nrow="60000" ncol="60000" size="1 1 1 1"/>'),
        "nrow x ncol = 3,600,000,000; at most 1,048,576",
    ),
    "a texture of 10 GB": (
        LARGE_ASSET.format('<texture name="t" type="2d" builtin="flat" width="60000" height="60000"/>'),
        "width x height = 3,600,000,000; at most 16,777,216",
    ),
    "numbers of the user for each body": ('<mujoco><size nuser_body="100000"/></mujoco>', "at most 1,000"),
    "many vertices": (LARGE_ASSET.format(f'<mesh name="m" vertex="{"0 1 2 " * 200_000}"/>'), "put it in a file"),
    "bodies that overlap at the start, in too little memory": (
        '<mujoco><size memory="30K"/>'
        + IN_BODY.removeprefix("<mujoco>").format('<body><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>' * 4),
        "cannot be simulated from its initial state: {'constraints full'",
    ),
}


@pytest.mark.sampled(12)
@pytest.mark.parametrize("name", HOSTILE)
def test_an_unusable_model_raises_one_clear_error(name: str, tmp_path: Path) -> None:
    text, expected = HOSTILE[name]
    path = tmp_path / "hostile.xml"
    path.write_text(text)
    (tmp_path / "inner.xml").write_text('<mujocoinclude><include file="../secret.xml"/></mujocoinclude>')
    latin = '<mujoco><!-- \xe9 --><include file="../secret.xml"/></mujoco>'
    (tmp_path / "latin.xml").write_bytes(latin.encode("latin-1"))
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "part.xml").write_text('<mujoco><include file="beside.xml"/></mujoco>')
    (tmp_path / "sub" / "beside.xml").write_text('<mujoco><include file="../../secret.xml"/></mujoco>')
    (tmp_path / "ball.xml").write_text(f"<mujocoinclude>{BALL}</mujocoinclude>")
    (tmp_path / "model.xml").write_text(f"<mujoco><worldbody>{BALL * 3}</worldbody></mujoco>")
    (tmp_path / "outer.xml").write_text(
        '<mujoco><asset><mesh name="s" file="../secret.stl"/></asset><worldbody><body name="b">'
        '<geom type="mesh" mesh="s"/></body></worldbody></mujoco>'
    )
    message = refusal(Engine, {"fingertip": {"radius_m": R}, "world": {"model": str(path), "material": RUBBER}})
    assert expected in message and "hostile.xml" in message
    assert "\n" not in message and len(message) < 500


ON_BOX = {"kind": "body", "body": "box"}
BALL_ON_BOX = {"name": "ball", "shape": "sphere", "radius_m": 0.01, "material": RUBBER, "motion": ON_BOX}
PUSH = {"kind": "constant_force", "force_n": [0.0, 0.0, 1.0]}
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "no such file": ({"world": {"model": "none.xml"}}, "none.xml: cannot be read"),
    "no model": ({"world": {"model": "scene.toml"}}, "must end in .xml, .mjcf or .urdf"),
    "a body without a world": ({"world": None, "object": [BALL_ON_BOX]}, "needs a table [world]"),
    "no such body": ({"object": [BALL_ON_BOX | {"motion": ON_BOX | {"body": "bix"}}]}, "'bix' is not a body of"),
    "an effect on a body": ({"object": [BALL_ON_BOX | {"effect": [PUSH]}]}, "would push the hand but not the body"),
    "nothing to touch": ({"world": None}, "object: is missing"),
    "a material for no geom": ({"world": {"geom": [{"material": RUBBER}]}}, "world.geom[0].name: is missing"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_scene_that_does_not_fit_its_world_is_refused(name: str, tmp_path: Path) -> None:
    changes, expected = WRONG[name]
    model = tmp_path / "box.xml"
    model.write_text(
        IN_BODY.format('<body name="box"><freejoint/><geom name="box" type="box" size="0.02 0.02 0.02"/></body>')
    )
    world = {"model": str(model), "material": RUBBER}
    message = refusal(Engine, merged({"fingertip": {"radius_m": R}, "world": world}, changes))
    assert expected in message and "\n" not in message


def test_a_warning_about_a_model_writes_no_file(tmp_path: Path) -> None:
    (tmp_path / "nan.xml").write_text(IN_BODY.format('<geom name="ball" size="0.02" pos="0 0 nan"/>'))
    code = "from softfinger.config.mjcf import compile_model; compile_model('nan.xml')"
    subprocess.run([sys.executable, "-c", code], check=False, cwd=tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["nan.xml"]


def test_a_scene_without_a_world_does_not_import_mujoco() -> None:
    code = (
        "import sys; from softfinger import Engine; e = Engine('paper-plane'); "
        "e.step([0, 0, 0.0095], [1, 0, 0, 0]); assert 'mujoco' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | {"NUMBA_DISABLE_JIT": "1"})
    with pytest.raises(ConfigError, match="no \\[world\\]"):
        Engine("paper-plane").data  # noqa: B018


def test_a_world_without_mujoco_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    model = tmp_path / "model.xml"
    model.write_text("<mujoco/>")
    with pytest.raises(ConfigError, match=r"softfinger\[world\]"):
        load_scene({"fingertip": {"radius_m": R}, "world": {"model": str(model), "material": RUBBER}})
