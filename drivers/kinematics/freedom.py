"""What a device of one or two degrees of freedom has of a scene: the line or the plane it moves in."""

from __future__ import annotations

from softfinger.drivers.kinematics.options import Kinematics, Paddle, Pantograph
from softfinger.drivers.mounting import Mounting
from softfinger.proxy.kernels.numerics.rotations import rotate


def freedom_rows(kinematics: Kinematics | None, mounting: Mounting) -> list[tuple[str, str]]:
    """For `softfinger check`: a row for fewer than three degrees of freedom, else none."""
    if not isinstance(kinematics, Paddle | Pantograph):
        return []
    _, turned = mounting.frame()
    if isinstance(kinematics, Paddle):
        where = (
            f"on an arc, in its middle along ({_axis(*rotate(turned, (1.0, 0.0, 0.0)))}) of the world; forces across it"
        )
    else:
        where = f"in the plane across ({_axis(*rotate(turned, (0.0, 0.0, 1.0)))}) of the world; forces out of it"
    return [("  moves", f"{where} are shown, not displayed")]


def _axis(*components: float) -> str:
    return ", ".join(f"{round(value, 2) + 0.0:.2f}" for value in components)
