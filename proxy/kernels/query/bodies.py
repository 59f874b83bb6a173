"""Rigid bodies that a simulation moves: where they are, what the fingers do to them, and its next step.

The simulation is MuJoCo's, called by the addresses of its C functions on the memory of its model and its data: no
interpreter lock, and no allocation. A tick goes: poses as they are now; contact of all fingers; minus each contact's
wrench onto the body that it is on; then, behind the devices' writes, the step. So poses are fresh and nothing is a
step late, which bodies of less than 100 g would not bear.

A step that fails is a fault of the bodies, not of the run: they stand still, and nothing is touched, until they begin
again.
"""

from typing import Any, Final

from softfinger.proxy.kernels.jit.decorators import PLAIN, jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.memory import float64_at, int32_at, int64_at
from softfinger.proxy.kernels.jit.rescue import rescued
from softfinger.proxy.kernels.jit.seqlock import Slot, store
from softfinger.proxy.kernels.jit.tuples import map_each
from softfinger.proxy.kernels.model import Bodies, Contact, ContactOutcome, FingerState, Pose, Vec3
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
FAULT: Final = 16
"""Two int64 that change: the fault, NO_FAULT to SLOW, and by how many more steps took too long than did not."""
RESCUE: Final = 17
"""Memory of `rescued`."""
BUDGET_NS: Final = 18
"""How long a step may take, ns; 0 for any time."""
LAST_POSITION: Final = 19
LAST_ORIENTATION: Final = 20
"""POSITION and ORIENTATION before the last step, of the bodies that can move."""
BLOCK_SIZE: Final = 21

SLOW_STEPS: Final = 20
"""A step that was interrupted comes alone; a model that is too large takes too long in more than half of its steps."""

MOTION_SIZE: Final = 13
"""Numbers that tell of a body's motion: position (3,) m, orientation w, x, y, z, velocity (3,) m/s, rate (3,) rad/s."""


NO_FAULT: Final = 0
WARNED: Final = 1
"""MuJoCo has warned since it began: of numbers that are none, of memory that is full."""
ERROR: Final = 2
"""MuJoCo met an error, which would have ended the process; its words are in the memory of RESCUE."""
SLOW: Final = 3
"""Steps took more time than they may."""


@jit
def pose_of_body(block: Any, body: float) -> Pose:
    """Frame of a body in the world, now."""
    return frame_in(float64_at(block[POSITION]), float64_at(block[ORIENTATION]), int(body))


@jit
def last_pose_of_body(block: Any, body: float) -> Pose:
    """Frame of a body in the world before the last step; only of one that can move."""
    return frame_in(float64_at(block[LAST_POSITION]), float64_at(block[LAST_ORIENTATION]), int(body))


@jit
def frame_in(x: Any, q: Any, body: int) -> Pose:
    i, j = 3 * body, 4 * body
    return Pose((x[i], x[i + 1], x[i + 2]), (q[j], q[j + 1], q[j + 2], q[j + 3]))


@jit
def push_bodies(bodies: Bodies, contacts: Any, fingers: Any) -> None:
    """Let minus the wrenches of all contacts act on the bodies, in place of those of the last step.

    contacts  a Contact for each finger
    fingers   a FingerState for each
    """
    wrench = float64_at(bodies.block[WRENCH])
    for k in range(int(bodies.objects)):
        at = 6 * int(bodies.riders[k])
        for i in range(6):
            wrench[at + i] = 0.0
    map_each(push_by_finger, (contacts, fingers), bodies)


@jit
def push_by_finger(contact: Contact, finger: FingerState, bodies: Bodies) -> None:
    """Take the wrenches of a finger's contacts from what acts on the bodies that they are on."""
    map_each(push_by_contact, (contact.contacts,), finger.probe.position, bodies)


@jit
def push_by_contact(contact: ContactOutcome, center: Vec3, bodies: Bodies) -> None:
    if contact.object >= 0.0:
        body = int(bodies.riders[int(contact.object)])
        if body > 0:
            push(bodies.block, body, contact.force, contact.torque, center)


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
    """The next state of all bodies; returns their fault, NO_FAULT while there is none. With one they stand still."""


@step_bodies.of(None)
def step_no_bodies(bodies: None) -> int:
    return NO_FAULT


@step_bodies.of(Bodies)
def step_all_bodies(bodies: Bodies) -> int:
    block = bodies.block
    fault = int64_at(block[FAULT])
    if fault[0] == NO_FAULT:
        keep_poses(bodies)
        fault[0] = step_half(block, SECOND_HALF)
    if fault[0] == NO_FAULT:
        fault[0] = step_half(block, FIRST_HALF)
    return int(fault[0])


@jit
def keep_poses(bodies: Bodies) -> None:
    """Frames of now become those before the last step."""
    block = bodies.block
    x, q = float64_at(block[POSITION]), float64_at(block[ORIENTATION])
    last_x, last_q = float64_at(block[LAST_POSITION]), float64_at(block[LAST_ORIENTATION])
    for i in range(block[MOVING]):
        body = bodies.moving[i]
        for k in range(3):
            last_x[3 * body + k] = x[3 * body + k]
        for k in range(4):
            last_q[4 * body + k] = q[4 * body + k]


@jit
def step_half(block: Any, half: int) -> int:
    """FIRST_HALF or SECOND_HALF of a step; returns the fault that it met."""
    if call_half(block, half) != 0:
        return ERROR
    for i in range(block[WARNING_COUNT]):
        if int32_at(block[WARNINGS] + i * block[WARNING_BYTES])[0] != 0:
            return WARNED
    return NO_FAULT


def _call_by_binding(block: Any, half: int) -> int:
    """As plain Python: MuJoCo's own package has a way back of its own."""
    return int(block.owner.step_half(half))


def _call_by_address(block: Any, half: int) -> int:
    return rescued(block[half], block[MODEL], block[DATA], block[RESCUE])


call_half: Any = _call_by_binding if PLAIN else jit(_call_by_address)
"""Call a half of a step; 0, or 1 where MuJoCo met an error."""


@jit
def faulty(bodies: Bodies) -> bool:
    """Whether the bodies have a fault, and stand still until they begin again."""
    return bool(int64_at(bodies.block[FAULT])[0] != NO_FAULT)


@jit
def keep_to_budget(bodies: Bodies, took_ns: int) -> None:
    """Let the bodies have the fault SLOW once SLOW_STEPS more steps took longer than they may than did not.

    took_ns  of one step
    """
    block = bodies.block
    if block[BUDGET_NS] > 0:
        fault = int64_at(block[FAULT])
        fault[1] = max(fault[1] + (1 if took_ns > block[BUDGET_NS] else -1), 0)
        if fault[0] == NO_FAULT and fault[1] >= SLOW_STEPS:
            fault[0] = SLOW
