"""Limits of a model's XML, checked before MuJoCo reads it: files below one folder, and at most a second of reading.

A line of MJCF may expand to a million bodies, and MuJoCo cannot be interrupted while it creates them. Therefore the
elements are counted here, times the copies that `<replicate>`, `<include>` and `<attach>` make of them.
"""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

from softfinger.config import limits
from softfinger.config.errors import ConfigError
from softfinger.config.files import read_input
from softfinger.config.mjcf_files import check_place

COMMENT: Final = re.compile(r"""<!--(?:[^<>"']|(?<=\w)'(?=\w))*-->""")
"""Comment, which in a file for MuJoCo may contain `--`. It has no quotation mark, so it ends no attribute."""
SIZE_MAX: Final = 1 << 24
"""Largest size of a model with all files that it includes, bytes."""
BODIES_MAX: Final = 1000
ELEMENTS_MAX: Final = 20_000
COPIES_MAX: Final = 5_000
"""Elements that are copies; MuJoCo's time to make them grows with the square of their number."""
FILE_BYTES: Final = 4096
"""Bytes counted for each file that is read, so that a file that includes itself reaches the limit."""
CHUNK: Final = 1 << 15
"""Characters parsed at a time, which takes a millisecond."""
DEPTH_MAX: Final = 8
"""Deepest nesting of models attached to models."""
ROWS_PER_BYTE: Final = 1 / 50
"""Vertices per byte of a mesh file, at most, in the usual notation."""

PIXELS: Final = 1 << 24
ELEMENTS_WITH_USER_DATA: Final = ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")
BOUNDS: Final[Mapping[str, Mapping[tuple[str, ...], int]]] = {
    "hfield": {("nrow", "ncol"): int(limits.GRID_VALUES.high)},
    "texture": {("width", "height"): PIXELS, ("width", "width"): PIXELS},
    "flexcomp": {("count",): 16_000, ("cellcount",): 1000},
    "flex": {("cellcount",): 1000},
    "user": {("dim",): 1_000_000},
    "camera": {("resolution",): 1 << 22},  # a rangefinder has a value for each pixel
    "size": {
        ("nuserdata",): 1 << 20,
        ("nkey",): 1000,
        **{(f"nuser_{kind}",): 1000 for kind in ELEMENTS_WITH_USER_DATA},
    },
}
"""Largest products of attributes that determine how much memory MuJoCo allocates, by element."""
LISTS: Final = ("vertex", "normal", "texcoord", "face", "point", "element", "elevation")
"""Attributes that are lists of numbers."""
LIST_SIZE_MAX: Final = 1 << 20


class Names(NamedTuple):
    """Names of files, folders and elements in a model that refer to other files.

    parts     XML files, without folders
    folders   values of meshdir and assetdir
    flexes    files of <flexcomp>
    attaches  whether it attaches other models
    """

    parts: set[str]
    folders: set[str]
    flexes: set[str]
    attaches: list[str]


def read_text(path: str | Path, name: str) -> str:
    """Return the text of a model's file; in comments, other encodings than UTF-8 are permitted.

    Raises ConfigError if it is not a regular file or too large.
    """
    try:
        return read_input(path, SIZE_MAX).decode("utf-8", errors="replace").removeprefix("\ufeff")
    except OSError as error:
        raise ConfigError(f"world.model {name}: cannot be read: {error.strerror or error}") from error


def read_names(text: str, path: Path, name: str, home: Path) -> Names:
    """Return the names in a model with this text, and check its size.

    Raises ConfigError if it is too large, or if it includes or attaches a file that is not below `home`.
    """
    model = _Model(home, name)
    model.read(text, path, name, 1, 0)
    return model.names


class _Model:
    """Counts of a model so far.

    home  folder below which its files must lie
    name  name of its file, for messages
    """

    def __init__(self, home: Path, name: str) -> None:
        self._home, self._name = home, name
        self.names = Names(set(), set(), set(), [])
        self._counted = Counter[str]()
        self._bytes = 0

    def read(self, text: str, path: Path, name: str, times: int, depth: int) -> None:
        """Count a file `times` times, including the files that it includes and attaches."""
        models, attached, included = dict[str, Path](), Counter[str](), {path}
        folder, waiting = path.parent, [(self._parse_xml(text, name), times, name, path.parent)]
        while waiting:
            element, times, name, base = waiting.pop()
            self._check_paths(element, name)
            _check_numbers(element, name)
            file = element.get("file") or ""
            match element.tag:
                case "include":
                    part = self._find_file(element, (folder, base), name)
                    if part in included:
                        raise ConfigError(
                            f"world.model {name}: includes {file} twice, but MuJoCo reads each file once: remove one"
                        )
                    included.add(part)
                    if (inner := self._read_text(part)) is not None:
                        within = f"{self._name}, {file}"
                        waiting.append((self._parse_xml(inner, within), times, within, part.parent))
                case "model":
                    models[element.get("name") or Path(file).stem] = self._find_file(element, (folder, base), name)
                case "attach":
                    attached[element.get("model") or ""] += times
            self._count(element, times, folder, name)
            copies = times * (_multiply_attributes(element, ("count",)) if element.tag == "replicate" else 1)
            waiting += [(child, copies, name, base) for child in element]
        unknown = sum(count for model, count in attached.items() if model not in models)
        for model, part in models.items():
            inner = self._read_text(part) if depth < DEPTH_MAX else None
            if inner is not None:
                self.read(inner, part, f"{self._name}, {part.name}", max(attached[model] + unknown, 1), depth + 1)

    def _parse_xml(self, text: str, name: str) -> Element:
        """Parse XML as MuJoCo does, which knows no namespaces and no document types."""
        self._bytes += len(text) + FILE_BYTES
        if self._bytes > SIZE_MAX:
            raise ConfigError(f"world.model {name}: has more than {SIZE_MAX:,} bytes, with all included files")
        builder, parser, count = ElementTree.TreeBuilder(), expat.ParserCreate(), 0

        def start(tag: str, attributes: dict[str, str]) -> None:
            nonlocal count
            count += 1
            if count > ELEMENTS_MAX:
                raise ConfigError(f"world.model {name}: has more than {ELEMENTS_MAX:,} elements, the limit for reading")
            builder.start(tag, attributes)

        def start_doctype(_: str, *declared: object) -> None:
            if any(declared):  # MuJoCo would read an element in it
                raise ConfigError(
                    f"world.model {name}: declares a document type, which MuJoCo does not support: remove <!DOCTYPE>"
                )

        parser.StartElementHandler, parser.EndElementHandler = start, builder.end
        parser.StartDoctypeDeclHandler = start_doctype
        text = text.strip("\0 \t\r\n")  # MuJoCo, too, permits it around the XML
        text = COMMENT.sub(lambda match: "\n" * match[0].count("\n"), text)
        if "\N{REPLACEMENT CHARACTER}" in text:
            raise ConfigError(f"world.model {name}: is not text in UTF-8: save it as UTF-8")
        try:
            for place in range(0, len(text), CHUNK):  # in chunks, since parsing blocks other threads
                parser.Parse(text[place : place + CHUNK], False)
            parser.Parse("", True)
        except expat.ExpatError as error:
            raise ConfigError(
                f"world.model {name}: is not well-formed XML, which is required even if MuJoCo reads it: {error}"
            ) from error
        return builder.close()

    def _find_file(self, element: Element, folders: tuple[Path, ...], name: str) -> Path:
        """Return the file of an element, as MuJoCo finds it: in the first folder that has it.

        The folders are those of the model and of the file with the element. Raises ConfigError if it is not below
        `home`.
        """
        file = element.get("file") or ""
        places = [folder / file for folder in folders]
        model_file = next((place for place in places if os.access(place, os.R_OK)), places[0])
        check_place(model_file, self._home, f"{name}: <{element.tag} file={file!r}>")
        return model_file

    def _read_text(self, path: Path) -> str | None:
        """Return the text of a part; None if it cannot be opened, which MuJoCo reports.

        Raises ConfigError if it is not a regular file or too large.
        """
        if not os.access(path, os.R_OK):
            return None
        return read_text(path, f"{self._name}, {path.name}")

    def _check_paths(self, element: Element, name: str) -> None:
        """Note the files that only MuJoCo finds."""
        file = element.get("file") or ""
        match element.tag:
            case "include" | "model":
                self.names.parts.add(os.path.basename(file))
            case "attach":
                self.names.attaches.append(element.get("model") or "")
            case "flexcomp":
                self.names.flexes.add(file)
            case "compiler":
                self.names.folders.update(element.get(key) or "" for key in ("meshdir", "assetdir"))

    def _count(self, element: Element, times: int, folder: Path, name: str) -> None:
        bodies = int(element.tag in ("body", "link"))
        if element.tag == "flexcomp" and (element.get("dof") or "full") in ("full", "2d"):
            bodies = self._count_vertices(element, folder)
        self._add("bodies", times * bodies, BODIES_MAX, "can be stepped in time")
        self._add("elements", times, ELEMENTS_MAX, "can be read")
        if times > 1:
            self._add("copies of elements", times, COPIES_MAX, "can be made")

    def _count_vertices(self, element: Element, folder: Path) -> int:
        if file := element.get("file"):
            try:
                return math.ceil(ROWS_PER_BYTE * (folder / file).stat().st_size)
            except OSError:
                return 0  # MuJoCo reports it
        if (points := element.get("point")) is not None:
            return len(points.split()) // 3
        return _multiply_attributes(element, ("count",)) if element.get("count") else 1000

    def _add(self, contents: str, count: int, most: int, why: str) -> None:
        self._counted[contents] += count
        if self._counted[contents] > most:
            raise ConfigError(
                f"world.model {self._name}: has {self._counted[contents]:,} {contents} or more; at most {most:,} {why}"
            )


def _check_numbers(element: Element, name: str) -> None:
    """Raise ConfigError if a number of an element, or a list in it, is too large."""
    for attributes, most in BOUNDS.get(element.tag, {}).items():
        if (value := _multiply_attributes(element, attributes)) > most:
            names = " x ".join(dict.fromkeys(attributes))
            raise ConfigError(
                f"world.model {name}: <{element.tag}> has {names} = {value:,}; at most {most:,} can be read"
            )
    for key in LISTS:
        if len(element.get(key) or "") > LIST_SIZE_MAX:
            raise ConfigError(
                f"world.model {name}: <{element.tag} {key}> has more than {LIST_SIZE_MAX:,} characters: put it in a "
                "file"
            )


def _multiply_attributes(element: Element, attributes: tuple[str, ...]) -> int:
    """Return the product of the whole numbers in attributes, 1 if there are none; MuJoCo reports other values."""
    result = 1
    for attribute in attributes:
        for word in (element.get(attribute) or "").split():
            try:
                result *= max(int(float(word)), 0)
            except (ValueError, OverflowError):
                continue
    return result
