"""The program works without the folder of a shape and its entry in the table of shapes."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import pytest
from helpers.programs import run_program

pytestmark = pytest.mark.plain

ROOT = Path(__file__).resolve().parents[2]
RENDERED = """
from softfinger import Engine
touch = Engine("paper-plane").step(position=[0.0, 0.0, 0.0095], orientation=[1.0, 0.0, 0.0, 0.0])
print(touch.force.tolist())
"""


def rendered(package: Path) -> str:
    environment = os.environ | {"PYTHONPATH": str(package.parent), "NUMBA_DISABLE_JIT": "1"}
    process = run_program([sys.executable, "-c", RENDERED], env=environment, check=True)
    return process.stdout


@pytest.mark.sampled(1)
@pytest.mark.parametrize("room", ["heightmap", "mesh"])
def test_the_plane_is_rendered_without_another_shape(tmp_path: Path, room: str) -> None:
    package = tmp_path / "softfinger"
    for folder in ("config", "drivers", "proxy", "server", "tools"):
        shutil.copytree(ROOT / folder, package / folder, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "config" / "package.py", package / "__init__.py")
    whole = rendered(package)
    shapes = package / "proxy" / "kernels" / "shapes"
    shutil.rmtree(shapes / room)
    table = (shapes / "__init__.py").read_text("utf-8")
    (shapes / "__init__.py").write_text(table.replace(f" {room},", "", 1).replace(f'    "{room}",\n', "", 1), "utf-8")
    assert rendered(package) == whole
