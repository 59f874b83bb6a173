"""Height fields of MuJoCo models match MuJoCo's rays, on bodies at rest and in motion."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from references.rotation import Array
from scipy.interpolate import CubicSpline

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene
from softfinger.config.mjcf_geoms import convert_geoms
from softfinger.proxy.engine import Engine
from softfinger.proxy.heightmaps import measure_overshoot, read_heights
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.kernels.query.objects import find_closest_within
from softfinger.proxy.kernels.query.world import advance, place_all
from softfinger.proxy.kernels.shapes.budget import BUDGET
from softfinger.proxy.pictures import Filed, make_picture
from softfinger.proxy.scene import start_state
from softfinger.server import cli

pytestmark = pytest.mark.plain

R = 0.008
WOOD = {"stiffness_n_per_m": 500.0}
ROWS, COLUMNS, PITCH, TOP = 9, 13, 0.004, 0.006
SIZE = f"{0.5 * (COLUMNS - 1) * PITCH} {0.5 * (ROWS - 1) * PITCH} {TOP} 0.01"
WAVES_M = 0.03, 0.02
"""Wavelengths over 2 pi of the hills along x and y: several pixels."""
MODEL = """
<mujoco>
  <option timestep="0.001" gravity="0 0 0"/>
  <compiler angle="degree"/>
  <asset><hfield name="hills" nrow="{rows}" ncol="{columns}" size="{size}" {source}/></asset>
  <worldbody>
    <body name="carrier" pos="0.01 0.02 0.03" euler="20 -30 40">
      {joint}<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <geom name="hills" type="hfield" hfield="hills" pos="0.01 0.02 0.03" euler="10 20 30"/>
    </body>
  </worldbody>
</mujoco>
"""


def hills() -> Array:
    """Elevations (rows, columns) without symmetry, the first row at the largest y as in MuJoCo's files."""
    x, y = (np.arange(n) * PITCH for n in (COLUMNS, ROWS))
    return np.asarray(np.sin(x / WAVES_M[0] + 0.3) * np.cos(y[:, None] / WAVES_M[1] - 0.4))


def write_model(folder: Path, source: str = "elevation", joint: str = "", size: str = SIZE) -> Path:
    """Write the model, with its elevations inline, in a binary file or in a picture; return its path."""
    elevations = hills()
    numbers = f'elevation="{" ".join(f"{elevation!r}" for elevation in elevations.ravel().tolist())}"'
    rows, columns = ROWS, COLUMNS
    if source == "binary":  # its first row is at the smallest y
        head = np.array([ROWS, COLUMNS], np.int32).tobytes()
        (folder / "hills.bin").write_bytes(head + elevations[::-1].astype(np.float32).tobytes())
        numbers, rows, columns = 'file="hills.bin"', 0, 0
    elif source == "picture":
        from PIL import Image

        grey = np.round(255.0 * (elevations - elevations.min()) / np.ptp(elevations)).astype(np.uint8)
        Image.fromarray(grey).save(folder / "hills.png")
        numbers, rows, columns = 'file="hills.png"', 0, 0
    path = folder / "hills.xml"
    path.write_text(MODEL.format(rows=rows, columns=columns, size=size, source=numbers, joint=joint))
    return path


def make_engine(path: Path, **tables: Any) -> Engine:
    return Engine({"fingertip": {"radius_m": R}, "world": {"model": str(path), "material": WOOD}, **tables})


@pytest.mark.skipif(not PLAIN, reason="calls kernels from Python, which compiled ones do not allow")
@pytest.mark.parametrize("source", ["elevation", "binary", "picture"])
@pytest.mark.parametrize("joint", ["<freejoint/>", ""], ids=["that moves", "that stands"])
def test_a_height_field_matches_mujocos_rays(joint: str, source: str, tmp_path: Path) -> None:
    """At the nodes heights match to 32 bits; between them the surfaces differ by the curvature. MuJoCo has two
    triangles per pixel, our surface is smooth: they differ by up to p^2 / 4 (1 / a^2 + 1 / b^2) times the amplitude."""
    engine = make_engine(write_model(tmp_path, source, joint))
    if joint:
        engine.data.qvel[:] = [0.3, -0.2, 0.1, 2.0, 3.0, -1.0]
        engine.run([[0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0]] * 50)
    world = advance(engine.scene.objects, start_state(engine.scene).world, 1e-3)
    placed = place_all(engine.scene.objects, world)
    mujoco.mj_kinematics(engine.model, engine.data)
    at, axes = engine.data.geom_xpos[0], engine.data.geom_xmat[0].reshape(3, 3)
    scale = TOP / np.ptp(hills())
    bend = scale * (WAVES_M[0] ** -2 + WAVES_M[1] ** -2)
    between = 0.25 * PITCH**2 * bend * 1.05  # and the error of a spline through samples of a sine
    if source == "picture":
        between += TOP / 255.0  # half a level at each corner, and as much from the spline through them
    distances = set()
    for half_row in range(2 * ROWS - 1):
        for half_column in range(2 * COLUMNS - 1):
            local = 0.5 * PITCH * np.array([half_column - COLUMNS + 1, half_row - ROWS + 1])
            local *= 1.0 - 1e-7  # a ray on the rim may miss
            start = at + axes @ [*local, 0.05]
            distance = mujoco.mj_ray(engine.model, engine.data, start, -axes[:, 2], None, 1, -1, np.zeros(1, np.int32))
            assert distance > 0.0
            hit = start - distance * axes[:, 2]
            gap = find_closest_within(placed, 0.0, tuple(hit.tolist()), BUDGET)[0]
            node = half_row % 2 == half_column % 2 == 0
            distances.add(round(distance, 6))
            assert abs(gap) < (1e-8 if node else between), (half_row, half_column, gap)
    assert len(distances) > 50  # the surface is not flat


def test_pixels_that_are_not_square_are_reported(tmp_path: Path) -> None:
    model = str(write_model(tmp_path, size="0.03 0.03 0.006 0.01"))
    world = schema.World(model=model, material=schema.Material(stiffness_n_per_m=500.0))
    (geom,) = convert_geoms(world)
    assert geom.object is None
    assert geom.note == (
        "is a height field with pixels of 0.005 m along x and 0.0075 m along y: must be square; change its size, or "
        "resample it"
    )
    with pytest.raises(ConfigError, match="no geom can be touched: hills is a height field with pixels"):
        make_engine(Path(world.model))


def test_a_heightmap_object_can_use_a_models_height_field(tmp_path: Path) -> None:
    path = write_model(tmp_path)
    entry = {"name": "hills", "shape": "heightmap", "file": str(path), "hfield": "hills", "pitch_m": PITCH}
    entry |= {"level_m": TOP, "material": WOOD}
    scene = {"fingertip": {"radius_m": R}, "object": [entry]}
    (read,) = load_scene(scene).object
    np.testing.assert_allclose(read_heights(read), elevations_m(), atol=TOP * 2.0**-23)  # 32 bits
    entry["hfield"] = "hils"
    with pytest.raises(ConfigError, match=r"hills\.xml: has no height field 'hils'; it has: hills"):
        Engine(scene)


def elevations_m() -> Array:
    """Heights (rows, columns) of the geom above its frame, m, the first row at the smallest y."""
    elevations = hills()[::-1]
    return np.asarray(TOP * (elevations - elevations.min()) / np.ptp(elevations))


def test_overshoot_at_a_step_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    step = np.repeat([0.0, TOP], [6, COLUMNS - 6])
    assert measure_overshoot(np.tile(step, (ROWS, 1))) == pytest.approx(
        CubicSpline(range(COLUMNS), step, bc_type="natural")(np.linspace(0, COLUMNS - 1, 5000)).max() - TOP,
        rel=0.02,  # the maximum is searched at fifths of a cell
    )
    assert measure_overshoot(hills()) < 0.02 * np.ptp(hills()) and measure_overshoot(np.zeros((1, 1))) == 0.0
    np.save(tmp_path / "step.npy", np.tile(step, (ROWS, 1)))
    (tmp_path / "step.toml").write_text(
        '[fingertip]\nradius_m = 0.008\n[[object]]\nname = "step"\nshape = "heightmap"\nfile = "step.npy"\n'
        'pitch_m = 0.004\nlevel_m = 1.0\nmaterial = "wood"\n'
    )
    assert cli.main(["check", str(tmp_path / "step.toml")]) == 0
    output = capsys.readouterr().out
    assert "the smooth surface is up to 0.000646 m higher or lower than the neighbouring pixels" in output


def test_the_page_draws_one_vertex_per_height(tmp_path: Path) -> None:
    """tests/server/viewer/test_drawn_scene.py checks that drawn objects follow their bodies."""
    path = str(write_model(tmp_path, joint="<freejoint/>"))
    (hills_object,) = load_scene({"fingertip": {"radius_m": R}, "world": {"model": path, "material": WOOD}}).object
    assert isinstance(hills_object, Filed) and isinstance(hills_object.motion, schema.Body)
    (vertices, triangles), of = make_picture(hills_object)
    assert of == len(triangles) == 2 * (ROWS - 1) * (COLUMNS - 1)
    x, y = (PITCH * (np.arange(n) - 0.5 * (n - 1)) for n in (COLUMNS, ROWS))
    expected = np.stack([*np.meshgrid(x, y), elevations_m()], axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(vertices, expected, atol=1e-8)  # 32 bits
