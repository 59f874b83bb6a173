"""Rigid bodies that a simulation moves: where they are, what the fingers do to them, and its next step.

The simulation is MuJoCo's, called by the addresses of its C functions on the memory of its model and its data: no
interpreter lock, and no allocation. A tick goes: poses as they are now; contact of all fingers; minus each contact's
wrench onto the body that it is on; then, behind the devices' writes, the step. So poses are fresh and nothing is a
step late, which bodies of less than 100 g would not bear.
"""

from typing import Any, Final

from numba import types

from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.dispatch import by_count, by_type
from softfinger.proxy.kernels.jit.foreign import call_void
from softfinger.proxy.kernels.jit.memory import float64_at, int32_at
from softfinger.proxy.kernels.jit.seqlock import Slot, store
from softfinger.proxy.kernels.model import Bodies, Pose, Vec3
from softfinger.proxy.kernels.numerics import vec3

# Words of a block (int64): handles and functions, then addresses of what the simulation has for each body.
MODEL: Final = 0
DATA: Final = 1
FIRST_HALF: Final = 2
"""mj_step1: positions, velocities and what follows from them."""
SECOND_HALF: Final = 3
"""mj_step2: forces, accelerations and the next state."""
POSITION: Final = 4
"""xpos (bodies, 3) m and xquat (bodies, 4): its frame in the world."""
ORIENTATION: Final = 5
MASS_CENTER: Final = 6
"""xipos (bodies, 3) m."""
WRENCH: Final = 7
"""xfrc_applied (bodies, 6): force, N, and torque about the centre of mass, N m, in the world's frame."""
WARNINGS: Final = 8
"""The first of WARNING_COUNT counters (int32), each WARNING_BYTES behind the one before."""
WARNING_COUNT: Final = 9
WARNING_BYTES: Final = 10
SUBSTEPS: Final = 11
"""Steps in a tick."""
VELOCITY: Final = 12
"""cvel (bodies, 6): rad/s, and m/s of the point of the body at TREE_CENTER."""
TREE_CENTER: Final = 13
"""subtree_com (bodies, 3) m; TREE_ROOT, body_rootid (bodies,) int32, is the row that is a body's."""
TREE_ROOT: Final = 14
MOVING: Final = 15
"""How many bodies can move."""
BLOCK_SIZE: Final = 16

MOTION_SIZE: Final = 13
"""Numbers that tell of a body's motion: position (3,) m, orientation w, x, y, z, velocity (3,) m/s, rate (3,) rad/s."""


LOG_ERROR: Final = 3
"""Level of a message (mjtLogLevel), its first int32."""
_pause: Any = types.ExternalFunction("pause", types.int32())


@c_function(types.void(types.int64), on_demand=True)
def park_on_error(message: int) -> None:
    """Handler of MuJoCo's messages: a warning is passed over, for it is counted; behind an error it may not return."""
    while int32_at(message)[0] == LOG_ERROR:
        _pause()


@jit
def pose_of_body(block: Any, body: float) -> Pose:
    """Frame of a body in the world, now."""
    x, q = float64_at(block[POSITION]), float64_at(block[ORIENTATION])
    i, j = 3 * int(body), 4 * int(body)
    return Pose((x[i], x[i + 1], x[i + 2]), (q[j], q[j + 1], q[j + 2], q[j + 3]))


@jit
def push_bodies(bodies: Bodies, contacts: Any, fingers: Any) -> None:
    """Let minus the wrenches of all contacts act on the bodies, in place of those of the last step.

    contacts  a Contact for each finger
    fingers   a FingerState for each
    """
    wrench = float64_at(bodies.block[WRENCH])
    for rider in bodies.riders:
        at = 6 * int(rider)
        for i in range(6):
            wrench[at + i] = 0.0
    push_by_fingers(contacts, fingers, bodies)


@by_count
def push_by_fingers(contacts: Any, fingers: Any, bodies: Bodies) -> None:
    """Take the wrench of each contact from what acts on the body that it is on."""


@push_by_fingers.of(1)
def push_by_one_finger(contacts: Any, fingers: Any, bodies: Bodies) -> None:
    for contact in contacts[0].contacts:
        if contact.object >= 0.0:
            body = int(bodies.riders[int(contact.object)])
            if body > 0:
                push(bodies.block, body, contact.force, contact.torque, fingers[0].probe.position)


@push_by_fingers.of(2)
def push_by_several_fingers(contacts: Any, fingers: Any, bodies: Bodies) -> None:
    push_by_fingers(contacts[:1], fingers[:1], bodies)
    push_by_fingers(contacts[1:], fingers[1:], bodies)


@jit
def push(block: Any, body: int, force: Vec3, torque: Vec3, center: Vec3) -> None:
    """Take a wrench about `center` (3,) m, that a body exerts, from what acts on it."""
    wrench, mass = float64_at(block[WRENCH]), float64_at(block[MASS_CENTER])
    origin = (mass[3 * body], mass[3 * body + 1], mass[3 * body + 2])
    about = vec3.add(torque, vec3.cross(vec3.sub(center, origin), force))
    at = 6 * body
    for i in range(3):
        wrench[at + i] -= force[i]
        wrench[at + 3 + i] -= about[i]


@jit
def move_bodies(bodies: Any, tick: int, slot: Slot, scratch: Any) -> Any:
    """`step_bodies` behind a tick, and `tell_motion` of it."""
    warned = step_bodies(bodies)
    tell_motion(bodies, tick, slot, scratch)
    return warned


@by_type
def tell_motion(bodies: Any, tick: int, slot: Slot, scratch: Any) -> None:
    """Let others read where the bodies that can move are, and how fast: after the tick's number MOTION_SIZE each.

    scratch  (1 + MOTION_SIZE * n,)
    """


@tell_motion.of(None)
def tell_nothing(bodies: None, tick: int, slot: Slot, scratch: Any) -> None:
    pass


@tell_motion.of(Bodies)
def tell_motion_of_bodies(bodies: Bodies, tick: int, slot: Slot, scratch: Any) -> None:
    block = bodies.block
    twist, centers, roots = float64_at(block[VELOCITY]), float64_at(block[TREE_CENTER]), int32_at(block[TREE_ROOT])
    scratch[0] = tick
    for i in range(block[MOVING]):
        body, at = bodies.moving[i], 1 + MOTION_SIZE * i
        x, q = pose_of_body(block, float(body))
        root, v = 3 * roots[body], 6 * body
        rate = (twist[v], twist[v + 1], twist[v + 2])
        arm = vec3.sub(x, (centers[root], centers[root + 1], centers[root + 2]))
        velocity = vec3.add((twist[v + 3], twist[v + 4], twist[v + 5]), vec3.cross(rate, arm))
        for k in range(4):
            scratch[at + 3 + k] = q[k]
        for k in range(3):
            scratch[at + k] = x[k]
            scratch[at + 7 + k] = velocity[k]
            scratch[at + 10 + k] = rate[k]
    store(slot, scratch)


@by_type
def step_bodies(bodies: Any) -> Any:
    """The next state of all bodies; returns how often (int) the simulation has warned since it began: of numbers that
    are none, of memory that is full."""


@step_bodies.of(None)
def step_no_bodies(bodies: None) -> int:
    return 0


@step_bodies.of(Bodies)
def step_all_bodies(bodies: Bodies) -> int:
    block = bodies.block
    handles = (block[MODEL], block[DATA])
    call_void(block[SECOND_HALF], handles)
    call_void(block[FIRST_HALF], handles)
    warned = 0
    for i in range(block[WARNING_COUNT]):
        warned += int32_at(block[WARNINGS] + i * block[WARNING_BYTES])[0]
    return warned
