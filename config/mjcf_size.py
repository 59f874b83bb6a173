"""The XML of a model before MuJoCo reads it: only files of its folder, and no more than MuJoCo reads within a second.

A line of MJCF may stand for a million bodies. MuJoCo cannot be interrupted while it makes them, so they are counted
here: elements, times the copies that `<replicate>`, `<include>` and `<attach>` make of them.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from softfinger.config import limits
from softfinger.config.errors import ConfigError
from softfinger.config.files import read_input
from softfinger.config.urdf import places

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

SIZE_MAX: Final = 1 << 24
"""Bytes of a model with all that it includes."""
BODIES_MAX: Final = 1000
ELEMENTS_MAX: Final = 20_000
COPIES_MAX: Final = 5_000
"""Elements that copies are made of, which takes MuJoCo a time that grows with their square."""
FILE_BYTES: Final = 4096
"""Counted for each file that is read, so that one which includes itself has an end."""
CHUNK: Final = 1 << 15
"""Characters that are parsed at a time, which takes a millisecond."""
DEPTH_MAX: Final = 8
"""Models attached to models."""
FILES: Final = ("file", "filename", "meshdir", "texturedir", "assetdir")
ROWS_PER_BYTE: Final = 1 / 50
"""Vertices in a mesh file, at most, if it is written as usual."""


class Bound(NamedTuple):
    """Largest product of the numbers of some attributes."""

    attributes: tuple[str, ...]
    most: int


PIXELS: Final = 1 << 24
USERS: Final = ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")
TEXT: Final = 1 << 20
BOUNDS: Final[Mapping[str, tuple[Bound, ...]]] = {
    "hfield": (Bound(("nrow", "ncol"), int(limits.GRID_VALUES.high)),),
    "texture": (Bound(("width", "height"), PIXELS), Bound(("width", "width"), PIXELS)),
    "flexcomp": (Bound(("count",), 16_000), Bound(("cellcount",), 1000)),
    "flex": (Bound(("cellcount",), 1000),),
    "user": (Bound(("dim",), 1_000_000),),
    "camera": (Bound(("resolution",), 1_000_000),),
    "size": tuple(
        Bound((name,), most)
        for name, most in (
            *(
                (f"nuser_{each}", 1000)
                for each in ["body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor"]
            ),
            ("nuserdata", 1 << 20),
            ("nkey", 1000),
        )
    ),
}
LISTS: Final = ("vertex", "normal", "texcoord", "face", "point", "element", "elevation")
"""Attributes that are lists of numbers."""


def check_files(text: str, path: Path, name: str) -> None:
    """Raise ConfigError if a model, whose file has this text, reads other files or is too large."""
    _Model(path.resolve().parent, name).read(text, path, name, 1, 0)


class _Model:
    """What was counted of a model so far.

    home  its folder
    name  of its file, for messages
    """

    def __init__(self, home: Path, name: str) -> None:
        self._home, self._name = home, name
        self._counted = Counter[str]()
        self._bytes = 0

    def read(self, text: str, path: Path, name: str, times: int, depth: int) -> None:
        """Count a file `times` times, with what it includes and attaches."""
        models, attached = dict[str, Path](), Counter[str]()
        folder, waiting = path.parent, [(self._root(text, name), times, name)]
        while waiting:
            element, times, name = waiting.pop()
            self._check_paths(element, folder, name)
            self._check_numbers(element, name)
            given = element.get("file") or ""
            match element.tag:
                case "include":
                    if (inner := self._text(folder / given)) is not None:
                        within = f"{self._name}, {given}"
                        waiting.append((self._root(inner, within), times, within))
                case "model":
                    models[element.get("name") or Path(given).stem] = folder / given
                case "attach":
                    attached[element.get("model") or ""] += times
            self._count(element, times, folder, name)
            copies = times * (_product(element, ("count",)) if element.tag == "replicate" else 1)
            waiting += [(child, copies, name) for child in element]
        unknown = sum(count for model, count in attached.items() if model not in models)
        for model, part in models.items():
            inner = self._text(part) if depth < DEPTH_MAX else None
            if inner is not None:
                self.read(inner, part, f"{self._name}, {part.name}", max(attached[model] + unknown, 1), depth + 1)

    def _root(self, text: str, name: str) -> Element:
        from xml.etree import ElementTree

        self._bytes += len(text) + FILE_BYTES
        if self._bytes > SIZE_MAX:
            raise ConfigError(f"world.model {name}: has more than {SIZE_MAX:,} bytes with all that it includes")
        if "<!ENTITY" in text:
            raise ConfigError(f"world.model {name}: declares entities, and MuJoCo knows none: write them out")
        parser: Any = ElementTree.XMLPullParser(["start"])
        begun: list[Element] = []
        try:
            for place in range(0, len(text), CHUNK):  # between which other threads have the interpreter
                parser.feed(text[place : place + CHUNK])
                begun += [element for _, element in parser.read_events()]
                if len(begun) > ELEMENTS_MAX:
                    raise ConfigError(
                        f"world.model {name}: has more than {ELEMENTS_MAX:,} elements, the most that can be read"
                    )
            parser.close()
        except ElementTree.ParseError as error:
            raise ConfigError(f"world.model {name}: is no XML: {error}") from error
        return begun[0]

    def _text(self, path: Path) -> str | None:
        """The text of a part; None for a file of which MuJoCo says what is wrong."""
        try:
            return read_input(path, SIZE_MAX).decode("utf-8-sig")
        except (OSError, ValueError):
            return None

    def _check_paths(self, element: Element, folder: Path, name: str) -> None:
        for key in FILES:
            given = element.get(key)
            for way in places(given or ""):
                if not Path(os.path.realpath(folder / way)).is_relative_to(self._home):
                    raise ConfigError(
                        f"world.model {name}: <{element.tag} {key}={given!r}> is outside of its folder: put the file "
                        "beside the model"
                    )

    def _check_numbers(self, element: Element, name: str) -> None:
        for bound in BOUNDS.get(element.tag, ()):
            if (given := _product(element, bound.attributes)) > bound.most:
                what = " x ".join(dict.fromkeys(bound.attributes))
                raise ConfigError(
                    f"world.model {name}: <{element.tag}> has {what} = {given:,}; at most {bound.most:,} can be read"
                )
        for key in LISTS:
            if len(element.get(key) or "") > TEXT:
                raise ConfigError(
                    f"world.model {name}: <{element.tag} {key}> has more than {TEXT:,} characters: put it in a file"
                )

    def _count(self, element: Element, times: int, folder: Path, name: str) -> None:
        bodies = int(element.tag in ("body", "link"))
        if element.tag == "flexcomp" and (element.get("dof") or "full") in ("full", "2d"):
            bodies = self._vertices(element, folder)
        self._add("bodies", times * bodies, BODIES_MAX, "can be stepped in time")
        self._add("elements", times, ELEMENTS_MAX, "can be read")
        if times > 1:
            self._add("copies of elements", times, COPIES_MAX, "can be made")

    def _vertices(self, element: Element, folder: Path) -> int:
        if file := element.get("file"):
            try:
                return math.ceil(ROWS_PER_BYTE * (folder / file).stat().st_size)
            except OSError:
                return 0  # MuJoCo says what is wrong with it
        if (points := element.get("point")) is not None:
            return len(points.split()) // 3
        return _product(element, ("count",)) if element.get("count") else 1000

    def _add(self, what: str, count: int, most: int, why: str) -> None:
        self._counted[what] += count
        if self._counted[what] > most:
            raise ConfigError(
                f"world.model {self._name}: has {self._counted[what]:,} {what} or more; at most {most:,} {why}"
            )


def _product(element: Element, attributes: tuple[str, ...]) -> int:
    """Product of the whole numbers of attributes, 1 without any; of what is none MuJoCo says so."""
    product = 1
    for attribute in attributes:
        for word in (element.get(attribute) or "").split():
            try:
                product *= max(int(float(word)), 0)
            except (ValueError, OverflowError):
                continue
    return product
