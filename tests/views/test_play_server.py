"""The live page's server, the real one on a real socket: what visitors may do to it, and to each other."""

import asyncio
import json
import struct
import threading
import time
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress

import numpy as np
import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from sidestep.cli import main
from sidestep.loop import load_episode
from sidestep.loop.policies import as_policy
from sidestep.views.play import Hosting, Limits, make_app
from sidestep.views.play.server import PlayError, listen, make_server
from sidestep.views.play.session import Session
from sidestep.views.play.visitor import Gone, Outbox, TokenBucket, Visitor
from sidestep.world import Scenario

LIMITS = Limits(visitors=4, message_bytes=2048)
WAIT = 60.0


class Running:
    """A server in a thread of its own."""

    def __init__(self, app, port):
        self.app, self.port = app, port
        self.url = f"http://127.0.0.1:{port}"

    @contextmanager
    def visit(self, **options):
        """A connection that has been greeted."""
        with connect(f"ws://127.0.0.1:{self.port}/live", compression=None, **options) as socket:
            socket.hello = expect(socket, "hello")
            yield socket

    def get(self, path, **headers):
        """Status, headers, content, whatever the status."""
        request = urllib.request.Request(self.url + path, headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=WAIT) as answer:
                return answer.status, dict(answer.headers), answer.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, dict(error.headers), error.read()

    def visitors(self):
        return json.loads(self.get("/health")[2])["visitors"]

    def empty(self):
        until(lambda: self.visitors() == 0)


def until(condition):
    end = time.monotonic() + WAIT
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def say(socket, **message):
    socket.send(json.dumps(message))


def expect(socket, kind, condition=lambda message: True):
    """The next message of this kind for which the condition holds."""
    end = time.monotonic() + WAIT
    while time.monotonic() < end:
        message = json.loads(socket.recv(timeout=WAIT))
        if message["type"] == kind and condition(message):
            return message
    raise AssertionError(f"no such {kind}")


@pytest.fixture(scope="module")
def server():
    app = make_app(Hosting(Scenario(), shield="none", pursuer="nash", limits=LIMITS))
    uvicorn = make_server(app, LIMITS)
    with listen("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
        thread = threading.Thread(target=uvicorn.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        until(lambda: uvicorn.started)
        running = Running(app, port)
        until(lambda: app.state.programs.ready("none"))
        yield running
        uvicorn.should_exit = True
        thread.join(WAIT)
        assert not thread.is_alive()


@pytest.fixture(autouse=True)
def _nobody_is_left(server):
    yield
    server.empty()


def test_page_and_its_files_come_from_here_and_allow_nothing_else(server):
    for path in ("/", "/static/main.js", "/static/play.css"):
        status, headers, content = server.get(path)
        assert status == 200
        assert b"://" not in content.replace(b"http://www.w3.org/2000/svg", b"").replace(b"${scheme}://", b"")
        assert "default-src 'none'" in headers["content-security-policy"]


@pytest.mark.parametrize(
    "path", ["/static/../server.py", "/static/%2e%2e/server.py", "/episode/x.npz", "/etc"]
)
def test_nothing_else_is_served(server, path):
    assert server.get(path)[0] == 404


def test_world_moves_and_is_paused_and_stepped(server):
    with server.visit() as socket:
        frame = expect(socket, "frame", lambda frame: frame["pace"] == 1.0)
        expect(socket, "frame", lambda later: later["time"] >= frame["time"] + 0.2)
        say(socket, type="pause", paused=True)
        expect(socket, "setup", lambda setup: setup["paused"])
        still = expect(socket, "frame", lambda frame: frame["pace"] == 0.0)
        say(socket, type="step")
        stepped = expect(socket, "frame", lambda frame: frame["time"] > still["time"])
        assert stepped["time"] == pytest.approx(still["time"] + 0.05, abs=1e-3)


def test_the_visitor_drives_by_wheels_and_by_pointing(server):
    with server.visit() as socket:
        say(socket, type="drive", wheels=[-1, 1])
        expect(socket, "setup", lambda setup: setup["pursuer"] == "you")
        expect(socket, "frame", lambda frame: frame.get("wheels") == [[-0.2, 0.2]])
        frame = expect(socket, "frame")
        x, y, heading = frame["pursuers"][0]
        say(socket, type="drive", toward=[x + 5 * np.cos(heading), y + 5 * np.sin(heading)])
        expect(socket, "frame", lambda frame: min(frame.get("wheels", [[0]])[0]) > 0.15)
        say(socket, type="drive")
        expect(socket, "frame", lambda frame: frame.get("wheels") == [[0.0, 0.0]])


def test_a_robot_put_before_the_pursuer_is_caught_and_the_game_goes_on(server):
    with server.visit() as socket:
        scene = {
            "evader": [[0, 0]],
            "target": [[0, 1.4]],
            "pursuers": [[-0.3, 0, 0]],
            "obstacles": [[1, -1, 0, 0]],
        }
        say(socket, type="restore", shield="none", pursuer="nash", scene=scene)
        frame = expect(socket, "frame", lambda frame: frame["over"] == "captured")
        assert frame["score"]["tallies"]["none"]["captured"] == 1
        expect(socket, "frame", lambda frame: frame["over"] is None and frame["pace"] == 1.0)


def test_a_target_that_is_guarded_gives_way_to_another(server, monkeypatch):
    monkeypatch.setattr("sidestep.views.play.session.PATIENCE", 0.4)
    with server.visit() as socket:
        scene = {
            "evader": [[0, 0]],
            "target": [[40, 0]],
            "pursuers": [[-2, 0, 0]],
            "obstacles": [[1, -1, 0, 0]],
        }
        say(socket, type="restore", shield="none", pursuer="still", scene=scene)
        expect(socket, "frame", lambda frame: frame["target"] == [40.0, 0.0])
        frame = expect(socket, "frame", lambda frame: frame["target"] != [40.0, 0.0] and frame["pace"] == 1.0)
        assert max(map(abs, frame["target"])) <= 1.5
        assert frame["score"]["tallies"].get("none", {}).get("reached", 0) == 0


def test_numbers_change_the_verdict_and_compile_nothing(server):
    program = server.app.state.programs["none"]
    with server.visit() as socket:
        for values, kind in (({"evader_speed": 0.1}, "caught"), ({"evader_speed": 0.3}, "held")):
            say(socket, type="set", values=values)
            setup = expect(socket, "setup", lambda setup, kind=kind: setup["verdict"]["kind"] == kind)
            assert setup["numbers"]["evader_speed"] == values["evader_speed"]
            expect(socket, "frame", lambda frame: frame["pace"] == 1.0)
        say(socket, type="set", defaults=True)
        expect(socket, "setup", lambda setup: setup["numbers"] == socket.hello["defaults"])
    assert program._step._cache_size() == 1


def test_dragging_needs_a_pause_and_a_link_restores_the_scene(server):
    with server.visit() as socket:
        say(socket, type="move", what="evader", to=[1, 1])
        assert "pause" in expect(socket, "error")["text"]
        say(socket, type="pause", paused=True)
        say(socket, type="move", what="evader", to=[1.25, 1])
        frame = expect(socket, "frame", lambda frame: frame["evader"] == [1.25, 1])
        assert frame["pace"] == 0.0
        assert frame["cut"]


def test_an_episode_is_downloaded_as_everything_else_reads_it(server, tmp_path):
    with server.visit() as socket:
        expect(socket, "frame", lambda frame: frame["time"] >= 0.5)
        _, headers, content = server.get(f"/episode/{socket.hello['token']}.npz")
        assert "attachment" in headers["content-disposition"]
    (tmp_path / "episode.npz").write_bytes(content)
    episode = load_episode(tmp_path / "episode.npz")
    # With what an animation needs, too.
    assert float(episode.scenario.capture_distance) == pytest.approx(0.2)
    assert episode.about["source"] == "sidestep play"
    trajectory = episode.trajectory
    assert trajectory.length >= 9
    moved = np.diff(np.asarray(trajectory.worlds.evader), axis=0)
    np.testing.assert_allclose(moved, 0.05 * np.asarray(trajectory.action), atol=1e-5)


def test_garbage_and_floods_disturb_nobody(server):
    with server.visit() as other, server.visit() as socket:
        for number in range(1500):
            socket.send(("{", "x" * 900, '{"type":"drive","wheels":[9,9]}', b"\0\1")[number % 4])
        before = expect(other, "frame")
        expect(other, "frame", lambda frame: frame["frame"] > before["frame"] + 5)
        # The one who flooded is still there, and is heard again.
        end = time.monotonic() + WAIT
        while time.monotonic() < end:
            say(socket, type="pace", pace=0.5)
            if expect(socket, "frame")["pace"] == 0.5:
                break
        else:
            raise AssertionError("not heard again")


def test_a_message_of_ten_megabytes_ends_that_connection_only(server):
    with server.visit() as other:
        with server.visit() as socket:
            # Bytes left unread make the system reset the connection, and that may overtake the reason.
            with suppress(ConnectionClosed):
                socket.send("x" * 10_000_000)
            with pytest.raises(ConnectionClosed):
                expect(socket, "never")
        before = expect(other, "frame")
        expect(other, "frame", lambda frame: frame["frame"] > before["frame"] + 3)


def test_a_message_announced_too_long_is_refused_with_the_reason(server):
    with server.visit() as socket:
        text, masked_and_64_bit_length = 0x81, 0xFF
        head = struct.pack("!BBQ4s", text, masked_and_64_bit_length, 10_000_000, b"mask")
        with socket.protocol_mutex:
            socket.socket.sendall(head)
        with pytest.raises(ConnectionClosed) as closed:
            expect(socket, "never")
    assert closed.value.rcvd.code == 1009


@pytest.mark.parametrize("origin", ["http://example.org", "null", "http://127.0.0.1:1", "file://"])
def test_sockets_of_other_pages_are_refused(server, origin):
    with pytest.raises(InvalidStatus) as refused, server.visit(origin=origin):
        pass
    assert refused.value.response.status_code == 403


def test_our_own_origin_is_let_in_and_a_borrowed_name_is_not(server):
    with server.visit(origin=server.url) as socket:
        expect(socket, "frame")
    assert server.get("/", Host="rebound.example.org")[0] == 421


def test_one_visitor_too_many_is_told_so_and_may_come_later(server):
    with ExitStack() as all_of_them:
        for _ in range(LIMITS.visitors):
            all_of_them.enter_context(server.visit())
        with pytest.raises(ConnectionClosed) as closed, server.visit():
            pass
        assert closed.value.rcvd.code == 4013
    server.empty()
    with server.visit() as socket:
        expect(socket, "frame")


def test_visitors_who_vanish_leave_nothing_behind(server):
    for _ in range(50):
        with server.visit() as socket:
            # No goodbye: the connection is torn.
            socket.socket.shutdown(2)
        until(lambda: server.visitors() < LIMITS.visitors)
    server.empty()
    assert server.app.state.visitors == {}


def test_a_visitor_who_leaves_while_something_is_asked_is_gone(server):
    session = Session(server.app.state.programs, "none", "nash", LIMITS, 0)

    async def scene():
        said = False

        async def receive():
            nonlocal said
            if said:
                raise Gone("closed")
            said = True
            # Until the clock waits for the next period.
            await asyncio.sleep(0.03)
            return '{"type":"pause","paused":true}'

        async def send(text):
            pass

        with ThreadPoolExecutor(1) as workers:
            visitor = Visitor(session, LIMITS, workers, receive, send)
            async with asyncio.timeout(5.0):
                await visitor.run({"type": "hello"})

    asyncio.run(scene())


def test_a_slow_visitor_gets_the_latest_frame_and_no_backlog():
    async def scene():
        outbox = Outbox(ahead=2)
        sent = []

        async def speak():
            while True:
                sent.append((await outbox.take())["frame"])

        speaking = asyncio.ensure_future(speak())
        for number in range(1, 101):
            outbox.put({"type": "frame", "frame": number, "cut": number == 50})
            await asyncio.sleep(0)
            if number == 1:
                await asyncio.sleep(0)
                outbox.acknowledge(1)
        assert len(sent) <= 4
        outbox.acknowledge(sent[-1])
        await asyncio.sleep(0.01)
        speaking.cancel()
        return sent

    assert asyncio.run(scene())[-1] == 100


def test_what_a_replaced_frame_alone_said_is_not_lost():
    async def scene():
        outbox = Outbox(ahead=2)
        outbox.put({"type": "frame", "frame": 1, "cut": True, "reached": True})
        outbox.put({"type": "frame", "frame": 2, "cut": False, "reached": False})
        return await outbox.take()

    frame = asyncio.run(scene())
    assert frame == {"type": "frame", "frame": 2, "cut": True, "reached": True}


def test_an_allowance_fills_with_time_and_no_further_than_its_burst():
    now = [0.0]
    bucket = TokenBucket(10.0, 3, lambda: now[0])
    assert [bucket.take() for _ in range(4)] == [True, True, True, False]
    now[0] = 0.15
    assert [bucket.take() for _ in range(2)] == [True, False]
    now[0] = 99.0
    assert [bucket.take() for _ in range(4)] == [True, True, True, False]


@pytest.mark.parametrize("field, value", [("shield", "armour"), ("pursuer", "dog")])
def test_what_cannot_be_played_is_refused_at_the_start(field, value):
    with pytest.raises(ValueError, match=value):
        make_app(Hosting(Scenario(), **{field: value}))


def test_a_policy_that_is_no_name_is_played():
    policy = as_policy("goal-seeking", Scenario())
    assert not isinstance(policy, str)
    assert make_app(Hosting(Scenario(), policy=policy, shield="none")).state.visitors == {}


def test_the_command_refuses_with_words_and_status_2(capsys):
    with listen("127.0.0.1", 0) as taken:
        port = str(taken.getsockname()[1])
        assert main(["play", "--port", port]) == 2
    assert "--port" in capsys.readouterr().err
    assert main(["play", "--shield", "armour"]) == 2
    assert "armour" in capsys.readouterr().err


def test_a_taken_port_is_refused_with_words():
    with listen("127.0.0.1", 0) as taken, pytest.raises(PlayError, match="--port"):
        listen("127.0.0.1", taken.getsockname()[1])
