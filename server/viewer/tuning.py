"""Controls of a scene's parameters, and choice of the scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple, get_args

from softfinger.config import schema
from softfinger.config.load import describe
from softfinger.config.schema.contact import RollingMethod
from softfinger.config.sources import list_shipped
from softfinger.server.viewer.inputs import is_in_list, is_on_slider

NO_ROLLING: Final = "none"
Change = Callable[[str, dict[str, Any]], None]


class Knob(NamedTuple):
    """Slider of one number of a material: `read` returns it, or None without one; `keys` returns the change."""

    slider: Any
    read: Callable[[schema.Material], float | None]
    keys: Callable[[schema.Material, float], dict[str, float]]

    def show(self, material: schema.Material) -> None:
        value = self.read(material)
        self.slider.disabled = value is None
        if value is not None:
            self.slider.max = max(self.slider.max, 2.0 * value)
            self.slider.value = value


def _tune_friction(material: schema.Material, static: float) -> dict[str, float]:
    friction = material.friction
    share = friction.kinetic / friction.static if friction is not None and friction.static > 0.0 else 1.0
    return {"friction.static": static, "friction.kinetic": static * share}


class SceneControls:
    """Controls of a scene; `params(name, values)` and `scene(name, values)` send commands to the daemon."""

    def __init__(self, gui: Any, params: Change, scene: Change) -> None:
        self._params, self._set_scene = params, scene
        self._scene: schema.Scene | None = None
        self._name = ""
        self._object = gui.add_dropdown("object", ("",), visible=False)
        self._object.on_update(lambda event: self.show())
        self._knobs = {
            "stiffness": Knob(
                gui.add_slider("stiffness, N/m", 0.0, 3000.0, 10.0, 0.0),
                lambda material: material.stiffness_n_per_m,
                lambda material, value: {"stiffness_n_per_m": value},
            ),
            "damping": Knob(
                gui.add_slider("damping, N s/m", 0.0, 10.0, 0.1, 0.0),
                lambda material: material.damping_ns_per_m,
                lambda material, value: {"damping_ns_per_m": value},
            ),
            "friction": Knob(
                gui.add_slider("friction", 0.0, 1.5, 0.01, 0.0),
                lambda material: None if material.friction is None else material.friction.static,
                _tune_friction,
            ),
            "torsion": Knob(
                gui.add_slider("torsion, N m/rad", 0.0, 0.2, 0.001, 0.0),
                lambda material: None if material.torsion is None else material.torsion.stiffness_nm_per_rad,
                lambda material, value: {"torsion.stiffness_nm_per_rad": value},
            ),
        }
        for name, knob in self._knobs.items():
            knob.slider.on_update(lambda event, name=name: self._on_slider(event, name))
        self._rolling = gui.add_dropdown("rolling", (*get_args(RollingMethod), NO_ROLLING))
        self._rolling.on_update(self._on_rolling)
        self._scene_list = gui.add_dropdown("scene", tuple(list_shipped(schema.Scene)))
        self._scene_list.on_update(self._on_scene)

    def change(self, scene: schema.Scene, name: str) -> None:
        self._scene, self._name = scene, name
        names = tuple(obj.name for obj in scene.object)
        if self._object.options != names:
            self._object.options = names
        self._object.visible = len(names) > 1
        self.show()

    def _find_scene_index(self) -> int:
        return self._object.options.index(self._object.value) if self._object.value in self._object.options else 0

    def show(self) -> None:
        """Show the current values, also after a command was refused."""
        if self._scene is None:
            return
        for knob in self._knobs.values():
            knob.show(self._scene.object[self._find_scene_index()].material)
        self._rolling.value = NO_ROLLING if self._scene.rolling is None else self._scene.rolling.method
        names = tuple(list_shipped(schema.Scene))
        if self._name not in names:
            names = (*names, self._name)
        if self._scene_list.options != names:
            self._scene_list.options = names
        self._scene_list.value = self._name

    def _on_slider(self, event: Any, name: str) -> None:
        if event.client is None or self._scene is None:  # set by this program, not by a person
            return
        if not is_on_slider(self._knobs[name].slider):
            self.show()
            return
        scene_index, knob = self._find_scene_index(), self._knobs[name]
        changed = knob.keys(self._scene.object[scene_index].material, float(knob.slider.value))
        self._params(name, {f"object.{scene_index}.material.{key}": value for key, value in changed.items()})

    def _on_rolling(self, event: Any) -> None:
        if event.client is None or self._scene is None:
            return
        if not is_in_list(self._rolling):
            self.show()
            return
        scene, method = describe(self._scene), self._rolling.value
        if method == NO_ROLLING:
            scene.pop("rolling", None)
        else:
            scene["rolling"] = scene.get("rolling", {}) | {"method": method}
        self._set_scene("scene", {"scene": scene, "name": self._name})

    def _on_scene(self, event: Any) -> None:
        if not is_in_list(self._scene_list):
            self.show()
        elif event.client is not None and self._scene_list.value != self._name:
            self._set_scene("scene", {"scene": self._scene_list.value})
