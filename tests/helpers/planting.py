"""Find places for mistakes in a source file by rules, and plant them in the running process: see `tests/sweep.py`.

This is not mutmut or cosmic-ray: both expect a package in one folder, to which `.dev/` has only links, and both start
pytest for each mistake. That takes seconds, where a fork of a process with all imports takes a tenth. The code objects
of functions are replaced in place, so modules that have imported a function get the mistake as well.
"""

from __future__ import annotations

import ast
import gc
import inspect
import symtable
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, Final, NamedTuple

Functions = Mapping[tuple[str, str], list[FunctionType]]
"""Functions of the running process, by file and qualified name."""

_COMPARE: Final[dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
}  # fmt: skip
_ARITHMETIC: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Add, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
    ast.Pow: ast.Mult,
}  # fmt: skip
_EXCHANGED: Final = {"min": "max", "max": "min"}
_WORDS: Final = ("log.", "super().__init__(")
"""Beginnings of statements that are never removed: texts for people, and statements that return no object."""


class Mistake(NamedTuple):
    """File below the root; qualified name of the function, or of the constant of a module; text of the line, and its
    index among equal lines with this mistake in the file; description; position of the node in `ast.walk`, and of the
    rule."""

    file: str
    function: str
    line: str
    wrong: str
    repeat: int
    node: int
    rule: int

    @property
    def name(self) -> str:
        return f"{self.file} {self.function} | {self.line} | {self.wrong}" + (f" #{self.repeat}" if self.repeat else "")


Rule = tuple[str, Callable[[Any], ast.AST]]
"""Description of a mistake, and the changed or replaced node."""


def _with(**fields: Any) -> Callable[[Any], ast.AST]:
    def change(node: Any) -> ast.AST:
        for name, value in fields.items():
            setattr(node, name, value)
        return node  # type: ignore[no-any-return]

    return change


def _rules(node: ast.AST) -> Iterator[Rule]:
    source = ast.unparse(node) if isinstance(node, ast.expr | ast.AugAssign) else ""
    match node:
        case ast.Compare():
            for place, before in enumerate(node.ops):
                for after in _COMPARE[type(before)]:
                    ops = [after() if k == place else op for k, op in enumerate(node.ops)]
                    yield f"{source}: {type(before).__name__} -> {after.__name__}", _with(ops=ops)
        case ast.BinOp() | ast.AugAssign() if type(node.op) in _ARITHMETIC:
            operator = _ARITHMETIC[type(node.op)]
            yield f"{source}: {type(node.op).__name__} -> {operator.__name__}", _with(op=operator())
        case ast.BoolOp():
            either = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield f"{source}: {type(either).__name__}", _with(op=either)
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert()):
            yield f"{source}: without {type(node.op).__name__}", lambda n: n.operand
        case ast.Constant(value=bool(value)):
            yield f"{value} -> {not value}", _with(value=not value)
        case ast.Constant(value=int(value)):
            yield f"{value} -> {value + 1}", _with(value=value + 1)
        case ast.Constant(value=float(value)):
            yield f"{value} -> {2.0 * value or 1.0}", _with(value=2.0 * value or 1.0)
        case ast.Call(func=ast.Name(id="min" | "max" as name)):
            yield f"{source}: {_EXCHANGED[name]}", _with(func=ast.Name(_EXCHANGED[name], ast.Load()))
        case ast.Call(args=[ast.Name() | ast.Attribute(), ast.Name() | ast.Attribute()]):
            yield f"{source}: arguments swapped", _with(args=node.args[::-1])
    if isinstance(node, ast.If | ast.While | ast.IfExp) and isinstance(node.test, ast.Name | ast.Attribute | ast.Call):
        yield f"not {ast.unparse(node.test)}", _with(test=ast.UnaryOp(ast.Not(), node.test))
    left_out = isinstance(node, ast.AugAssign | ast.Raise | ast.Break | ast.Continue)
    left_out |= isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Attribute | ast.Subscript)
    left_out |= isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    if left_out and not ast.unparse(node).startswith(_WORDS):
        yield "removed", lambda n: ast.Pass()
    if (
        isinstance(node, ast.FunctionDef)
        and ast.unparse(node.returns or node) == "None"
        and not (isinstance(node.body[-1], ast.Expr) and isinstance(node.body[-1].value, ast.Constant))  # no body yet
    ):
        yield f"{node.name} returns at once", lambda n: _with(body=[ast.Return(None), *n.body])(n)


def _skipped(node: ast.AST) -> set[int]:
    """Return the nodes below a node that are no behaviour: annotations, defaults, decorators and texts."""
    out: list[ast.AST | None] = []
    if isinstance(node, ast.FunctionDef):
        arguments = node.args
        out = [node.returns, arguments, *node.decorator_list]
    elif isinstance(node, ast.AnnAssign):
        out = [node.annotation]
    elif isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Expr) and ast.unparse(node).startswith("log.")):
        out = [node]
    return {id(below) for part in out if part is not None for below in ast.walk(part)}


def _owners(tree: ast.Module) -> dict[int, str]:
    owners: dict[int, str] = {}

    def visit(node: ast.AST, prefix: str, owner: str) -> None:
        for child in ast.iter_child_nodes(node):
            inner, name = prefix, owner
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                name = f"{prefix}{child.name}" if isinstance(child, ast.FunctionDef) else ""
                inner = f"{prefix}{child.name}." + ("<locals>." if name else "")
            owners[id(child)] = name
            visit(child, inner, name)

    visit(tree, "", "")
    return owners


def mistakes_in(root: Path, file: str) -> Iterator[Mistake]:
    """Return all mistakes that the rules find in the functions of a file and in its numeric constants."""
    text = (root / file).read_text("utf-8")
    tree, lines, met = ast.parse(text), text.splitlines(), dict[tuple[str, str, str], int]()
    owners, skipped = _owners(tree), set[int]()
    for place, node in enumerate(ast.walk(tree)):
        skipped |= _skipped(node)
        if id(node) in skipped or not hasattr(node, "lineno"):
            continue
        owner, line = owners[id(node)], lines[node.lineno - 1].strip()
        for number, (wrong, _) in enumerate(_rules(node)):
            if owner:
                repeat = met[owner, line, wrong] = met.get((owner, line, wrong), -1) + 1
                yield Mistake(file, owner, line, wrong, repeat, place, number)
        if node in tree.body and isinstance(node, ast.AnnAssign):
            for number, wrong in enumerate(_constant_rules(node.value)):
                yield Mistake(file, ast.unparse(node.target), line, wrong, 0, place, number)


def _constant_rules(value: ast.expr | None) -> list[str]:
    match value:
        case ast.Dict():
            return [f"without {ast.unparse(key)}" for key in value.keys if key]
        case ast.Constant(value=int() | float()) | ast.BinOp():
            return ["twice as much, and 1"]
    return []


def functions_of(root: Path, files: set[str]) -> Functions:
    functions: dict[tuple[str, str], list[FunctionType]] = {}
    gc.unfreeze()  # conftest.py has frozen the imported objects, which `get_objects` omits
    for candidate in gc.get_objects():
        if isinstance(candidate, FunctionType):
            file = file_of(root, candidate.__code__)
            if file in files:
                functions.setdefault((file, candidate.__code__.co_qualname), []).append(candidate)
    gc.freeze()
    return functions


def file_of(root: Path, code: CodeType) -> str:
    """Return the file below the root that defines a code object, through the links in .dev; empty for others."""
    below = f"{root}/.dev/softfinger/"
    return code.co_filename.removeprefix(below) if code.co_filename.startswith(below) else ""


def plant(root: Path, mistake: Mistake, functions: Functions) -> None:
    tree = ast.parse((root / mistake.file).read_text("utf-8"))
    nodes = list(ast.walk(tree))
    node = nodes[mistake.node]
    if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == mistake.function:
        _plant_constant(mistake)
        return
    changed = list(_rules(node))[mistake.rule][1](node)
    if changed is not node:
        for parent in nodes:
            for name, value in ast.iter_fields(parent):
                if value is node:
                    setattr(parent, name, changed)
                elif isinstance(value, list) and any(item is node for item in value):
                    value[:] = [changed if item is node else item for item in value]
    code = compile(ast.fix_missing_locations(tree), f"{root}/.dev/softfinger/{mistake.file}", "exec", dont_inherit=True)
    for below in _codes(code):
        for function in functions.get((mistake.file, below.co_qualname), ()):
            if function.__code__.co_firstlineno == below.co_firstlineno:
                function.__code__ = below


def _codes(code: CodeType) -> Iterator[CodeType]:
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from _codes(constant)


def _plant_constant(mistake: Mistake) -> None:
    module = sys.modules["softfinger." + mistake.file.removesuffix(".py").replace("/", ".")]
    before = getattr(module, mistake.function)
    if isinstance(before, dict):
        del before[list(before)[mistake.rule]]
        return
    for importer in list(sys.modules.values()):
        same = getattr(importer, "__dict__", {}).get(mistake.function) is before
        if importer is module or (same and _imports(importer, mistake.function)):
            setattr(importer, mistake.function, 2 * before + 1)


def _imports(module: ModuleType, name: str) -> bool:
    """Return whether a module imports a name; small integers are always identical, so identity does not show it."""
    try:
        source = inspect.getsource(module)
    except (OSError, TypeError):  # a module in C
        return False
    return symtable.symtable(source, module.__name__, "exec").lookup(name).is_imported()
