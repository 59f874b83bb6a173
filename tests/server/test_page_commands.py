"""Commands of a page to a daemon: prompts of an experiment, answered once, motions of the hand, and meshes."""

import asyncio
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import meshes
from helpers.pages import LOCAL, daemon_of
from helpers.waits import WAIT_S, eventually

from softfinger.config.errors import CommandRefused
from softfinger.config.load import load_rig, load_scene
from softfinger.server.app import Daemon
from softfinger.server.remote import Client
from softfinger.server.services.commands import CommandService
from softfinger.server.wire.client import Subscription
from softfinger.server.wire.commands import MeshResult, Prompt, PromptScreen
from softfinger.server.wire.control import AsyncControl, Control
from softfinger.server.wire.protocol import EVENT
from softfinger.server.wire.publisher import Publisher
from softfinger.server.wire.rig_endpoints import bind_rig

pytestmark = pytest.mark.real_time


daemon = daemon_of("simulated-hand", "paper-plane")


@pytest.fixture(autouse=True)
def ticking(client: Client) -> None:
    """Wait for the first tick."""

    def has_ticked() -> bool:
        with suppress(CommandRefused):
            return client.get_state().sequence >= 0
        return False

    assert eventually(has_ticked)


def subscribe_events(client: Client) -> tuple[Subscription, list[dict[str, Any]]]:
    events = client.subscribe((EVENT,), timeout_s=WAIT_S)
    received: list[dict[str, Any]] = []
    until = time.monotonic() + WAIT_S
    while not received and time.monotonic() < until:
        client.mark("begin")
        if (sample := events.receive(0.1)) is not None:
            received.append(sample.data)
    return events, received


def test_a_question_is_shown_and_answered_once(client: Client) -> None:
    events, received = subscribe_events(client)
    screen = {"colour": "#3366cc", "image": "data:image/png;base64,AAAA", "masking_noise": "pink", "volume": 0.5}
    question = client.set_prompt("trial 3", "Which?", (2, 40), choices=("first", "second"), **screen)
    assert client.get_prompt() == question and question.open and question.answer is None
    assert question.prompt == Prompt("trial 3", "Which?", 2, 40, ("first", "second"), **screen)
    assert PromptScreen.__annotations__.keys() == screen.keys() and Prompt.__struct_fields__[-4:] == tuple(screen)
    client.answer("second", question.number)
    answered = client.get_prompt()
    assert not answered.open and answered.answer == "second" and 0.0 < answered.after_s < WAIT_S
    with pytest.raises(CommandRefused, match="is not open"):
        client.answer("first", question.number)
    while received[-1]["name"] != "answer":
        received.append(next(events).data)
    assert [event["name"] for event in received if event["kind"] == "command"] == ["set_prompt", "answer"]
    assert received[-1]["what"] == {"prompt": question.number, "value": "second"}


def test_an_answer_to_an_earlier_question_is_refused(client: Client) -> None:
    """A page that is late may send one."""
    before = client.set_prompt(choices=("a", "b")).number
    client.set_prompt(choices=("a", "b"))
    with pytest.raises(CommandRefused, match="answer the one that is shown"):
        client.answer("a", before)


WRONG_CHOICES = ("neither", "", 1.0, True, None, ["first"], {"first": 1}, "x" * 100_000, float("nan"))
WRONG_NUMBERS = (0.5, 7.01, float("nan"), float("inf"), -float("inf"), "3", True)


@pytest.mark.parametrize(
    ("prompt", "values", "right"),
    [({"choices": ("first", "second")}, WRONG_CHOICES, "first"), ({"number": (1.0, 7.0)}, WRONG_NUMBERS, 7.0)],
)
def test_a_wrong_answer_is_refused(client: Client, prompt: dict[str, Any], values: tuple[Any, ...], right: Any) -> None:
    question = client.set_prompt(**prompt)
    for value in values:
        with pytest.raises(CommandRefused, match="bad_params"):
            client.ask("answer", {"value": value, "prompt": question.number})
        assert client.get_prompt().open, value
    client.answer(right)


def test_a_text_answer_is_stored_and_not_published(client: Client) -> None:
    """Its length is limited and it is not in the event, because a text in a recording may be personal."""
    events, received = subscribe_events(client)
    question = client.set_prompt("remarks", "Any?", text_length=12)
    assert question.prompt == Prompt("remarks", "Any?", text_length=12)
    for value in ("", "   ", "x" * 13, 1.0):
        with pytest.raises(CommandRefused, match="bad_params"):
            client.ask("answer", {"value": value})
    client.answer("<b>none</b>", question.number)
    assert client.get_prompt().answer == "<b>none</b>"
    while received[-1]["name"] != "answer":
        received.append(next(events).data)
    assert received[-1]["what"] == {"prompt": question.number}


@pytest.mark.parametrize(
    ("method", "params", "message"),
    [
        ("set_prompt", {"choices": ["a"], "number": [0.0, 1.0]}, "either choices, number or text_length"),
        ("set_prompt", {"choices": ["a"], "text_length": 9}, "either choices, number or text_length"),
        ("set_prompt", {"colour": "red"}, "colour"),
        ("set_prompt", {"image": "https://example.org/a.png"}, "image"),
        ("set_prompt", {"image": "data:image/svg+xml;base64,AAAA"}, "image"),
        ("set_prompt", {"masking_noise": "brown"}, "masking_noise"),
        ("set_prompt", {"number": [1.0, 1.0]}, "must be the smallest, then the largest"),
        ("set_prompt", {"number": [0.0, float("nan")]}, "must be the smallest, then the largest"),
        ("set_prompt", {"choices": [""]}, "choices"),
        ("set_prompt", {"choices": ["a"] * 22}, "choices"),
        ("set_prompt", {"text": "x" * 5000}, "text"),
        ("set_prompt", {"html": "<script>"}, "html"),
        ("hand", {}, "bad_params: give either position_m"),
        ("hand", {"position_m": [0, 0, 0.01], "release": True}, "bad_params: give either position_m"),
        ("hand", {"position_m": [0, 0, 3]}, "bad_params: hand: position_m = .* is outside the workspace"),
        ("hand", {"position_m": [0, 0, float("nan")]}, "bad_params: hand"),
        ("hand", {"position_m": [0, 0, 0.02], "finger": "toe"}, "bad_params: there is no finger 'toe'"),
    ],
)
def test_an_invalid_request_is_refused(client: Client, method: str, params: dict[str, Any], message: str) -> None:
    before = client.get_prompt()
    with pytest.raises(CommandRefused, match=message):
        client.ask(method, params)
    assert client.get_prompt() == before


def test_the_hand_presses_after_the_client_disconnects(daemon: Daemon, client: Client) -> None:
    assert client.describe()["fingers"][0]["led"] is True
    client.hand((0.0, 0.0, 0.005), (1.0, 0.0, 0.0, 0.0))
    assert eventually(lambda: client.get_state().force[2] > 0.5)
    client.close()
    with Client(daemon.publisher.endpoint, str(daemon.commands_endpoint), timeout_s=WAIT_S) as second:
        ticks = second.get_state().sequence
        assert eventually(lambda: second.get_state().sequence > ticks + 500)
        assert second.get_state().force[2] > 0.5


def test_a_held_hand_still_presses(client: Client) -> None:
    client.hand((0.0, 0.0, 0.005), (1.0, 0.0, 0.0, 0.0))
    assert eventually(lambda: client.get_state().force[2] > 1.0)
    before = client.get_state()
    assert eventually(lambda: client.get_state().sequence > before.sequence + 500)  # 16 time constants of the motion
    rests = client.get_state()
    target = client.hold()
    assert target.position_m == pytest.approx((0.0, 0.0, 0.005), abs=1e-6) and rests.position[2] > 0.0055
    client.hand(target.position_m, target.orientation_wxyz)
    assert eventually(lambda: client.get_state().sequence > rests.sequence + 500)
    assert client.get_state().force[2] == pytest.approx(rests.force[2], abs=1e-3)


def test_events_report_only_start_and_end_of_a_lead(daemon: Daemon, client: Client) -> None:
    client.hand(release=True)
    with client.subscribe(("event",), timeout_s=WAIT_S) as events:
        assert eventually(lambda: client.mark("begin") is not None and events.receive(0.1) is not None)
        for k in range(30):
            client.hand((0.001 * k, 0.0, 0.02))
        client.hand(release=True)
        client.mark("end")
        commands = []
        while (event := next(events).data)["kind"] != "mark" or event["label"] != "end":
            if event["kind"] == "command":
                commands.append((event["name"], event["what"]))
    assert commands == [("hand", {"finger": "", "led": True}), ("hand", {"finger": "", "led": False})]


def test_a_replay_has_no_hand_to_lead(endpoints: tuple[str, str]) -> None:
    async def ask() -> None:
        async with AsyncControl(endpoints[1], timeout_s=WAIT_S) as control:
            await control.hand((0.0, 0.0, 0.01))

    with pytest.raises(
        CommandRefused, match=r"refused: replay.* has no hand that a program can move.*--rig simulated-hand"
    ):
        asyncio.run(ask())


MATERIAL = {"stiffness_n_per_m": 500.0}
BALL = meshes.geodesic(16, 0.04)
"""5120 triangles."""
HEIGHTS = 1e-3 * np.sin(np.add.outer(np.arange(20.0), 2.0 * np.arange(30.0)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("files")
    meshes.write_ply(folder / "ball.ply", BALL)
    np.save(folder / "hills.npy", HEIGHTS)
    np.save(folder / "large.npy", np.zeros((1000, 1000)))
    return folder


@pytest.fixture(scope="module")
def commands(folder: Path) -> Iterator[str]:
    height_map = {"shape": "heightmap", "pitch_m": 0.001, "level_m": 1.0}
    maps = [height_map | {"name": name, "file": str(folder / f"{name}.npy")} for name in ("hills", "large")]
    ball = {"name": "ball", "shape": "mesh", "file": str(folder / "ball.ply")}
    objects = [table | {"material": MATERIAL} for table in (ball, *maps, {"name": "table", "shape": "plane"})]
    scene = load_scene({"fingertip": {"radius_m": 0.01}, "object": objects})
    force = SimpleNamespace(is_reachable=True, note_guard=lambda reason, is_off: None)
    rendering = SimpleNamespace(rig=load_rig("replay", LOCAL), scene=scene, force=force)
    doors = bind_rig(rendering.rig)
    with Publisher(doors) as publisher:
        actions = SimpleNamespace(replace=None, publisher=publisher)
        service = CommandService(str(doors.commands), rendering, actions, "meshes")
        service.start()
        yield str(doors.commands)
        service.stop()


@pytest.fixture
def control(commands: str) -> Iterator[Control]:
    with Control(commands, timeout_s=WAIT_S) as control:
        yield control


def arrays(sent: MeshResult) -> list[np.ndarray]:
    return [np.frombuffer(sent.vertices, "<f4").reshape(-1, 3), np.frombuffer(sent.triangles, "<u4").reshape(-1, 3)]


def test_a_mesh_has_the_triangles_of_its_file(control: Control, commands: str) -> None:
    async def ask() -> MeshResult:
        async with AsyncControl(commands, timeout_s=WAIT_S) as control:
            return await control.mesh("ball")

    sent = control.mesh("ball")
    assert sent == control.mesh(0) == asyncio.run(ask()) and sent.of == len(BALL.triangles) == 5120
    vertices, triangles = arrays(sent)
    corners, expected = vertices[triangles], BALL.vertices.astype("<f4")[BALL.triangles]
    np.testing.assert_array_equal(order(corners), order(expected))


def order(corners: np.ndarray) -> np.ndarray:
    rows = np.sort(corners.reshape(len(corners), -1), axis=1)
    return rows[np.lexsort(rows.T)]


def test_a_height_map_has_a_vertex_for_each_pixel(control: Control) -> None:
    sent = control.mesh("hills")
    vertices, triangles = arrays(sent)
    np.testing.assert_allclose(vertices[:, 2].reshape(HEIGHTS.shape), HEIGHTS, atol=1e-9)  # float32 of 1 mm
    np.testing.assert_allclose(vertices[:, :2].min(axis=0), [-0.0145, -0.0095], rtol=1e-6)
    assert len(triangles) == sent.of == 2 * 19 * 29 and triangles.max() == HEIGHTS.size - 1


def test_a_large_height_map_is_reduced(control: Control) -> None:
    sent = control.mesh("large")
    vertices, triangles = arrays(sent)
    assert len(triangles) <= 50_000 < sent.of == 2 * 999 * 999
    np.testing.assert_allclose(np.ptp(vertices, axis=0), [0.999, 0.999, 0.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("object_name", "message"),
    [
        (4, "bad_params: there is no object 4; objects are ball, hills, large, table"),
        ("cube", "bad_params: there is no object 'cube'; objects are ball, hills, large, table"),
        (-1, "bad_params: mesh: object: Expected `int` >= 0; parameters are object: text or integer"),
        ("table", "refused: object table is a plane and no mesh: its table describes it completely"),
    ],
)
def test_objects_without_triangles_are_refused(control: Control, object_name: int | str, message: str) -> None:
    with pytest.raises(CommandRefused) as caught:
        control.mesh(object_name)
    assert str(caught.value) == message


def test_a_map_with_a_missing_file_is_refused(control: Control, folder: Path) -> None:
    """A height map is read again for each request; a mesh is in memory."""
    (folder / "hills.npy").unlink()
    (folder / "ball.ply").unlink()
    with pytest.raises(CommandRefused, match=r"^bad_params: object 'hills': file: .*hills\.npy: cannot be read: .*$"):
        control.mesh("hills")
    assert control.mesh("ball").of == 5120
