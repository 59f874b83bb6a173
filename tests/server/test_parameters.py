"""Parameters set during rendering, without a loop: their effect, and changes that need another model."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.pressed import DEPTH_M, pressed_scene

from softfinger.config.errors import ConfigError
from softfinger.config.load import build, describe, load_rig
from softfinger.config.schema import Scene
from softfinger.drivers.base import Device, DeviceInfo, DeviceIO
from softfinger.proxy.record import AT
from softfinger.server.loop.force_switch import make_switch
from softfinger.server.loop.servo_thread import RING_SECONDS, ServoThread
from softfinger.server.loop.switch_fields import IS_REQUESTED
from softfinger.server.loop.tick import Tuning
from softfinger.server.offline.simulate import simulate
from softfinger.server.services import rendering
from softfinger.server.services.rendering import CHANGE_WAIT_S, Rendering, SceneReplacement
from softfinger.server.states import COMMANDED_REASON, StateMachine

pytestmark = pytest.mark.plain

RAMP_TICKS = 510
"""After this many ticks the guard of the rig `replay` transmits the full force."""
ROUNDING = 1e-12
"""Relative; a force is the result of about ten operations on numbers of similar size."""
MakeRendering = Callable[..., Rendering]
STIFFNESS = "object.lid.top.material.stiffness_n_per_m"
NORMAL = "object.0.material.normal"


def make_soft_scene() -> Scene:
    """Return a scene with f = K d (delta / d)^p and a fingertip whose patch has radius a = c (f / 1 N)^gamma."""
    described = describe(pressed_scene(normal={"exponent": 1.5, "depth_m": 4.0 * DEPTH_M}))
    described["fingertip"]["patch"] = {"shear_modulus_pa": 45e3, "radius_m": 0.004, "exponent": 0.25}
    return build(Scene, described, "soft")


@pytest.fixture
def applied_tunings(monkeypatch: pytest.MonkeyPatch) -> list[Tuning]:
    tunings: list[Tuning] = []
    monkeypatch.setattr(ServoThread, "tune", lambda servo, tuning: tunings.append(tuning))
    return tunings


class AbsentDevice(Device):
    """Device without reads and writes, because no loop runs."""

    info = DeviceInfo("absent", 6, 6, 1e3, 1e2, 1e6, 1e3, (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    io = lambda self: DeviceIO(0, 0, 0)  # noqa: E731
    arm = stop = close = lambda self: None


@pytest.fixture
def make_rendering(monkeypatch: pytest.MonkeyPatch) -> Iterator[MakeRendering]:
    renderings: list[Rendering] = []
    monkeypatch.setattr(rendering, "open_finger_devices", lambda scene, rig: (AbsentDevice(),))

    def make(scene: Scene, words: np.ndarray | None = None) -> Rendering:
        ends = lambda: lambda: None  # noqa: E731
        renderings.append(Rendering(load_rig("replay"), scene, None, ends, None, StateMachine(), make_switch(words)))
        return renderings[-1]

    yield make
    for made in renderings:
        made.servo.close()


def press_to_rest(tuning: Tuning, depth_m: float = DEPTH_M) -> np.ndarray:
    pose = [0.0, 0.0, 0.01 - depth_m, 1.0, 0.0, 0.0, 0.0]
    return simulate(tuning, np.array([[pose]] * RAMP_TICKS), 1000.0)[-1, 0]


def test_every_loop_reads_the_switch_that_other_processes_write(make_rendering: MakeRendering) -> None:
    words = np.zeros(8, np.int64)
    made = make_rendering(pressed_scene(), words)
    next_loop = made.servo.make_loop(made.servo.devices, made.servo.tuning, 1000.0)
    assert made.servo.shared.switch is words and next_loop.shared.switch is words
    assert made.force.is_requested and words[IS_REQUESTED] == 1
    made.force.inhibit(COMMANDED_REASON)
    assert words[IS_REQUESTED] == 0


def test_a_loop_of_another_rate_gets_a_ring_of_its_own(make_rendering: MakeRendering) -> None:
    servo = make_rendering(pressed_scene()).servo
    assert servo.make_loop(servo.devices, servo.tuning, 1000.0).shared.ring is servo.shared.ring
    fast = servo.make_loop(servo.devices, servo.tuning, 4000.0).shared.ring
    assert len(fast.slots) == 4 * len(servo.shared.ring.slots) >= RING_SECONDS * 4000


def test_the_law_of_the_normal_force_and_the_patch_are_parameters(applied_tunings, make_rendering):
    changed = make_rendering(make_soft_scene())
    for changes, force, radius in (
        ({"effect.0.force_n": [0.0, 0.0, 0.5]}, 4.0 * 0.25**1.5, 0.004),
        ({f"{NORMAL}.exponent": 2.0, f"{NORMAL}.depth_m": 2.0 * DEPTH_M}, 2.0 * 0.5**2.0, 0.004),
        ({"fingertip.patch.radius_m": 0.003, STIFFNESS: 500.0}, 0.5 * 2.0 * 0.5**2.0, 0.003),
    ):
        changed.set_parameters(changes, "set_params")
        last = press_to_rest(applied_tunings[-1])
        assert last[AT.contact_normal_force] == pytest.approx(force, rel=ROUNDING)
        assert last[AT.contact_patch_radius] == pytest.approx(radius * force**0.25, rel=ROUNDING)
        assert last[AT.force + 2] == pytest.approx(force + 0.5, rel=ROUNDING)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({f"{NORMAL}.exponent": 0.5}, "from 1 to 3"),
        ({"fingertip.patch.exponent": 0.5}, "from 0 to 0.333333"),
        ({STIFFNESS: 500.0, f"{NORMAL}.exponent": 1.0}, "another model, which must be compiled: use set_scene"),
        ({"fingertip.patch.rolling_loss": 0.3}, "another model, which must be compiled: use set_scene"),
    ],
)
def test_a_refused_change_changes_nothing(changes, words, applied_tunings, make_rendering):
    changed = make_rendering(make_soft_scene())
    before = changed.scene
    with pytest.raises(ConfigError) as refused:
        changed.set_parameters(changes, "set_params")
    assert words in str(refused.value), refused.value
    assert changed.scene is before and not applied_tunings


def test_a_change_waits_for_a_replacement_and_no_longer(applied_tunings, make_rendering, monkeypatch):
    monkeypatch.setattr(rendering, "CHANGE_WAIT_S", 0.01)
    assert CHANGE_WAIT_S > 0.1  # a replacement in contact takes longer than the guard's ramp to zero
    changed = make_rendering(pressed_scene())
    with ThreadPoolExecutor() as pool, changed._tuning_lock:
        change = pool.submit(changed.set_parameters, {STIFFNESS: 500.0}, "set_params")
        with pytest.raises(SceneReplacement, match="try again"):
            change.result(60.0)
        assert not applied_tunings
    changed.set_parameters({STIFFNESS: 500.0}, "set_params")
    assert press_to_rest(applied_tunings[-1])[AT.contact_normal_force] == pytest.approx(500.0 * DEPTH_M, rel=ROUNDING)


def test_a_servo_whose_start_was_interrupted_is_awaited(make_rendering, monkeypatch):
    made, timeouts = make_rendering(pressed_scene()), []
    monkeypatch.setattr(made.servo, "start", Mock(side_effect=KeyboardInterrupt))
    monkeypatch.setattr(made.servo, "join", timeouts.append)
    with pytest.raises(KeyboardInterrupt):
        made.start()
    made.stop()
    assert timeouts
