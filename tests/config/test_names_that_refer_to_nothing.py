"""Names of a scene that refer to parts of its model: a misspelt one is refused on load, with the names that exist."""

from __future__ import annotations

from typing import Any

import pytest

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene

pytestmark = pytest.mark.plain


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"world.geom.0.name": "bal"}, r"world\.geom\[0\] fits no geom of .*: name = 'bal'; it has bowl, ball"),
        ({"world.geom.0.group": 7}, r"world\.geom\[0\] fits no geom of .*: name = 'ball', group = 7"),
        ({"world.geom.0.default": "rubber"}, r"world\.geom\[0\] fits no geom of .*: name = 'ball', default = "),
        ({"world.mass_kg": {"bal": 0.1}}, "'bal' is not a body with a mass; it has ball"),
        ({"world.keyframe": "home"}, "has no such <key>; it has: none"),
        ({"object.bowl.motion": {"kind": "body", "body": "bal"}}, r"motion\.body = 'bal' is not a body .*; it has"),
    ],
)  # fmt: skip
def test_a_misspelt_name_is_refused_on_load(changes: dict[str, Any], message: str) -> None:
    load_scene("ball-in-a-bowl")
    with pytest.raises(ConfigError, match=message):
        load_scene("ball-in-a-bowl", changes)
