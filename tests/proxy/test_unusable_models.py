"""MuJoCo models that are hostile, impossible or not installed, each refused with one clear line."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from conftest import merged
from helpers.refusals import refusal

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene
from softfinger.proxy.engine import Engine

pytestmark = pytest.mark.plain
R = 0.008
RUBBER = {"stiffness_n_per_m": 500.0}
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
