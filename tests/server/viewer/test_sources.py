"""Inputs of the page: recordings with their objects, and a daemon with its scene, events and refusals."""

import sys
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq
from conftest import paper_mapping
from helpers import meshes
from helpers.called import read_stdout
from helpers.pages import running, step_until
from helpers.pressed import pressed_scene
from helpers.programs import run_program
from helpers.recorded import EPOCH_S, about, event, run
from helpers.waits import WAIT_S

from softfinger.config import schema
from softfinger.config.errors import RecordingError
from softfinger.config.load import build, describe, load_scene
from softfinger.config.schema import Scene
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.app import Daemon
from softfinger.server.cli import main
from softfinger.server.gateway.addresses import Addresses
from softfinger.server.offline.simulate import run_recording
from softfinger.server.recording.results import write_blocks
from softfinger.server.recording.writer import RecordingFile
from softfinger.server.surface_meshes import decode_mesh
from softfinger.server.viewer.driven import DrivenPoses, ObjectControls, RecordedBodies
from softfinger.server.viewer.inputs import Nudge
from softfinger.server.viewer.live import NEW_SCENE_TEXT, NO_TICKS_TEXT, SILENCE_S, LivePage
from softfinger.server.viewer.nodes.bodies import SceneStart
from softfinger.server.viewer.page import Page
from softfinger.server.viewer.playback import TRACE_TICKS, LoadedRecording, Player, RecordedPage, load
from softfinger.server.viewer.wire import ReceivedData
from softfinger.server.wire.client_requests import NoAnswer

pytestmark = pytest.mark.real_time

BEGAN = SceneStart(0, 0, 0.001, own_clock=False)


@pytest.fixture(scope="module")
def results() -> np.ndarray:
    return np.asarray(run_recording("tap"))


@pytest.mark.parametrize("ending", [".csv", ".npz", ".mcap"])
def test_results_are_shown_unchanged(tmp_path: Path, results: np.ndarray, ending: str) -> None:
    file = tmp_path / f"run{ending}"
    write_blocks(file, [""], [results[:, None]])
    shown = load(str(file), None)
    assert list(shown.fingers) == [""] and shown.fingers[""].tobytes() == results.tobytes()
    assert shown.scene.object[0].shape == "plane"


def test_poses_are_rendered_first(results: np.ndarray) -> None:
    assert load("tap", None).fingers[""].tobytes() == results.tobytes()


def test_a_file_without_a_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "no.mcap").write_bytes(b"no recording")
    with pytest.raises(RecordingError, match=r"no\.mcap"):
        load(str(tmp_path / "no.mcap"), None)
    assert main(["view", str(tmp_path / "no.mcap"), "--no-open"]) == RecordingError.exit_code


@pytest.mark.sampled(1)
@pytest.mark.parametrize("words", [["view", "--no-open"], ["run", "--view"]])
def test_without_viser_one_line_names_the_package(words: list[str]) -> None:
    code = f"import sys; sys.modules['viser'] = None; from softfinger.server.cli import main; sys.exit(main({words}))"
    completed = run_program([sys.executable, "-c", code])
    assert completed.returncode == 2 and "the page needs viser: pip install 'softfinger[viewer]'" in completed.stderr
    assert "Traceback" not in completed.stderr


@pytest.fixture
def page() -> Iterator[Page]:
    with closing(Page("127.0.0.1", 8300)) as page:
        yield page


def test_a_player_plays_loops_and_jumps(page: Page, tmp_path: Path, results: np.ndarray) -> None:
    file = tmp_path / "run.npz"
    write_blocks(file, [""], [results[:, None]])
    player = Player(page.server.gui, load(str(file), None), tick=0)
    ticks, jumped = player.take_rows()
    assert len(ticks[""]) == 1 and jumped
    assert player.take_rows() == ({}, False)
    player._play.value = True
    player.advance(0.1)
    ticks, jumped = player.take_rows()
    assert ticks[""][:, 1].tolist() == list(range(1, 101)) and not jumped
    player._row = len(results) - 1.0
    ticks, jumped = player.take_rows()
    assert len(ticks[""]) == TRACE_TICKS + 1 and jumped
    end = f"{(len(results) - 1) / 1000.0:.3f} s"
    assert player._time.content == f"{end} of {end}"
    player.advance(0.1)
    assert player.take_rows()[0][""][:, 1].tolist() == [0]


@pytest.fixture
def live(page: Page, endpoints: tuple[str, str]) -> Iterator[LivePage]:
    with closing(LivePage(page, Addresses(*endpoints))) as live:
        yield live


def live_page(page: Page, daemon: Daemon) -> closing[LivePage]:
    return closing(LivePage(page, Addresses(daemon.publisher.endpoint, str(daemon.commands_endpoint))))


def set_stiffness(endpoints: tuple[str, str], value: int) -> None:
    read_stdout("ctl", "set_params", f"object.0.material.stiffness_n_per_m={value}", "--endpoint", endpoints[1])


@contextmanager
def silenced(live: LivePage) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live._telemetry, "take", lambda: ReceivedData({}, [], {}, "", False))
        yield


def test_a_page_follows_its_daemon(page: Page, live: LivePage, endpoints: tuple[str, str]) -> None:
    assert step_until(live, lambda: page.fingers)
    knob = live._tuning._knobs["stiffness"].slider
    assert step_until(live, lambda: knob.value == 1000.0)
    set_stiffness(endpoints, 640)
    assert step_until(live, lambda: knob.value == 640.0)
    live._set_params("stiffness", {"object.0.material.stiffness_n_per_m": -1.0})
    assert step_until(live, lambda: "Not done:" in page.refusal and "stiffness_n_per_m" in page.refusal)
    live._lead_hand("", None)
    assert step_until(live, lambda: "has no hand that a program can move" in page.refusal)
    live._set_params("stiffness", {"object.0.material.stiffness_n_per_m": 1000.0})
    assert step_until(live, lambda: knob.value == 1000.0)


def test_a_page_catches_up_after_lost_messages(page, live, endpoints, monkeypatch):
    """It requests the description again after a gap in the ticks, because the event of a change may be lost with them,
    and after a request without an answer."""
    assert step_until(live, lambda: page.fingers)
    knob, samples = live._tuning._knobs["stiffness"].slider, live._telemetry._samples
    assert step_until(live, lambda: knob.value == 1000.0 and samples._ticks)
    monkeypatch.setattr(live._telemetry, "_events", deque(maxlen=0))
    failures, ask = ["describe"], live._commands._control.ask

    def ask_or_fail(method: str, params: dict[str, Any]) -> Any:
        if method in failures:
            failures.remove(method)
            raise NoAnswer("too late")
        return ask(method, params)

    monkeypatch.setattr(live._commands._control, "ask", ask_or_fail)
    set_stiffness(endpoints, 640)
    samples._ticks.update({topic: tick - 10 for topic, tick in samples._ticks.items()})
    assert step_until(live, lambda: knob.value == 640.0) and not failures
    set_stiffness(endpoints, 1000)


def test_a_page_reports_that_ticks_are_missing_until_they_arrive(page: Page, live: LivePage) -> None:
    assert step_until(live, lambda: page._newest) and not page._message.visible
    with silenced(live):
        live.step(0.5 * SILENCE_S)
        assert not page._message.visible
        live.step(SILENCE_S)
        assert page._message.visible and page._message.content == NO_TICKS_TEXT
    assert step_until(live, lambda: not page._message.visible)
    with silenced(live):
        live.step(2.0 * SILENCE_S)
    page.show_message("force off")
    newest = page._newest[""][AT.tick]
    assert step_until(live, lambda: page._newest[""][AT.tick] > newest)
    assert page._message.visible and page._message.content == "force off"


def test_the_message_of_a_scene_that_is_prepared_ends_with_a_refusal(page: Page, live: LivePage) -> None:
    assert step_until(live, lambda: page.fingers)
    live._set_scene("scene", {"scene": "no-such-scene"})
    assert page._message.content == NEW_SCENE_TEXT and step_until(live, lambda: "no-such-scene" in page.refusal)
    assert not page._message.visible


def test_ticks_and_scenes_may_arrive_in_any_order(page: Page) -> None:
    rows = np.array(run_recording("press-roll-spin-drag"))[1000:1100]
    assert (rows[:, AT.contact_mode] > 0).all()
    page.add_views()
    page.change(load_scene("paper-plane"), BEGAN)
    for number in (7, -1, 0):
        rows[:, AT.contact_object] = number
        page.show({"": rows})
    assert set(page.fingers[""]._object_traces) == {0}


def test_ticks_of_the_previous_scene_are_not_drawn(page: Page, live: LivePage) -> None:
    """The first tick of the new scene distinguishes them."""
    assert step_until(live, lambda: page._newest)
    live._first_tick = 10**9
    page._newest.clear()
    for _ in range(5):
        live.step(0.05)
    assert not page._newest


HALF = (0.5**0.5, 0.0, 0.0, 0.5**0.5)


def pull(handles: ObjectControls, *positions: tuple[float, float, float]) -> None:
    node = handles._nodes[0]
    for phase, position in (("start", positions[0]), *(("update", target) for target in positions)):
        node.position = position
        handles._on_drag(0, SimpleNamespace(target=node, phase=phase))


def test_many_drags_in_a_frame_are_one_request(page: Page) -> None:
    sent: list[Any] = []
    handles = ObjectControls(page.server.gui, page.server.scene, lambda *request: sent.append(request))
    handles.change({0: ((0.0, 0.0, 0.01), HALF)})
    handles._switch.value = True
    handles._show()
    pull(handles, (1.0, 0.0, 1.0), (2.0, 0.0, 1.0), (3.0, 0.0, 1.0))
    handles.step()
    handles.step()
    ((number, (position, turn)),) = sent
    assert number == 0 and position == pytest.approx((0.03, 0.0, 0.01)) and turn == pytest.approx(HALF)
    handles.update_pose(0, (0.02, 0.0, 0.01), None)
    assert handles._nodes[0].position.tolist() == [3.0, 0.0, 1.0]
    handles._on_drag(0, SimpleNamespace(target=handles._nodes[0], phase="end"))
    handles.update_pose(0, (0.02, 0.0, 0.01), None)
    assert handles._nodes[0].position.tolist() == [2.0, 0.0, 1.0]


def test_an_excessive_drag_is_refused_and_reset(page: Page) -> None:
    scene = pressed_scene(name="lid", position_m=(0.0, 0.0, 0.01))
    with running("replay", scene) as daemon, live_page(page, daemon) as live:
        assert step_until(live, lambda: page.fingers)
        handles = live._object_controls
        handles._switch.value = True
        handles._show()
        pull(handles, (0.0, 0.0, 1e7))
        assert step_until(live, lambda: "Not done:" in page.refusal and "position_m" in page.refusal)
        assert handles._nodes[0].position.tolist() == [0.0, 0.0, 1.0]
        pull(handles, (0.0, 0.0, 2.0))
        assert step_until(live, lambda: page.bodies is not None and page.bodies.poses[0][0] == (0.0, 0.0, 0.02))
        assert daemon.rendering.scene.object[0].position_m == (0.0, 0.0, 0.02)
        live._set_params("stiffness", {"object.0.material.stiffness_n_per_m": 700.0})
        nodes = page.fingers[""]
        assert step_until(live, lambda: live._tuning._knobs["stiffness"].slider.value == 700.0)
        assert page.fingers[""] is nodes and handles._nodes[0].position.tolist() == [0.0, 0.0, 2.0]


def test_a_hand_without_a_wrist_can_be_moved(page: Page) -> None:
    """The omega.3 senses no rotation, so none is requested: a key moves it by 2 mm, and nothing is refused."""
    with running("simulated-omega-3", "paper-plane") as daemon, live_page(page, daemon) as live:
        assert step_until(live, lambda: live._hand._fingers and live._hand._poses)
        live._hand.nudge(Nudge(z=-0.002))
        assert step_until(live, lambda: live._hand._targets)
        nudged_at = daemon.rendering.servo.ticks
        assert step_until(live, lambda: daemon.rendering.servo.ticks > nudged_at + 1000)
        assert not page.refusal


def test_the_force_is_switched_off_while_no_other_command_is_answered(page: Page, tmp_path: Path) -> None:
    """The daemon gets `disarm` by a connection on which no other request of the page waits for its answer."""
    endpoint, received = f"ipc://{tmp_path}/commands", dict[str, bytes]()
    with (
        zmq.Context() as context,
        context.socket(zmq.ROUTER) as daemon,
        closing(LivePage(page, Addresses(f"ipc://{tmp_path}/telemetry", endpoint))) as live,
    ):

        def receive(*methods: str) -> None:
            """Receive requests until these have arrived."""
            while not received.keys() >= set(methods):
                assert daemon.poll(1000.0 * WAIT_S), received
                client, _, body = daemon.recv_multipart()
                request = msgpack.unpackb(body)
                received[request["method"]] = client
                if request["method"] == "get_state":  # a request that may take minutes first checks for a daemon
                    refusal = {"command_id": request["command_id"], "success": False, "error": "refused: "}
                    daemon.send_multipart([client, b"", msgpack.packb(refusal | {"result": None})])

        daemon.linger = 0
        daemon.bind(endpoint)
        live._request_description()
        live._reset_world()
        receive("reset_world", "get_prompt")
        live._switch_force(SimpleNamespace(target=SimpleNamespace(value="off")))
        receive("disarm")
        assert list(received.values()).count(received["disarm"]) == 1


LID = {"name": "lid", "shape": "plane", "motion": {"kind": "driven"}, "position_m": [0.0, 0.0, 0.01]}


def drive_event(tick: int, **changes: Any) -> dict[str, Any]:
    return event("command", "drive", tick, what=changes)


def test_events_set_the_poses_of_driven_objects() -> None:
    scene = build(Scene, paper_mapping(table=LID), "test scene")
    events = [
        drive_event(5, object="lid", position_m=[0.0, 0.0, 0.02], orientation_wxyz=list(HALF)),
        drive_event(6, object="chair", position_m=[1.0, 0.0, 0.0]),
        drive_event(7, object="lid", position_m="here"),
        drive_event(8, keys=2),
        event("command", "arm", 9, what={"object": "lid", "position_m": [1.0, 0.0, 0.0]}),
        drive_event(10, object="lid", position_m=[0.0, 1, 0.02]),
    ]
    drives = DrivenPoses(scene, events)
    rest, turned = ((0.0, 0.0, 0.01), (1.0, 0.0, 0.0, 0.0)), ((0.0, 0.0, 0.02), HALF)
    assert [drives.at(tick)[0] for tick in (0, 4, 5, 9)] == [rest, rest, turned, turned]
    assert drives.at(10) == {0: ((0.0, 1.0, 0.02), HALF)}
    assert DrivenPoses(load_scene("paper-plane"), events).at(10) == {}


def test_bodies_of_a_recording_have_their_recorded_poses(tmp_path: Path) -> None:
    scene = load_scene("turn-a-knob")
    file = tmp_path / "turned.mcap"
    with file.open("wb", buffering=0) as out:
        recording = RecordingFile(out, ("",), about(scene=describe(scene), scene_name="turn-a-knob"))
        recording.ticks(run())
        for tick, turn in ((100, (1.0, 0.0, 0.0, 0.0)), (500, HALF)):
            body = {"name": "knob", "position": (0.0, 0.0, 0.0075), "orientation": turn}
            body |= {"velocity": (0.0, 0.0, 0.0), "rate": (0.0, 0.0, 0.0)}
            world = {"schema": 1, "timestamp": EPOCH_S + tick / 1000.0, "tick": tick, "bodies": [body]}
            recording.message("world", world)
        recording.close()
    loaded = load(str(file), None)
    assert RecordedBodies(loaded.worlds).at(99) == {}
    with closing(Page("127.0.0.1", 0)) as page:
        for tick, pointer in ((499, (0.026, 0.0)), (500, (0.0, 0.026)), (1500, (0.0, 0.026))):
            RecordedPage(page, loaded, tick).step(0.0)
            np.testing.assert_allclose(page.bodies.poses[-1][0], [*pointer, 0.0085], atol=1e-9)


def parse_scene(path: Path) -> schema.Scene:
    mapping = paper_mapping(rolling=None)
    part = {"name": "part", "shape": "mesh", "file": str(path), "material": {"stiffness_n_per_m": 500.0}}
    return build(schema.Scene, mapping | {"object": [*mapping["object"], part]}, "test scene")


@pytest.mark.parametrize(
    ("vertices", "triangles"), [(bytes(13), bytes(12)), (bytes(12), bytes(11)), (bytes(12), b"\x01" + bytes(11))]
)
def test_an_invalid_mesh_is_refused(vertices: bytes, triangles: bytes) -> None:
    with pytest.raises(ValueError, match=r"buffer size|reshape|a triangle has vertex 1, but there are 1"):
        decode_mesh(vertices, triangles)


def find_surfaces(page: Page) -> dict[str, Any]:
    handles = page.server.scene._handle_from_node_name
    return {name: handle for name, handle in handles.items() if name.startswith("/objects/")}


def test_a_recording_shows_its_mesh(page: Page, tmp_path: Path) -> None:
    path = meshes.write_ply(tmp_path / "ball.ply", meshes.geodesic(5, 0.04))
    records = {"": np.zeros((3, RECORD_SIZE))}
    RecordedPage(page, LoadedRecording(records, parse_scene(path), "part", 1000.0, BEGAN), 0)
    drawn = find_surfaces(page)["/objects/1/surface"]
    reach = np.abs(meshes.geodesic(5, 0.04).vertices).max()
    np.testing.assert_allclose(np.abs(drawn.vertices).max(), 100 * reach, rtol=1e-6)
    assert len(drawn.faces) == 500
    assert drawn.opacity is None, "browsers draw transparent surfaces in an order that hides parts of the shadow"
    missing = parse_scene(tmp_path / "gone.ply")
    page.change(missing, BEGAN)
    assert "/objects/1/surface" not in find_surfaces(page)
    RecordedPage(page, LoadedRecording(records, missing, "part", 1000.0, BEGAN), 0)
    assert "No such file" in page._message.content and "/objects/0/surface" in find_surfaces(page)
