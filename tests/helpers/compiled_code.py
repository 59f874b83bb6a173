"""Read the LLVM module of a compiled kernel."""

import re
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np

from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.jit.decorators import OPTIONS
from softfinger.proxy.kernels.jit.pack import flatten, pack, unpack
from softfinger.proxy.kernels.step import step
from softfinger.proxy.scene import start_state

NUMBERS = {"fadd", "fsub", "fmul", "fdiv", "fneg", "fcmp", "frem"}


class Compiled(NamedTuple):
    """A step after optimisation.

    kernels     our kernels compiled into it, as module.name
    operations  count of each instruction
    calls       count of each called function, except the compiler's memory helpers
    """

    kernels: set[str]
    operations: Counter[str]
    calls: Counter[str]

    @property
    def arithmetic(self) -> int:
        return sum(count for name, count in self.operations.items() if name in NUMBERS) + sum(self.calls.values())


def functions(ir: str) -> dict[str, str]:
    """Return the bodies of the functions of an LLVM module, without numba's wrappers for Python."""
    bodies = {}
    for match in re.finditer(r'^define [^\n]*?@"?([^"(\s]+)"?\(.*?^}', ir, re.MULTILINE | re.DOTALL):
        if not match[1].startswith(("_ZN7cpython", "cfunc.")):
            bodies[match[1]] = match[0]
    return bodies


def called_in(body: str) -> Counter[str]:
    return Counter(re.findall(r'call [^@\n]*@"?([^"(\s]+)"?\(', body))


def tick(scene, values, start, state_values, position, orientation, dt, out):
    """Run one step with everything in flat arrays, as the servo does."""
    pose = model.Pose(position, orientation)
    state, contacts = step(unpack(scene, values), unpack(start, state_values), (pose,), dt)
    pack(state_values, state)
    pack(out, contacts[0])


def compile_step(scene: model.Scene) -> Compiled:
    start, some = start_state(scene), np.zeros(1)
    upright = start.fingers[0].probe.orientation
    arguments = (scene, flatten(scene), start, flatten(start), model.ZERO, upright, 0.001, some)
    dispatcher: Callable[..., Any] = numba.njit(**OPTIONS)(tick)
    dispatcher.compile(tuple(numba.typeof(a) for a in arguments))
    (ir,) = dispatcher.inspect_llvm().values()
    return read(ir)


def read(ir: str) -> Compiled:
    """Read the module of one step, with its callees all inlined into one function."""
    (body,) = functions(ir).values()
    operations = Counter(re.findall(r"^  (?:%\S+ = )?(?:tail call|(\w+))", body, re.MULTILINE))
    helpers = ("llvm.mem", "llvm.stack", "llvm.fabs")
    calls = Counter({name: count for name, count in called_in(body).items() if not name.startswith(helpers)})
    return Compiled(kernels_in(ir), operations, calls)


def kernels_in(ir: str) -> set[str]:
    """Return our kernels that have an environment in the module, as every compiled function has."""
    names = set()
    for mangled in re.findall(r'^@"?_ZN08NumbaEnv(\S+)', ir, re.MULTILINE):
        parts, rest = [], mangled
        while match := re.match(r"\d+", rest):
            end = match.end() + int(match[0])
            parts.append(rest[match.end() : end])
            rest = rest[end:]
        if parts[:3] == ["softfinger", "proxy", "kernels"]:
            names.add(".".join(parts[3:]))
    return names
