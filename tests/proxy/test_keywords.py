"""Named tuples with many values are built by keyword, because swapped positions are easily overlooked."""

import ast
from functools import cache
from pathlib import Path

import numba
import pytest

from softfinger.proxy.kernels.model import FrictionInput

KERNELS = Path(__file__).parents[2] / "proxy" / "kernels"
BY_POSITION_MAX = 6
"""Number of values that are readable by position: two points, or three weights with their values."""


@cache
def nodes(path, kind):
    tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    return [node for node in ast.walk(tree) if isinstance(node, kind)]


@cache
def named_tuples():
    classes = (node for path in sorted(KERNELS.rglob("*.py")) for node in nodes(path, ast.ClassDef))
    return {node.name for node in classes if any(ast.unparse(base) == "NamedTuple" for base in node.bases)}


@pytest.mark.plain
@pytest.mark.parametrize("path", sorted(KERNELS.rglob("*.py")), ids=lambda path: str(path.relative_to(KERNELS)))
def test_long_tuples_are_built_by_keyword(path):
    known = named_tuples()
    built = [call for call in nodes(path, ast.Call) if isinstance(call.func, ast.Name) and call.func.id in known]
    assert [f"line {call.lineno}: {call.func.id}" for call in built if len(call.args) > BY_POSITION_MAX] == []


def test_keywords_cost_nothing():
    """A kernel that builds a tuple by keyword compiles to the instructions of one that builds it by position."""
    names = FrictionInput._fields

    def code(call):
        scope = {"Patch": FrictionInput}
        exec(f"def build(x):\n    return Patch({call})", scope)
        kernel = numba.njit(scope["build"])
        kernel.compile((numba.float64,))
        (text,) = kernel.inspect_asm().values()
        return [line.split()[0] for line in text.splitlines() if line.startswith("\t") and line[1] not in ".#"]

    values = [f"x + {number}.0" for number in range(len(names))]
    by_keyword = [f"{name}={value}" for name, value in zip(names, values, strict=True)]
    assert code(", ".join(by_keyword)) == code(", ".join(values))
