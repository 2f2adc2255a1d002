"""The report's player in a real browser: it shows what was recorded, alone, on every screen."""

import json
import time
from dataclasses import replace

import pytest

pytest.importorskip("playwright")
from playwright.sync_api import expect

from sidestep.views import write_report

WAIT = 60_000


@pytest.fixture(scope="module")
def report(tmp_path_factory, run_of, survey_of):
    run = replace(run_of("paper", seed=3), survey=survey_of())
    return write_report([run], tmp_path_factory.mktemp("page") / "report.html")


@pytest.fixture
def page(browser, report, request):
    """The report, which has had no error and has asked for nothing by the end of the test."""
    page = browser.new_context(**getattr(request, "param", {})).new_page()
    page.set_default_timeout(WAIT)
    errors, asked = [], []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.on("request", lambda request: asked.append(request.url))
    page.goto(report.as_uri())
    yield page
    assert errors == []
    assert [url for url in asked if not url.startswith("data:")] == [report.as_uri()]


def moment(page):
    """The time of the episode that the player shows, s."""
    return float(page.locator("#replay").get_attribute("data-time"))


def until(page, condition):
    end = time.monotonic() + WAIT / 1000
    while not condition():
        assert time.monotonic() < end, "waited too long"
        page.wait_for_timeout(50)


def colours(page, canvas):
    """How many different colours a canvas has."""
    return page.evaluate(
        "(name) => { const c = document.querySelector(name);"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        "const s = new Set();"
        "for (let i = 0; i < d.length; i += 52) s.add((d[i] << 16) | (d[i + 1] << 8) | d[i + 2]);"
        "return s.size; }",
        canvas,
    )


def test_an_episode_plays_pauses_and_ends_as_it_was_recorded(page, chase):
    recorded = chase()
    play, scrub, told = page.locator(".play"), page.locator(".scrub"), page.locator(".told")
    expect(page.locator(".episode option")).to_have_count(2)
    begun = moment(page)
    play.click()
    expect(play).to_have_text("Pause")
    until(page, lambda: moment(page) > begun + 0.3)
    play.focus()
    page.keyboard.press("Space")
    expect(play).to_have_text("Play")
    stood = moment(page)
    page.wait_for_timeout(300)
    assert moment(page) == stood
    scrub.focus()
    page.keyboard.press("Home")
    page.keyboard.press("ArrowRight")
    assert moment(page) == pytest.approx(0.05)
    # What is shown is what was recorded, to the millimetre.
    first = float(recorded.events.pursuer_clearance[0])
    expect(told).to_contain_text(f"{1000 * first:.1f} mm to capture" if first < 0.05 else f"{first:.2f} m")
    page.keyboard.press("End")
    expect(told).to_contain_text("captured")
    last = float(recorded.events.pursuer_clearance[-1])
    shown = float(told.inner_text().split("·")[1].split(" mm")[0].replace("−", "-"))
    assert shown == pytest.approx(1000 * last, abs=0.1)
    page.locator(".on").click()
    assert moment(page) == pytest.approx(0.05 * recorded.length, abs=1e-3)
    play.click()
    until(page, lambda: moment(page) < 1.0)


def test_speed_and_episode_are_chosen_with_the_keyboard(page):
    data = json.loads(page.locator("#replay-data").text_content())
    page.locator(".episode select").select_option("1")
    expect(page.locator(".episode option").nth(1)).to_contain_text(data[1]["group"])
    page.locator(".scrub").focus()
    page.keyboard.press("Home")
    page.locator(".pace select").select_option("4")
    page.locator(".stage .scrub").focus()
    page.keyboard.press("Space")
    until(page, lambda: moment(page) > 0.5)
    box = page.locator(".strip").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    expect(page.locator(".play")).to_have_text("Play")
    whole = 0.05 * page.evaluate("Number(document.querySelector('.scrub').max)")
    assert moment(page) == pytest.approx(whole / 2, rel=0.1)


@pytest.mark.parametrize(
    "page",
    [
        {"viewport": {"width": 390, "height": 844}, "has_touch": True, "color_scheme": "dark"},
        {"viewport": {"width": 1400, "height": 900}, "color_scheme": "light"},
    ],
    ids=["phone-dark", "desktop-light"],
    indirect=True,
)
def test_the_page_fits_and_the_scene_is_painted(page):
    width = page.viewport_size["width"]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for name in (".play", ".scrub", ".pace select", ".episode select", ".scene"):
        box = page.locator(name).bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width
    assert colours(page, ".scene") > 20
    assert colours(page, ".strip") > 5
    ink = page.evaluate("getComputedStyle(document.querySelector('.told')).color")
    dark = width < 1000
    assert (int(ink.removeprefix("rgb(").split(",")[0]) > 128) == dark


@pytest.mark.parametrize("page", [{"viewport": {"width": 390, "height": 844}}], indirect=True)
def test_no_column_of_a_table_is_out_of_view_on_a_phone(page):
    boxes = page.evaluate(
        "[...document.querySelectorAll('.scroll')].map((e) => [e.scrollWidth, e.clientWidth])"
    )
    assert boxes
    assert all(needed <= there for needed, there in boxes)
    right = page.evaluate(
        "Math.max(...[...document.querySelectorAll('.scroll td, .scroll th')]"
        ".map((e) => e.getBoundingClientRect().right))"
    )
    assert right <= 390
