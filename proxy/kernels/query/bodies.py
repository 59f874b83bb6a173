"""Simulation of rigid bodies with MuJoCo: poses, reactions of the fingers, and the next step.

MuJoCo's C functions are called by address, on the memory of its model and data: without the interpreter lock and
without allocation. A tick has four stages: read the current poses; compute the contacts of all fingers; apply the
negative wrench of each contact to the touched body; and, after the output to the devices, step the simulation. So no
pose and no wrench is a step late. A delay of one step would make bodies of less than 100 g unstable.

A failed step is a fault of the bodies and does not end the run: the bodies do not move, and the fingers touch nothing,
until the simulation is reset.
"""

from typing import Any, Final

from softfinger.proxy.kernels.jit.decorators import PLAIN, jit
from softfinger.proxy.kernels.jit.memory import float64_at, int32_at, int64_at
from softfinger.proxy.kernels.jit.rescue import call_rescued
from softfinger.proxy.kernels.jit.tuples import map_each
from softfinger.proxy.kernels.model import Bodies, Contact, ContactOutcome, FingerState, Pose, Vec3
from softfinger.proxy.kernels.numerics import vec3

# Elements of a block (int64): handles and functions, then addresses of the arrays of the simulation.
MODEL: Final = 0
DATA: Final = 1
FIRST_HALF: Final = 2
"""Address of mj_step1: positions, velocities, and all quantities that depend on them."""
SECOND_HALF: Final = 3
"""Address of mj_step2: forces, accelerations, and the next state."""
POSITION: Final = 4
"""xpos (bodies, 3) m; ORIENTATION, the next element, is xquat (bodies, 4): frame of a body in the world."""
ORIENTATION: Final = 5
MASS_CENTER: Final = 6
"""xipos (bodies, 3) m."""
WRENCH: Final = 7
"""xfrc_applied (bodies, 6): force, N, and torque about the centre of mass, N m, in the world frame."""
WARNINGS: Final = 8
"""First of WARNING_COUNT counters (int32), at intervals of WARNING_BYTES."""
WARNING_COUNT: Final = 9
WARNING_BYTES: Final = 10
SUBSTEPS: Final = 11
"""Number of simulation steps in a tick."""
VELOCITY: Final = 12
"""cvel (bodies, 6): angular velocity, rad/s, and velocity of the body's point at TREE_CENTER, m/s."""
TREE_CENTER: Final = 13
"""subtree_com (bodies, 3) m; TREE_ROOT, body_rootid (bodies,) int32, is the row of a body's tree."""
TREE_ROOT: Final = 14
MOVING: Final = 15
"""Number of bodies that can move."""
FAULT: Final = 16
"""Two int64 that change: the fault, NO_FAULT to SLOW, and the excess of slow steps over fast ones, at least 0."""
RESCUE: Final = 17
"""Memory of `call_rescued`."""
BUDGET_NS: Final = 18
"""Largest duration of a step, ns; 0 for no limit."""
LAST_POSITION: Final = 19
LAST_ORIENTATION: Final = 20
"""xquat before the last step, and LAST_POSITION is xpos, of the bodies that can move."""
BLOCK_SIZE: Final = 21

SLOW_STEPS: Final = 20
"""Excess of slow steps over fast ones that is a fault. An interruption makes a single step slow; a model that is too
large makes more than half of the steps slow."""

MOTION_SIZE: Final = 13
"""Values of a body's motion: position (3,) m, quaternion, velocity (3,) m/s, angular velocity (3,) rad/s."""


NO_FAULT: Final = 0
WARNED: Final = 1
"""MuJoCo has issued a warning since the last reset: a value is not finite, or its memory is full."""
ERROR: Final = 2
"""MuJoCo had an error, which would have ended the process; its message is in the memory of RESCUE."""
SLOW: Final = 3
"""The steps take longer than BUDGET_NS."""


@jit
def read_body_pose(block: Any, body: float, positions: int) -> Pose:
    """Return the frame of a body in the world.

    positions  POSITION, or LAST_POSITION for the frame before the last step of a body that can move
    """
    x, q = float64_at(block[positions]), float64_at(block[positions + 1])
    i, j = 3 * int(body), 4 * int(body)
    return Pose((x[i], x[i + 1], x[i + 2]), (q[j], q[j + 1], q[j + 2], q[j + 3]))


@jit
def push_bodies(bodies: Bodies, contacts: Any, fingers: Any) -> None:
    """Replace the wrenches of the last step on the bodies by the negative wrenches of all contacts.

    contacts  a Contact for each finger
    fingers   a FingerState for each finger
    """
    wrench = float64_at(bodies.block[WRENCH])
    for k in range(int(bodies.objects)):
        first = 6 * int(bodies.attached[k])
        for i in range(6):
            wrench[first + i] = 0.0
    map_each(push_by_finger, (contacts, fingers), bodies)


@jit
def push_by_finger(contact: Contact, finger: FingerState, bodies: Bodies) -> None:
    """Subtract the wrenches of a finger's contacts from the wrenches applied to the touched bodies."""
    map_each(push_by_contact, (contact.contacts,), finger.probe.position, bodies)


@jit
def push_by_contact(contact: ContactOutcome, center: Vec3, bodies: Bodies) -> None:
    if contact.object >= 0.0:
        body = int(bodies.attached[int(contact.object)])
        if body > 0:
            push(bodies.block, body, contact.force, contact.torque, center)


@jit
def push(block: Any, body: int, force: Vec3, torque: Vec3, center: Vec3) -> None:
    """Subtract the wrench about `center` (3,) m that a body exerts from the wrench applied to it."""
    wrench, mass = float64_at(block[WRENCH]), float64_at(block[MASS_CENTER])
    origin = (mass[3 * body], mass[3 * body + 1], mass[3 * body + 2])
    about = vec3.add(torque, vec3.cross(vec3.sub(center, origin), force))
    first = 6 * body
    for i in range(3):
        wrench[first + i] -= force[i]
        wrench[first + 3 + i] -= about[i]


@jit
def write_motion(bodies: Bodies, tick: int, motion: Any) -> None:
    """Write the motion of the bodies that can move: the number of the tick, then MOTION_SIZE values for each body.

    motion  (1 + MOTION_SIZE * n,)  written, n the number of bodies that can move
    """
    block = bodies.block
    twist, centers, roots = float64_at(block[VELOCITY]), float64_at(block[TREE_CENTER]), int32_at(block[TREE_ROOT])
    motion[0] = tick
    for i in range(block[MOVING]):
        body, first = bodies.movable[i], 1 + MOTION_SIZE * i
        x, q = read_body_pose(block, float(body), POSITION)
        root, v = 3 * roots[body], 6 * body
        rate = (twist[v], twist[v + 1], twist[v + 2])
        arm = vec3.sub(x, (centers[root], centers[root + 1], centers[root + 2]))
        velocity = vec3.add((twist[v + 3], twist[v + 4], twist[v + 5]), vec3.cross(rate, arm))
        for k in range(4):
            motion[first + 3 + k] = q[k]
        for k in range(3):
            motion[first + k] = x[k]
            motion[first + 7 + k] = velocity[k]
            motion[first + 10 + k] = rate[k]


@jit
def step_bodies(bodies: Any) -> int:
    """Advance all bodies by one step and return their fault, or NO_FAULT. With a fault, the bodies do not move."""
    if bodies is None:
        return NO_FAULT
    block = bodies.block
    fault = int64_at(block[FAULT])
    if fault[0] == NO_FAULT:
        x, q = float64_at(block[POSITION]), float64_at(block[ORIENTATION])
        last_x, last_q = float64_at(block[LAST_POSITION]), float64_at(block[LAST_ORIENTATION])
        for i in range(block[MOVING]):
            body = bodies.movable[i]
            for k in range(3):
                last_x[3 * body + k] = x[3 * body + k]
            for k in range(4):
                last_q[4 * body + k] = q[4 * body + k]
        fault[0] = step_half(block, SECOND_HALF)
    if fault[0] == NO_FAULT:
        fault[0] = step_half(block, FIRST_HALF)
    return int(fault[0])


@jit
def step_half(block: Any, half: int) -> int:
    """Compute FIRST_HALF or SECOND_HALF of a step and return its fault, or NO_FAULT."""
    if PLAIN:  # MuJoCo's package converts an error to an exception
        failed = int(block.owner.step_half(half))
    else:
        failed = call_rescued(block[half], block[MODEL], block[DATA], block[RESCUE])
    if failed != 0:
        return ERROR
    for i in range(block[WARNING_COUNT]):
        if int32_at(block[WARNINGS] + i * block[WARNING_BYTES])[0] != 0:
            return WARNED
    return NO_FAULT


@jit
def has_fault(bodies: Bodies) -> bool:
    """Return True if the bodies have a fault: they do not move until the simulation is reset."""
    return bool(int64_at(bodies.block[FAULT])[0] != NO_FAULT)


@jit
def check_budget(bodies: Bodies, took_ns: int) -> None:
    """Set the fault SLOW if slow steps, longer than BUDGET_NS, exceed fast ones by SLOW_STEPS.

    took_ns  duration of one step
    """
    block = bodies.block
    if block[BUDGET_NS] > 0:
        fault = int64_at(block[FAULT])
        fault[1] = max(fault[1] + (1 if took_ns > block[BUDGET_NS] else -1), 0)
        if fault[0] == NO_FAULT and fault[1] >= SLOW_STEPS:
            fault[0] = SLOW
