"""Search of the largest stable stiffness of a wall, with the real servo step in closed loop with a simulated device.

A constant force presses a frictionless plane so deep that contact is never lost and damping never reaches its bounds
(f_N between 0 and 2 K delta). The loop is then linear if the device is. The handle is knocked, and the loop is unstable
if the following swing grows. Search and ticks are one compiled function, which runs many cases without the GIL.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite, pi, sqrt
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from softfinger.drivers.simulated.plant import (
    DELAY_LINE_SIZE,
    Handle,
    Impedance,
    Plant,
    PlantState,
    advance,
    make_plant,
    sense,
)
from softfinger.proxy.kernels.jit.compiler.progress import COMPILE_PROGRESS
from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.kernels.jit.pack import flatten, unpack
from softfinger.proxy.kernels.model import (
    ConstantForce,
    Coupling,
    Finger,
    LinearNormal,
    Material,
    Object,
    Plane,
    Scene,
    Single,
    SmoothSearch,
)
from softfinger.server.loop.clock import NS_PER_S, compute_period_ns
from softfinger.server.loop.guard import Guard
from softfinger.server.loop.hand_limits import UNLIMITED
from softfinger.server.loop.passivity import Passivity
from softfinger.server.loop.servo_thread import require_machine_code
from softfinger.server.loop.tick import Memory, Tuning, make_start_memory, run_tick
from softfinger.server.offline.closed_loop import NULL_RECORD
from softfinger.server.progress import show_progress
from softfinger.tools.measure import Array
from softfinger.tools.options import CaseOptions
from softfinger.tools.stability.predicted import LinearLoop, compute_passive_limit, find_linear_limit

RADIUS_M: Final = 0.01
KNOCK_M: Final = 1e-4
"""Amplitude that the knock gives an undamped handle, m."""
KNOCK_STEPS: Final = 20.0
"""The same in encoder steps, at least, so that their effect is small in comparison."""
UNSTABLE_GROWTH: Final = 30.0
"""A swing that has grown by this factor shows that the wall is unstable."""
MIN_SWING: Final = 1e-9
"""Fraction of the knock's speed below which the swing is over; rounding is at 1e-13."""
LIMIT_CYCLE: Final = 1.0
"""The same with encoder steps: a swing of a few steps never ends, and is unstable only if it exceeds the knock."""
DEPTH_KNOCKS: Final = 100.0
"""Depth of the equilibrium in knocks, at least, so that a swing of UNSTABLE_GROWTH remains in contact."""
WEIGHT_MAX_N: Final = 1e5
"""Heaviest weight that presses the wall; if more were needed, the knock is smaller. Effects end at 1e6 N."""
COARSE_SWINGS: Final = 16.0
FINE_SWINGS: Final = 64.0
"""Swings of the handle in a trial: until the limit is bracketed, and while it is bisected."""
TICKS_MIN: Final = 2_000.0
TICKS_MAX: Final = 1_000_000.0
SCAN_FACTOR: Final = 1.3
"""Factor by which the stiffness increases until the wall is unstable for the first time."""
PRECISION: Final = 1e-4
"""Relative width at which the bisection ends."""
MIN_STIFFNESS_SHARE: Final = 1e-6
"""Fraction of the first stiffness at which softening ends, with a limit of 0."""
MAX_STIFFNESS: Final = 1e12
"""A wall of this stiffness in N/m that is stable ends the search: a million times the limit of a scene."""


class WallCase(CaseOptions, frozen=True, kw_only=True):
    @property
    def period_s(self) -> float:
        """Length of a tick, rounded to ns as in the servo."""
        return compute_period_ns(self.rate_hz) / NS_PER_S

    def linear(self) -> LinearLoop:
        return LinearLoop(
            self.mass_kg + self.hand_mass_kg,
            self.damping_ns_per_m,
            self.wall_damping_ns_per_m,
            self.period_s,
            self.delay_ticks,
            self.velocity_time_constant_s,
            self.hand_stiffness_n_per_m,
            self.hand_damping_ns_per_m,
        )

    def plant(self) -> Plant:
        handle = Handle(
            mass=(self.mass_kg,) * 3,
            damping=(self.damping_ns_per_m,) * 3,
            friction=(self.friction_n,) * 3,
            delay=self.delay_ticks,
            resolution=self.resolution_m,
        )
        hand = Impedance(self.hand_mass_kg, self.hand_damping_ns_per_m, self.hand_stiffness_n_per_m)
        return make_plant(self.period_s, handle, hand)


class TrialParameters(NamedTuple):
    """Parameters of a trial in addition to the plant.

    damping, velocity_time_constant, passivity_damping  N s/m, s, N s/m
    period                           s
    mass, hand_stiffness             kg, N/m   device and hand
    knock                            m         amplitude that the knock gives an undamped handle
    floor                                      fraction of the knock's speed below which a swing is over
    first                            N/m       first stiffness of the search
    ticks                                      0 to search; else one trial at the first stiffness, of so many ticks
                                               or, with -1, of FINE_SWINGS swings
    """

    damping: float
    velocity_time_constant: float
    passivity_damping: float
    period: float
    mass: float
    hand_stiffness: float
    knock: float
    floor: float
    first: float
    ticks: float


def make_wall_and_weight(
    stiffness: float, damping: float, velocity_time_constant: float, passivity_damping: float, depth: float
) -> Tuning:
    """Return a plane and the weight that presses `depth` m into it, balanced at the origin, with an unlimited guard."""
    material = Material(LinearNormal(stiffness, damping), None, None, None)
    shape = Plane((0.0, 0.0, 1.0), depth - RADIUS_M)
    wall = Object(  # all fields, since a kernel does not know the defaults of a tuple
        shape=shape, pose=None, motion=None, material=material, scene_index=0.0, last_pose=None, texture=None
    )
    weight = ConstantForce((0.0, 0.0, -stiffness * depth), None)
    finger = Finger(RADIUS_M, Coupling(1.0, 0.0, 0.0), 1.0, velocity_time_constant, 0.0, None, None)
    scene = Scene(
        fingers=(finger,),
        objects=Single(wall, (), SmoothSearch(0.0)),
        rolling=None,
        effects=(weight,),
        bodies=None,
        elastic=None,
    )
    # The observer is always present; with a largest damping of 0 it does not change the force.
    return Tuning(
        scene,
        (Guard(inf, inf, inf, inf, 0.0, 1.0, inf, inf, 0.0, 1.0, UNLIMITED),),
        Passivity(passivity_damping),
        (None,),
    )


pressed_wall: Final = jit(make_wall_and_weight)
START: Final = make_start_memory(make_wall_and_weight(1.0, 0.0, 0.0, 0.0, 1.0).scene)
"""Memory before the first tick, the same for every wall."""


@jit
def does_grow(
    loop: TrialParameters, start: Memory, plant: Plant, stiffness: float, swings: float, line: Array
) -> tuple[bool, float]:
    """Return whether a knock grows, and the number of ticks until the decision.

    The squared velocity is summed over the second and the last third of the trial with a window that is 0 and flat at
    its ends, (u (1 - u))^2. With this window a swing of constant amplitude gives equal sums to about 1e-6 for any
    phase. Fast modes decay in the first third. A swing that has decreased to `loop.floor` is over: the remainder is
    rounding, or the limit cycle of the encoder.
    """
    # Natural frequency of the handle on the wall, rad per tick, at most an eighth of a turn.
    natural = min(sqrt((stiffness + loop.hand_stiffness) / loop.mass) * loop.period, 0.25 * pi)
    ticks = loop.ticks if loop.ticks > 0.0 else max(TICKS_MIN, min(TICKS_MAX, swings * 2.0 * pi / natural)) // 1.0
    # v_k T is at most 2 UNSTABLE_GROWTH knocks: the damper's force is below K delta, and f_N between 0 and 2 K delta.
    deep = max(DEPTH_KNOCKS, 3.0 * UNSTABLE_GROWTH * loop.damping / (stiffness * loop.period))
    knock = min(loop.knock, WEIGHT_MAX_N / (stiffness * deep))
    depth = knock * deep
    tuning = pressed_wall(stiffness, loop.damping, loop.velocity_time_constant, loop.passivity_damping, depth)
    zero, upright = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
    state = PlantState(zero, (0.0, 0.0, knock * natural / loop.period), zero, zero, upright, 0.0)
    memory, third = start, ticks / 3.0
    # Sum of a steady swing: half its squared speed, times the integral 1 / 630 of the window squared.
    over = 0.5 * (loop.floor * knock * natural / loop.period) ** 2 * third / 630.0
    before, after = 0.0, 0.0
    for i in range(line.shape[0]):
        line[i] = 0.0
    for k in range(int(ticks)):
        x, y, z = sense(plant, state)
        sample: Any = (x, y, z, 1.0, 0.0, 0.0, 0.0)
        memory = run_tick(tuning, start, memory, (sample,), loop.period, loop.period, k, (NULL_RECORD,))
        state = advance(plant, state, memory.fingers[0].guard_state.force, zero, upright, line)
        if not abs(state.position[2]) < UNSTABLE_GROWTH * knock:
            return True, k + 1.0
        u = (k + 0.5) / third - 1.0
        speed = state.velocity[2]
        if u >= 1.0:
            u -= 1.0
            after += (u * (1.0 - u) * speed) ** 2
        elif u >= 0.0:
            before += (u * (1.0 - u) * speed) ** 2
    return not after <= max(before, over), ticks


@jit
def find_limit(loop: TrialParameters, start: Memory, plant: Plant, line: Array) -> tuple[float, float, float]:
    """Return the stiffness, N/m, at which a wall of increasing stiffness first becomes unstable; and trials and ticks.

    With `loop.ticks`, run one trial at the first stiffness and return that stiffness if it is stable, else 0.

    The stiffness decreases from the first one until it is stable or increases until it is unstable, then it is
    bisected. A window of instability narrower than SCAN_FACTOR, followed by stability, would be missed. The limit is 0
    if no wall is stable down to MIN_STIFFNESS_SHARE, and inf if none is unstable up to MAX_STIFFNESS, as when friction
    stops the knock at once.
    """
    low, high, stiffness, trials, total = 0.0, inf, loop.first, 0.0, 0.0
    while True:
        swings = COARSE_SWINGS if loop.ticks == 0.0 and (low == 0.0 or high == inf) else FINE_SWINGS
        unstable, ticks = does_grow(loop, start, plant, stiffness, swings, line)
        trials, total = trials + 1.0, total + ticks
        if unstable:
            high = stiffness
        else:
            low = stiffness
        if loop.ticks != 0.0:
            return low, trials, total
        if low == 0.0:
            stiffness = high / 2.0
            if stiffness < MIN_STIFFNESS_SHARE * loop.first:
                return 0.0, trials, total
        elif high == inf:
            stiffness = low * SCAN_FACTOR
            if stiffness > MAX_STIFFNESS:
                return inf, trials, total
        elif high - low <= PRECISION * low:
            return low, trials, total
        else:
            stiffness = sqrt(low * high)


@entry
def store_limits(start: Memory, loops: Array, plants: Array, like: Any, line: Array, out: Array) -> None:
    """Store `find_limit` of each row of `loops` (n, 10) and `plants` (n, leaves of Plant) in `out` (n, 3)."""
    for i in range(loops.shape[0]):
        row = loops[i]
        loop = TrialParameters(row[0], row[1], row[2], row[3], row[4], row[5], row[6], row[7], row[8], row[9])
        out[i, 0], out[i, 1], out[i, 2] = find_limit(loop, start, unpack(like, plants[i]), line)


def choose_first_stiffness(case: WallCase) -> float:
    """Return the first stiffness of the search, N/m: an eighth of the passivity bound with all damping, if any."""
    damping = case.damping_ns_per_m + case.wall_damping_ns_per_m + case.hand_damping_ns_per_m
    if damping == 0.0:
        return 1e-6 * case.mass_kg / case.period_s**2
    return damping / (4.0 * (2 * case.delay_ticks + 1) * case.period_s)


def run_rows(loops: Array, plants: Array, like: Plant) -> Array:
    """Return `find_limit` (n, 3) of each row of `loops` (n, 10) with the plant of leaves `plants` (n, ...)."""
    out = np.zeros((len(loops), 3))
    store_limits(START, loops, plants, like, np.zeros(DELAY_LINE_SIZE), out)
    return out


def loop_of(case: WallCase, first: float, ticks: int = 0) -> TrialParameters:
    """Return the kernel's row for a case: a search from stiffness `first` (N/m), or one trial (see `ticks`)."""
    over = LIMIT_CYCLE if case.resolution_m > 0.0 else MIN_SWING
    return TrialParameters(
        case.wall_damping_ns_per_m, case.velocity_time_constant_s, case.passivity_damping_ns_per_m, case.period_s,
        case.mass_kg + case.hand_mass_kg, case.hand_stiffness_n_per_m,
        max(KNOCK_M, KNOCK_STEPS * case.resolution_m), over, first, float(ticks),
    )  # fmt: skip


def find_limits(cases: Sequence[WallCase]) -> list[dict[str, Any]]:
    """Return for each case its values, the limit found, the theoretical limits, and the effort of the search.

    `limit_n_per_m` is found on the real step, None without limit. `predicted_n_per_m` is the exact limit of the linear
    part. `passive_n_per_m` is the passivity bound.
    """
    loops = np.array([loop_of(case, choose_first_stiffness(case)) for case in cases])
    plants = [case.plant() for case in cases]
    out = run_rows(loops, np.array([flatten(plant) for plant in plants]), plants[0])
    return [
        {
            **msgspec.structs.asdict(case),
            "limit_n_per_m": limit if isfinite(limit) else None,
            "predicted_n_per_m": find_linear_limit(case.linear()),
            "passive_n_per_m": compute_passive_limit(case.linear()),
            "trials": int(trials),
            "ticks": int(ticks),
        }
        for case, (limit, trials, ticks) in zip(cases, out.tolist(), strict=True)
    ]


KERNELS: Final = 210
"""Kernels that the search compiles with an empty cache: rounded up (203)."""


def compile_search() -> None:
    """Compile the search, or load it, once, so that the processes of a local cluster find it compiled."""
    require_machine_code("the search")
    COMPILE_PROGRESS.expect(KERNELS)
    with show_progress("kernels"):
        plant = WallCase().plant()
        run_rows(np.array([loop_of(WallCase(), 1.0, 1)]), flatten(plant).reshape(1, -1), plant)


def does_grow_at(case: WallCase, stiffness: float) -> bool:
    """Return whether a knock grows on a wall of one stiffness, N/m: a single trial of the search."""
    plant = case.plant()
    return bool(run_rows(np.array([loop_of(case, stiffness, -1)]), flatten(plant).reshape(1, -1), plant)[0, 0] == 0.0)
