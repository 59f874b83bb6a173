"""Limits of the numbers in MJCF attributes that determine how much memory MuJoCo allocates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple
from xml.etree.ElementTree import Element

from softfinger.config import limits
from softfinger.config.errors import ConfigError


class ProductLimit(NamedTuple):
    """Largest product of the values of some attributes."""

    attributes: tuple[str, ...]
    most: int


PIXELS: Final = 1 << 24
ELEMENTS_WITH_USER_DATA: Final = ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")
TEXT: Final = 1 << 20
BOUNDS: Final[Mapping[str, tuple[ProductLimit, ...]]] = {
    "hfield": (ProductLimit(("nrow", "ncol"), int(limits.GRID_VALUES.high)),),
    "texture": (ProductLimit(("width", "height"), PIXELS), ProductLimit(("width", "width"), PIXELS)),
    "flexcomp": (ProductLimit(("count",), 16_000), ProductLimit(("cellcount",), 1000)),
    "flex": (ProductLimit(("cellcount",), 1000),),
    "user": (ProductLimit(("dim",), 1_000_000),),
    "camera": (ProductLimit(("resolution",), 1 << 22),),  # a rangefinder has a value for each pixel
    "size": tuple(
        ProductLimit((name,), most)
        for name, most in (
            *((f"nuser_{kind}", 1000) for kind in ELEMENTS_WITH_USER_DATA),
            ("nuserdata", 1 << 20),
            ("nkey", 1000),
        )
    ),
}
LISTS: Final = ("vertex", "normal", "texcoord", "face", "point", "element", "elevation")
"""Attributes that are lists of numbers."""


def check_numbers(element: Element, name: str) -> None:
    """Raise ConfigError if a number of an element, or a list in it, is too large."""
    for bound in BOUNDS.get(element.tag, ()):
        if (value := product(element, bound.attributes)) > bound.most:
            attributes = " x ".join(dict.fromkeys(bound.attributes))
            raise ConfigError(
                f"world.model {name}: <{element.tag}> has {attributes} = {value:,}; at most {bound.most:,} can be read"
            )
    for key in LISTS:
        if len(element.get(key) or "") > TEXT:
            raise ConfigError(
                f"world.model {name}: <{element.tag} {key}> has more than {TEXT:,} characters: put it in a file"
            )


def product(element: Element, attributes: tuple[str, ...]) -> int:
    """Return the product of the whole numbers in attributes, 1 if there are none; MuJoCo reports other values."""
    product = 1
    for attribute in attributes:
        for word in (element.get(attribute) or "").split():
            try:
                product *= max(int(float(word)), 0)
            except (ValueError, OverflowError):
                continue
    return product
