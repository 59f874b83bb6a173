"""Guard of a rig: limits on every force before it reaches the device, and arming."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec

from softfinger.config import limits
from softfinger.config.fields import Complaint, Table, doc, is_usable, within

_Coordinate = Annotated[float, msgspec.Meta(ge=limits.TOOL_M.low, le=limits.TOOL_M.high)]
_Edge = Annotated[float, msgspec.Meta(ge=limits.WORKSPACE_SIZE_M.low, le=limits.WORKSPACE_SIZE_M.high)]
HandlePosition = tuple[_Coordinate, _Coordinate, _Coordinate]
"""Position near the handle or its workspace, m."""


class Workspace(Table, frozen=True, kw_only=True):
    """Soft wall in front of the end stops: a sphere by `radius_m`, or a box by `size_m`."""

    center_m: Annotated[HandlePosition, doc("centre, in the device frame", [0.0, 0.0, 0.0])] = (0.0, 0.0, 0.0)
    radius_m: Annotated[float, within(limits.WORKSPACE_SIZE_M, "radius of the sphere", 0.07)] | None = None
    size_m: Annotated[tuple[_Edge, _Edge, _Edge], doc("edges of the box, along x, y and z", [0.1, 0.1, 0.1])] | None = (
        None
    )
    stiffness_n_per_m: Annotated[float, within(limits.WALL_STIFFNESS_N_PER_M, "stiffness of the wall", 500.0)] = 500.0
    force_max_n: Annotated[float, within(limits.FORCE_MAX_N, "largest force of the wall", 4.0)] = 4.0

    def faults(self) -> Iterator[Complaint]:
        if not is_usable(self.radius_m, self.size_m):
            return
        if self.radius_m is None and self.size_m is None:
            yield "radius_m", msgspec.UNSET, "is missing: give radius_m of a sphere, or size_m of a box"
        elif self.radius_m is not None and self.size_m is not None:
            yield "size_m", self.size_m, "cannot be combined with radius_m: give one of them"


Arming = Literal["automatic", "command", "button"]


class Guard(Table, frozen=True, kw_only=True):
    """Limits on every force before it reaches the device; limiting a norm preserves the direction."""

    arm: Annotated[
        Arming,
        doc(
            "arming of the force, at the start and after handle_speed_max_m_per_s: automatic: by the program, once "
            "the handle is slow; command: by softfinger ctl arm; button: by that or a button of the device",
            "automatic",
        ),
    ] = "automatic"

    force_max_n: Annotated[float, within(limits.FORCE_MAX_N, "largest norm of the force", 12.0)] = 12.0
    torque_max_nm: Annotated[float, within(limits.TORQUE_MAX_NM, "largest norm of the torque", 0.3)] = 0.3
    force_slew_n_per_s: Annotated[
        float, within(limits.FORCE_SLEW_N_PER_S, "largest rate of change of the force", 2000.0)
    ] = 2000.0
    torque_slew_nm_per_s: Annotated[
        float, within(limits.TORQUE_SLEW_NM_PER_S, "largest rate of change of the torque", 50.0)
    ] = 50.0
    ramp_s: Annotated[float, within(limits.RAMP_S, "time over which the force increases to its full value", 0.5)] = 0.5
    speed_max_m_per_s: Annotated[
        float, within(limits.SPEED_MAX_M_PER_S, "a faster motion counts as a jump: no force", 10.0)
    ] = 10.0
    turn_max_rad_per_s: Annotated[
        float, within(limits.TURN_MAX_RAD_PER_S, "a faster rotation counts as a jump: no force", 100.0)
    ] = 100.0
    frozen_s: Annotated[
        float, within(limits.FROZEN_S, "no force if the pose repeats bit for bit for this long; 0: no limit", 5.0)
    ] = 5.0
    handle_speed_max_m_per_s: Annotated[
        float, within(limits.HANDLE_SPEED_MAX_M_PER_S, "no force if the handle is faster, over 10 ms", 2.0)
    ] = 2.0
    continuous_force_n: (
        Annotated[
            float,
            within(
                limits.CONTINUOUS_FORCE_N,
                "continuous force of the motors; a larger force is reduced as they heat up; default: no limit",
                3.0,
            ),
        ]
        | None
    ) = None
    heat_time_s: Annotated[float, within(limits.HEAT_TIME_S, "thermal time constant of the motors", 30.0)] = 30.0
    energy_max_j: Annotated[
        float,
        within(
            limits.ENERGY_MAX_J, "energy that contacts may transfer to the hand; above it the force is reduced", 0.2
        ),
    ] = 0.2
    workspace: Annotated[Workspace | None, doc("soft wall in front of the end stops; default: none")] = None
