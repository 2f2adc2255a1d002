"""The live page in a real browser, against the real server: what a person does with it."""

import threading
import time

import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
pytest.importorskip("playwright")
from playwright.sync_api import expect

from sidestep.views.play import Hosting, Limits, make_app
from sidestep.views.play.server import listen, make_server
from sidestep.world import load_scenario

WAIT = 60_000
BESIDE = "#shield={shield}&pursuer=nash&evader=0,0&target=0,1.4&p=-0.35,0,0&o=1.2,-1.2,0,0"
"""A link: the robot right before the pursuer, which must give way at once or be caught."""
AHEAD = "#shield=none&pursuer=you&evader=0,0&target=1.4,0&p=-0.35,0,0&o=0,-1.2,0,0"
"""A link: the robot drives straight away from the pursuer, which is faster."""


@pytest.fixture(scope="module")
def address():
    limits = Limits()
    app = make_app(Hosting(load_scenario("paper"), limits=limits, shield="none"))
    server = make_server(app, limits)
    with listen("127.0.0.1", 0) as listener:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}/"
        server.should_exit = True
        thread.join(60)


@pytest.fixture
def page(browser, address, request):
    """A page that is ready, and that has had no error by the end of the test."""
    options = {"viewport": {"width": 1280, "height": 760}, **getattr(request, "param", {})}
    context = browser.new_context(**options)
    context.grant_permissions(["clipboard-read", "clipboard-write"], origin=address)
    page = context.new_page()
    page.set_default_timeout(WAIT)
    errors, foreign = [], []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.on("request", lambda asked: None if asked.url.startswith(address) else foreign.append(asked.url))
    page.goto(address)
    ready(page)
    yield page
    assert errors == []
    assert foreign == []


def ready(page):
    page.wait_for_selector('body[data-connected="yes"][data-ready="yes"]')


def seconds(page):
    """The time survived that the page shows."""
    return float(page.locator("#score-survived").inner_text().split("\u202f")[0])


def until(page, condition):
    end = time.monotonic() + WAIT / 1000
    while not condition():
        assert time.monotonic() < end, "waited too long"
        page.wait_for_timeout(50)


def painted(page):
    """How many different colours the scene has."""
    return page.evaluate(
        "() => { const c = document.getElementById('scene');"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        "const s = new Set();"
        "for (let i = 0; i < d.length; i += 52) s.add((d[i] << 16) | (d[i + 1] << 8) | d[i + 2]);"
        "return s.size; }"
    )


def test_keys_drive_the_pursuer_and_pause_stops_the_world(page):
    until(page, lambda: seconds(page) > 0.3)
    assert painted(page) > 20
    before = page.evaluate("location.href")
    page.locator("#scene").focus()
    page.keyboard.down("ArrowUp")
    page.wait_for_timeout(400)
    page.keyboard.up("ArrowUp")
    page.keyboard.press("Space")
    expect(page.locator("#pause")).to_have_attribute("aria-pressed", "true")
    stood = seconds(page)
    page.wait_for_timeout(300)
    assert seconds(page) == stood
    page.keyboard.press("n")
    until(page, lambda: seconds(page) >= stood)
    assert page.evaluate("location.href") == before


@pytest.mark.parametrize(
    "page",
    [{"viewport": {"width": width, "height": 760}} for width in (1280, 1440, 1920)],
    ids=["laptop", "desktop", "projector"],
    indirect=True,
)
def test_counters_of_an_hour_do_not_lie_under_the_verdict(page):
    page.evaluate(
        "() => { for (const id of ['score-survived', 'score-longest'])"
        " document.getElementById(id).textContent = '3599.9\u202fs'; }"
    )
    edge = "() => document.getElementById('{}').getBoundingClientRect().{}"
    assert page.evaluate(edge.format("verdict", "right")) <= page.evaluate(edge.format("score", "left"))


def test_a_person_catches_the_robot_without_a_shield(page, address):
    page.goto(address + AHEAD)
    page.reload()
    ready(page)
    page.locator("#scene").focus()
    page.keyboard.down("KeyW")
    expect(page.locator("#banner b")).to_have_text("You caught it", timeout=WAIT)
    page.keyboard.up("KeyW")
    assert page.locator("#score-captured").inner_text() == "1"


@pytest.mark.parametrize("shield", ["game", pytest.param("joint", marks=pytest.mark.slow)])
def test_behind_a_shield_that_holds_nobody_catches_it(page, address, shield):
    page.goto(address + BESIDE.format(shield=shield))
    page.reload()
    ready(page)
    until(page, lambda: seconds(page) > 6.0)
    assert page.locator("#score-captured").inner_text() == "0"


def test_sliders_change_the_verdict_at_once_and_back(page):
    verdict = page.locator("#verdict")
    expect(verdict).to_have_attribute("data-kind", "open")
    page.locator("#slider-capture_distance").fill("0.3")
    expect(verdict).to_have_attribute("data-kind", "caught")
    expect(verdict).to_contain_text("it can be caught")
    page.locator("#slider-capture_distance").fill("0.1")
    expect(verdict).to_contain_text("cannot be caught")
    page.locator("#defaults").click()
    expect(page.locator("#value-capture_distance")).to_have_text("0.200 m")


def test_things_are_dragged_while_paused_and_a_link_keeps_them(page):
    page.locator("#pause").click()
    expect(page.locator("#pause")).to_have_attribute("aria-pressed", "true")
    # Choose with the keyboard what is moved: the first is the robot.
    page.locator("#scene").focus()
    page.keyboard.press(".")
    page.keyboard.press("ArrowRight")
    page.wait_for_timeout(300)
    page.locator("#link").click()
    first = page.evaluate("location.hash")
    page.locator("#scene").focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_timeout(300)
    page.locator("#link").click()
    second = page.evaluate("location.hash")

    assert evader(second)[0] == pytest.approx(evader(first)[0] + 0.05, abs=2e-3)
    assert page.evaluate("navigator.clipboard.readText()") == page.url
    page.reload()
    ready(page)
    assert page.evaluate("location.hash") == second


def evader(link):
    """Where a link says that the robot is."""
    return [float(value) for value in link.split("evader=")[1].split("&")[0].split(",")]


def test_the_mouse_drags_what_it_points_at(page, address):
    page.goto(address + BESIDE.format(shield="none"))
    page.reload()
    ready(page)
    page.locator("#pause").click()
    expect(page.locator("#pause")).to_have_attribute("aria-pressed", "true")
    page.wait_for_timeout(1500)
    at = page.evaluate("() => JSON.parse(document.getElementById('scene').dataset.evader ?? 'null')")
    box = page.locator("#scene").bounding_box()
    page.locator("#link").click()
    before = evader(page.url)
    page.mouse.move(box["x"] + at[0], box["y"] + at[1])
    page.mouse.down()
    page.mouse.move(box["x"] + at[0] + 60, box["y"] + at[1], steps=4)
    page.mouse.up()
    page.wait_for_timeout(300)
    page.locator("#link").click()
    assert evader(page.url)[0] > before[0] + 0.1
    assert evader(page.url)[1] == pytest.approx(before[1], abs=0.02)


def test_an_episode_is_downloaded(page, tmp_path):
    until(page, lambda: seconds(page) > 0.3)
    with page.expect_download() as download:
        page.locator("#download-npz").click()
    path = tmp_path / download.value.suggested_filename
    download.value.save_as(path)
    assert path.read_bytes()[:2] == b"PK"


@pytest.mark.parametrize(
    "page", [{"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}], indirect=True
)
def test_on_a_phone_everything_fits_and_a_finger_drives(page):
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for name in ("#pause", "#reset", "#more", "#score", "#verdict"):
        box = page.locator(name).bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
        assert box["y"] + box["height"] <= 844
    page.locator("#more").tap()
    expect(page.locator("#panel")).to_be_visible()
    page.locator("#shield-game").check(force=True)
    expect(page.locator("#shield-words")).to_contain_text("game")


@pytest.mark.parametrize("page", [{"color_scheme": "dark"}, {"color_scheme": "light"}], indirect=True)
def test_the_colours_follow_the_computer(page, request):
    paper = page.evaluate("getComputedStyle(document.body).color").removeprefix("rgb(").split(",")
    light_text = int(paper[0]) > 128
    assert light_text == (request.node.callspec.params["page"]["color_scheme"] == "dark")


def test_pictures_rest_where_inputs_come_late_to_the_screen_and_not_for_ever(page):
    rests = page.evaluate(
        """async () => {
          const { Pictures } = await import("/static/pictures.js");
          const real = performance.now.bind(performance);
          let ahead = 0;
          performance.now = () => real() + ahead;
          const pictures = new Pictures(() => {});
          let rests = 0;
          const rest = pictures.rest.bind(pictures);
          pictures.rest = (now) => { rests += 1; rest(now); };
          const felt = (duration, times) => {
            for (let i = 0; i < times; i++) pictures.felt(duration);
            return rests;
          };
          const told = [felt(24, 50), felt(48, 4), felt(24, 1), felt(48, 4), felt(48, 1)];
          told.push(felt(48, 50)); // too soon after the last
          for (let i = 0; i < 9; i++) { ahead += 5000; felt(48, 5); }
          told.push(rests); // in vain: the computer is slow
          felt(24, 1);
          ahead += 5000;
          told.push(felt(48, 5)); // it was not always
          performance.now = real;
          return told;
        }"""
    )
    assert rests == [0, 0, 0, 0, 1, 1, 3, 4]


def test_after_a_rest_pictures_go_on(page):
    during, after = page.evaluate(
        """async () => {
          const { Pictures } = await import("/static/pictures.js");
          const times = [];
          const pictures = new Pictures((now) => times.push(now));
          const drawn = async (count) => {
            while (times.length < count) await new Promise((done) => setTimeout(done, 5));
          };
          await drawn(5);
          const before = times.length;
          pictures.rest();
          await drawn(before + 20);
          const gaps = times.slice(before).map((now, i) => now - times[before + i - 1]);
          return [Math.max(...gaps), times.length];
        }"""
    )
    assert during >= 60.0
    assert after >= 20


def test_words_under_a_shield_follow_what_the_numbers_allow(page, address):
    words = page.locator("#shield-words")
    page.goto(address + "#shield=game&pursuer_speed=0.26")
    page.reload()
    expect(words).to_contain_text("the best pursuer wins", timeout=WAIT)
    expect(words).not_to_contain_text("nobody should catch it")
    page.locator("#defaults").click()
    expect(words).to_contain_text("the robot wins the game", timeout=WAIT)


@pytest.mark.parametrize(
    "page", [{}, {"viewport": {"width": 390, "height": 844}}], indirect=True, ids=["wide", "phone"]
)
def test_warming_up_covers_no_robot(page, address):
    page.goto(address + AHEAD)
    page.reload()
    ready(page)
    page.locator("#scene").focus()
    page.keyboard.press("Space")
    page.evaluate("document.getElementById('warming').hidden = false")
    page.wait_for_timeout(6000)
    bottom = page.evaluate("document.getElementById('warming').getBoundingClientRect().bottom")
    _x, y = page.evaluate("JSON.parse(document.getElementById('scene').dataset.evader)")
    assert y > bottom
    assert page.evaluate("document.getElementById('warming').getBoundingClientRect().height") < 170
