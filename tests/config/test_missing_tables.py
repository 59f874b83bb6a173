"""A message about a missing table shows how to write it."""

from __future__ import annotations

import re
import tomllib

import pytest

from softfinger.config.errors import ConfigError
from softfinger.config.load import describe, load_scene

pytestmark = pytest.mark.plain


@pytest.mark.parametrize(
    ("scene", "place", "name"),
    [
        ("bend-a-strip", ("object", 0, "elastic"), "fixed"),
        ("bend-a-strip", ("object", 0), "material"),
        ("paper-plane", (), "object"),
    ],
)
def test_the_header_of_a_missing_table_is_toml(scene: str, place: tuple[str | int, ...], name: str) -> None:
    mapping = table = describe(load_scene(scene))
    for key in place:
        table = table[key]  # type: ignore[index]
    del table[name]
    with pytest.raises(ConfigError) as refused:
        load_scene(mapping)
    (header,) = re.findall(r"\[+[\w.\[\]]+\]$", str(refused.value))
    written = tomllib.loads(header)
    for key in (*(part for part in place if isinstance(part, str)), name):
        written = written[key]
