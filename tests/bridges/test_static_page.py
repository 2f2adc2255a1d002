"""The page without a server: a folder of files, in a real browser and beside the live page's own session."""

import functools
import gzip
import http.server
import json
import subprocess
import sys
import threading
import time

import jax.numpy as jnp
import numpy as np
import pytest

from sidestep.bridges.export.parity import answers, random_states
from sidestep.bridges.static_page import write_page
from sidestep.bridges.static_page.engine import Engine, packed, tables_for
from sidestep.cli import main
from sidestep.learning import load_policy
from sidestep.loop.policies import as_policy
from sidestep.views.play import Hosting, Limits
from sidestep.views.play.server import endless
from sidestep.views.play.sliders import SLIDERS, numbers_of, with_numbers
from sidestep.world import load_scenario

WAIT = 60_000
BESIDE = "#shield={shield}&pursuer=nash&evader=0,0&target=0,1.4&p=-0.35,0,0&o=1.2,-1.2,0,0"
"""A link: the robot right before the pursuer, which must give way at once or be caught."""
AHEAD = "#shield=none&pursuer=you&evader_speed=0.05&evader=0,0&target=1.4,0&p=-0.35,0,0&o=0,-1.2,0,0"
"""A link: a slow robot before the pursuer of whoever is at the page."""
PLACE = {
    "evader": [[0.0, 0.0]], "target": [[1.2, 0.9]], "pursuers": [[-0.23, 0.0, 0.0]],
    "obstacles": [[0.5, -0.9, 0.02, 0.01]],
}  # fmt: skip


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *words):
        pass


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The page of `sidestep play --static`, written by a process that does not check every call's types."""
    folder = tmp_path_factory.mktemp("host") / "below" / "page"
    command = [sys.executable, "-m", "sidestep", "play", "--static", folder]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert f"--directory {folder}" in done.stdout
    return folder


@pytest.fixture(scope="module")
def address(folder):
    """Where any web server has it, below a path."""
    handler = functools.partial(_Quiet, directory=folder.parents[1])
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/below/page/"
        server.shutdown()


@pytest.fixture
def page(browser, address, request):
    """The page, which has had no error and asked nobody else by the end of the test."""
    options = {"viewport": {"width": 1280, "height": 760}, **getattr(request, "param", {})}
    context = browser.new_context(**options)
    page = context.new_page()
    page.set_default_timeout(WAIT)
    errors, foreign = [], []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.on("request", lambda asked: None if asked.url.startswith(address) else foreign.append(asked.url))
    page.on("websocket", lambda socket: foreign.append(socket.url))
    visit(page, address)
    yield page
    assert errors == []
    assert foreign == []


def visit(page, url):
    page.goto("about:blank")
    page.goto(url)
    page.wait_for_selector('body[data-connected="yes"]')


def seconds(page):
    """The time survived that the page shows."""
    return float(page.locator("#score-survived").inner_text().split("\u202f")[0])


def until(page, condition):
    end = time.monotonic() + WAIT / 1000
    while not condition():
        assert time.monotonic() < end, "waited too long"
        page.wait_for_timeout(50)


def expect(locator):
    from playwright.sync_api import expect

    return expect(locator)


def test_the_folder_is_small_and_says_what_it_is(folder):
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 3e6
    assert {path.suffix for path in files} == {".html", ".js", ".css", ".svg", ".json", ".bin"}
    about = json.loads((folder / "static" / "page.json").read_text())
    assert about["hello"]["shields"] == ["none", "paper", "game", "joint"]
    assert about["hello"]["policy"] == "learned"
    assert len(about["tables"]) == 3


def test_a_person_catches_the_robot_without_a_shield(page, address):
    visit(page, address + AHEAD)
    page.locator("#scene").focus()
    page.keyboard.down("KeyW")
    expect(page.locator("#banner b")).to_have_text("You caught it", timeout=WAIT)
    page.keyboard.up("KeyW")
    assert page.locator("#score-captured").inner_text() == "1"
    expect(page.locator("#banner")).to_be_hidden(timeout=WAIT)


@pytest.mark.parametrize("shield", ["joint", pytest.param("game", marks=pytest.mark.slow)])
def test_behind_a_shield_that_holds_nobody_catches_it(page, address, shield):
    visit(page, address + BESIDE.format(shield=shield))
    until(page, lambda: seconds(page) > 5.0)
    assert page.locator("#score-captured").inner_text() == "0"
    words = page.locator("#shield-words").inner_text()
    assert ("without the look-ahead" in words) == (shield == "joint")


def test_a_slider_to_numbers_without_a_table_says_so_and_offers_game(page):
    verdict, warming = page.locator("#verdict"), page.locator("#warming")
    expect(verdict).to_have_attribute("data-kind", "open")
    expect(warming).to_be_hidden()
    page.locator("#slider-capture_distance").fill("0.15")
    expect(page.locator("#shield-words")).to_contain_text("1 of 100 test chases")
    page.locator("#slider-pursuer_half_axle").fill("0.25")
    expect(warming).to_contain_text("No clearance table for these numbers")
    expect(page.locator("#shield-words")).to_contain_text("none for these numbers")
    stood = seconds(page)
    page.wait_for_timeout(300)
    assert seconds(page) == stood
    page.get_by_role("button", name="Take the shield game").click()
    expect(warming).to_be_hidden()
    expect(page.locator("#shield-game")).to_be_checked()
    until(page, lambda: seconds(page) > 0.2)
    page.locator("#slider-capture_distance").fill("0.4")
    expect(verdict).to_have_attribute("data-kind", "caught")
    page.locator("#defaults").click()
    expect(page.locator("#value-capture_distance")).to_have_text("0.200 m")
    expect(verdict).to_contain_text("Not certified at 20 decisions a second")


def test_keys_pause_step_drag_and_keep_a_link(page):
    until(page, lambda: seconds(page) > 0.2)
    page.locator("#scene").focus()
    page.keyboard.press("Space")
    expect(page.locator("#pause")).to_have_attribute("aria-pressed", "true")
    stood = seconds(page)
    for _ in range(4):
        page.keyboard.press("n")
    until(page, lambda: seconds(page) >= round(stood + 0.1, 1))
    page.keyboard.press(".")
    page.locator("#link").click()
    first = page.evaluate("location.hash")
    page.locator("#scene").focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_timeout(100)
    page.locator("#link").click()
    second = page.evaluate("location.hash")
    at = [float(link.split("evader=")[1].split(",")[0]) for link in (first, second)]
    assert at[1] - at[0] == pytest.approx(0.05, abs=2e-3)
    assert page.locator("#downloads a").count() == 0
    assert page.locator("#show-plan").is_hidden()


@pytest.mark.parametrize(
    "page", [{"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}], indirect=True
)
def test_on_a_phone_a_finger_drives_and_everything_fits(page):
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.locator("#more").tap()
    page.locator("#pursuer").select_option("still")
    expect(page.locator("#task")).to_contain_text("still hunts")
    page.locator("#more").tap()
    page.locator("#scene").tap(position={"x": 200, "y": 400})
    expect(page.locator("#task")).to_contain_text("You drive")


def test_the_first_picture_comes_soon_and_periods_cost_little(page, address):
    page.add_init_script(
        "addEventListener('DOMContentLoaded', () => new MutationObserver(() => {"
        " if (!document.body.dataset.ready) return;"
        " requestAnimationFrame(() => { window.first ??= performance.now(); });"
        "}).observe(document.body, { attributes: true }))"
    )
    visit(page, address)
    until(page, lambda: page.evaluate("window.first") is not None)
    assert page.evaluate("window.first") < 2000.0
    median = page.evaluate(
        """async () => {
          const { Engine } = await import("./static/engine.js");
          const { Session } = await import("./static/session.js");
          const session = new Session(...(await Engine.load()));
          session.apply({ type: "pick", shield: "joint", pursuer: "nash" });
          const times = [];
          for (let k = 0; k < 400; k++) {
            const begun = performance.now();
            session.advance();
            times.push(performance.now() - begun);
            if (session.outcome) session.restart();
          }
          return times.sort((a, b) => a - b)[200];
        }"""
    )
    assert median < 4.0  # ms of the 16 between two pictures


def test_its_session_goes_as_that_of_the_live_page(folder, scenario, node, tmp_path):
    """The same messages, period by period, from the same scene."""
    from sidestep.views.play.messages import Restore, Scene, Show
    from sidestep.views.play.programs import Programs
    from sidestep.views.play.session import Session

    programs = Programs(scenario, as_policy(load_policy("pretrained"), scenario))
    session = Session(programs, "none", "nash", Limits(), 0)
    while not session.ready:
        time.sleep(0.05)
    programs.close()
    scene = Scene(**{name: [tuple(row) for row in rows] for name, rows in PLACE.items()})
    session.apply(Restore("none", "nash", {"obstacle_speed": 0.03}, scene))
    session.apply(Show(rows=True, plan=False))
    wanted = []
    for _ in range(90):
        wanted.append(session.advance())
    wanted += [session.setup()]

    script = tmp_path / "session.mjs"
    script.write_text(
        f"""
import fs from "node:fs";
import {{ gunzipSync }} from "node:zlib";
import {{ Engine, singles }} from {json.dumps((folder / "static/engine.js").as_uri())};
import {{ Session }} from {json.dumps((folder / "static/session.js").as_uri())};
const about = JSON.parse(fs.readFileSync({json.dumps(str(folder / "static/page.json"))}));
const code = gunzipSync(fs.readFileSync({json.dumps(str(folder / "static/engine.bin"))}));
const {{ instance }} = await WebAssembly.instantiate(code, {{ math: singles(about.imports) }});
const session = new Session(about, new Engine(instance.exports, about.areas));
session.apply({{ type: "restore", shield: "none", pursuer: "nash", values: {{ obstacle_speed: 0.03 }},
  scene: {json.dumps(PLACE)} }});
session.apply({{ type: "show", rows: true, plan: false }});
const said = [];
for (let k = 0; k < 90; k++) said.push(session.advance());
said.push(session.setup());
console.log(JSON.stringify(said));
"""
    )
    done = subprocess.run([node, script], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert any(frame["over"] for frame in wanted[:-1])
    for mine, live in zip(found[:-1], wanted[:-1], strict=True):
        del mine["frame"], live["frame"]
        assert_alike(mine, live)
    setup, live = found[-1], wanted[-1]
    # The certificate is not computed in the browser.
    assert setup.pop("states") != live.pop("states")
    assert (setup["verdict"].pop("kind"), live["verdict"].pop("kind")) == ("unsure", "unsure")
    assert_alike(setup, live)


def assert_alike(mine, live):
    """Equal but for rounding."""
    if isinstance(live, dict):
        assert mine.keys() == live.keys()
        for key in live:
            assert_alike(mine[key], live[key])
    elif isinstance(live, list):
        assert len(mine) == len(live)
        for one, other in zip(mine, live, strict=True):
            assert_alike(one, other)
    else:
        assert mine == (pytest.approx(live, abs=2e-4) if isinstance(live, float) else live)


# Sliders' numbers, and what is no number at all: everything that the page can ask of the engine.

DISCRETE = ("status", "captured", "collided", "reached", "timed_out", "looking")
MOST = 1e30
"""Two infinite numbers have no difference, and differences are added up."""
CHOSEN = ("renew", "ask", "strategy", "mode", "count", "words", "draws")
"""Inputs that are not measured, so that rounding does not touch them."""


@pytest.fixture(scope="module")
def scenario():
    return endless(load_scenario("paper", observation="motion"))


@pytest.fixture(scope="module")
def engine(scenario):
    """The page's functions as they were before they were translated."""
    return Engine(scenario, as_policy(load_policy("pretrained"), scenario))


@pytest.fixture(scope="module")
def binary(folder, engine):
    """The page's module, with the areas of these functions."""
    about = json.loads((folder / "static" / "page.json").read_text())
    assert about["areas"] == packed(engine.areas)
    return gzip.decompress((folder / "static" / "engine.bin").read_bytes())


def asked(engine, scenario, name, count):
    """Values of every input of a function, (count, ...) each."""
    rng, state = np.random.default_rng(3), random_states(scenario, count, 5)
    low, high = (np.array([getattr(slider, end) for slider in SLIDERS]) for end in ("low", "high"))
    numbers = rng.uniform(low, high, (count, len(SLIDERS)))
    if name.startswith("step joint"):
        table = engine.tables[int(name.split()[-1])].game
        of = {"pursuer_half_axle": "half_axle"}
        numbers[:] = [getattr(table, of.get(slider.name, slider.name)) for slider in SLIDERS]
    state |= {
        "numbers": numbers,
        "held": state["wish"],
        "wheels": state["wheel_speeds"] + rng.normal(0.0, 0.05, state["wheel_speeds"].shape),
        "renew": rng.integers(0, 2, count),
        "ask": rng.integers(0, 2, count),
        "strategy": rng.integers(0, 7, count),
        "mode": rng.integers(0, 3, count),
        "count": rng.integers(0, 10**6, count),
        "words": rng.integers(-(2**20), 2**20, (count, 2)),
        "draws": rng.uniform(-1.0, 1.0, (count, *engine.areas["draws"].shape)),
        "command": rng.uniform(-1.0, 1.0, (count, 2)),
    }
    for given in engine.functions[name].inputs:
        area = engine.areas[given]
        values = state.get(given, rng.integers(-1, 2, (count, *area.shape)))
        state[given] = values.astype({"f": np.float32, "i": np.int32, "b": bool}[area.kind])
    return state


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in
        ("ask", "step paper", "step game", "step joint 0", "step joint 1", "step joint 2")]  # fmt: skip


@pytest.mark.parametrize("name", ["draw", "look", "step none", *SLOW])
def test_functions_answer_as_in_jax(engine, scenario, binary, answers_of, name):
    count, function = 1000, engine.functions[name]
    state = asked(engine, scenario, name, count)
    inputs = sorted(function.inputs, key=lambda given: given in CHOSEN)
    kinds = {given: engine.areas[given].kind for given in function.outputs}
    outputs = sorted(kinds, key=lambda given: given in DISCRETE or kinds[given] != "f")
    loose = [given for given in outputs if given not in DISCRETE and kinds[given] == "f"]

    def ordered(*values):
        given = dict(zip(inputs, values, strict=True))
        found = function.function(*(given[one] for one in function.inputs))
        found = dict(zip(function.outputs, found, strict=True))
        return tuple(jnp.clip(found[one].astype(float), -MOST, MOST) for one in outputs)

    values = [state[given] for given in inputs]
    width = sum(engine.areas[given].size for given in loose)
    measured = sum(given not in CHOSEN for given in inputs)
    wanted, allowed = answers(ordered, values, measured=measured, loose=width, seed=2)
    flat = np.concatenate([value.reshape(count, -1).astype(np.float32) for value in values], 1)
    areas = [[engine.areas[given] for given in group] for group in (inputs, outputs)]
    found = answers_of(binary, name, *areas, flat)
    found = np.clip(found, -MOST, MOST)
    sure = np.isfinite(allowed)
    assert np.mean(sure) > 0.85
    off = np.where(np.isnan(found) & np.isnan(wanted), 0.0, np.abs(found - wanted))
    assert np.all(np.max(off[sure, :width], 1, initial=0.0) <= allowed[sure])
    assert np.all(off[sure, width:] == 0.0)


def test_tables_serve_as_make_shield_says(engine, scenario, binary, answers_of):
    tables = tables_for(scenario)
    assert [table.periods is None for table in tables] == [True, True, False]
    hard = {"evader_speed": 0.15, "pursuer_speed": 0.21, "pursuer_half_axle": 0.19, "obstacle_speed": 0.03}
    easy = {"evader_speed": 0.17, "capture_distance": 0.12, "collision_distance": 0.15, "obstacle_speed": 0.0}
    changes = [
        {},
        *({name: value} for name, value in (hard | easy).items()),
        easy,
        {"capture_distance": 0.2002},
        {"capture_distance": 0.1},
    ]
    rows, wanted = [], []
    world = {given: np.zeros(engine.areas[given].size) for given in engine.functions["look"].inputs}
    start = numbers_of(scenario)
    for change in changes:
        changed = with_numbers(scenario, start | change)
        wanted.append([not table.game.refuses(changed) for table in tables])
        world["numbers"] = np.array([(start | change)[slider.name] for slider in SLIDERS])
        rows.append(np.concatenate(list(world.values())))
    inputs = [engine.areas[given] for given in world]
    found = answers_of(binary, "look", inputs, [engine.areas["serve"]], np.array(rows))
    np.testing.assert_array_equal(found, np.array(wanted, np.float32))
    assert {tuple(row) for row in wanted} >= {(False, False, True), (True, True, True), (False, False, False)}


@pytest.mark.parametrize("change", [{"obstacle_count": 2}, {"pursuer_count": 2}, {"obstacle_count": 0}])
def test_a_table_is_for_one_pursuer_and_one_obstacle(change):
    assert tables_for(load_scenario("paper", **change)) == []


def refused(capsys, *arguments):
    assert main(["play", "goal-seeking", *map(str, arguments)]) == 2
    return capsys.readouterr().err


def test_refusals_come_before_anything_is_written(capsys, tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("...")
    assert "holds other files" in refused(capsys, "--static", mine)
    assert "is a file, not a folder" in refused(capsys, "--static", mine / "thesis.tex")
    assert "thesis.tex" in refused(capsys, "--static", mine / "thesis.tex" / "page")
    new = tmp_path / "new"
    for option, value in (("--port", 8000), ("--seed", 1), ("--allow-host", "x"), ("--visitors", 2)):
        assert f"{option} is about the page that is served" in refused(capsys, "--static", new, option, value)
    assert "--open is about" in refused(capsys, "--static", new, "--open")
    assert "no shield 'strong'" in refused(capsys, "--static", new, "--shield", "strong")
    assert "no pursuer 'fast'" in refused(capsys, "--static", new, "--pursuer", "fast")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["mine", "thesis.tex"]


def test_a_policy_that_cannot_be_translated_writes_nothing(tmp_path):
    def policy(observation):
        return jnp.sort(jnp.linalg.eigvalsh(jnp.outer(observation[:2], observation[:2])))

    with pytest.raises(ValueError, match="cannot translate"):
        write_page(tmp_path / "page", Hosting(load_scenario("paper"), policy))
    assert list(tmp_path.iterdir()) == []
