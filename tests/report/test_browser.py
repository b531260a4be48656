"""The page in a real browser: Debian's Chromium, headless, with the network off.

The browser is the one RETWIN_BROWSER names, else `chromium`. Without it these tests are skipped;
where RETWIN_BROWSER is set, as `.ci/run` sets it, a missing browser is a failure.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect, sync_playwright

import retwin as rt
from retwin.report.figures.style import CHROME

pytestmark = pytest.mark.slow
PATIENCE = 120_000  # ms, for machines that are busy
# The last one draws in space without a graphics card.
OPTIONS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
SCREEN = {"width": 1280, "height": 900}
PHONE = {"width": 375, "height": 800}
READY = 10_000  # ms: below 1 s on two quiet cores, but tests share theirs
A4 = {"width": 695, "height": 1000}
"""What is left of a sheet within its margins, in CSS pixels."""


@dataclass
class Opened:
    """A page, its errors, the addresses that it requested, and when it was ready, in ms."""

    page: Page
    errors: list[str] = field(default_factory=list)
    requested: list[str] = field(default_factory=list)
    ready: float = 0.0


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    wanted = os.environ.get("RETWIN_BROWSER")
    path = shutil.which(wanted or "chromium")
    if path is None and wanted:
        pytest.fail(f"RETWIN_BROWSER is {wanted}, which is not installed")
    if path is None:
        pytest.skip("no Chromium: apt-get install chromium, or name one in RETWIN_BROWSER")
    with sync_playwright() as play:
        started = play.chromium.launch(executable_path=path, args=OPTIONS, timeout=PATIENCE)
        yield started
        started.close()


@pytest.fixture(scope="module")
def study_page(
    case: rt.Case,
    twin_set: rt.Trajectories,
    emulated: rt.Trajectories,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A study of the emulated robot, small, made as any other."""
    out = tmp_path_factory.mktemp("page")
    place = np.array([np.flatnonzero(emulated.labels == name)[:5] for name in case.classes])
    parts = {
        "twin": twin_set[::3],
        "calibration": emulated[place[:, :3].ravel()],
        "test": emulated[place[:, 3:].ravel()],
    }
    for name, part in parts.items():
        rt.save(part, out / f"{name}.npz")
    plan = rt.StudyPlan(sources=("dt", "ibg_rg"), runs=1, per_class=5, seed=3)
    data = rt.StudyData(**{name: out / f"{name}.npz" for name in parts})
    rt.run_study(case, plan, data, out / "study", processes=1)
    return rt.write_report(out / "study")


def opened(browser: Browser, file: Path, **options: Any) -> Opened:
    """The page in a window of its own, drawn, and listened to from the beginning."""
    found = Opened(browser.new_context(offline=True, **options).new_page())
    page = found.page
    page.set_default_timeout(PATIENCE)
    page.on("console", lambda entry: entry.type == "error" and found.errors.append(entry.text))
    page.on("pageerror", lambda error: found.errors.append(str(error)))
    page.on("request", lambda request: found.requested.append(request.url))
    page.goto(file.as_uri())
    page.locator("#plot-summary-0").scroll_into_view_if_needed()  # on a phone it is further down
    page.wait_for_selector("#plot-summary-0 .main-svg")
    found.ready = page.evaluate("performance.now()")
    page.evaluate("document.getElementById('unfold').click()")
    page.wait_for_selector("#explore[data-ready]", state="attached")
    for place in page.locator(".picture").all():  # plots are drawn when they come near the screen
        place.scroll_into_view_if_needed()
        place.locator(".main-svg").first.wait_for(state="attached")
    page.evaluate("scrollTo(0, 0)")
    return found


@pytest.fixture(scope="module")
def desk(browser: Browser, study_page: Path) -> Opened:
    """On a desk; light unless a test changes it."""
    return opened(browser, study_page, viewport=SCREEN, color_scheme="light")


@pytest.fixture(scope="module")
def phone(browser: Browser, study_page: Path) -> Opened:
    return opened(browser, study_page, viewport=PHONE)


@pytest.fixture
def dark(desk: Opened) -> Iterator[Page]:
    """The same page in the dark, once its pictures have followed."""
    desk.page.evaluate("scrollTo(0, 0)")
    desk.page.emulate_media(color_scheme="dark")
    expect(desk.page.locator(".xtitle").first).to_have_css("fill", rgb(CHROME["muted"][1]))
    yield desk.page
    desk.page.emulate_media(color_scheme="light")
    expect(desk.page.locator(".xtitle").first).to_have_css("fill", rgb(CHROME["muted"][0]))


def rgb(colour: str) -> str:
    """`#rrggbb` as browsers write it."""
    return f"rgb({', '.join(str(int(colour[at : at + 2], 16)) for at in (1, 3, 5))})"


def explored(page: Page) -> tuple[str, list[float]]:
    """The trajectory that the explorer names, and what it draws of it."""
    drawn: list[float] = page.evaluate(
        "document.getElementById('explore-outputs').data.find((t) => t.name === 'measured').y"
    )
    return page.locator("#explore-pick option:checked").inner_text(), drawn


def issues(page: Page) -> list[tuple[str, str]]:
    """What axe-core finds, of whatever impact: the rule, and where."""
    return [
        (each["id"], node["html"][:120])
        for each in Axe().run(page).response["violations"]
        for node in each["nodes"]
    ]


def test_it_opens_from_a_file_without_network_and_without_errors(desk: Opened) -> None:
    assert desk.errors == []
    assert len(desk.requested) == 1, "the page itself"
    assert desk.ready < READY
    sizes = desk.page.eval_on_selector_all(
        ".picture",
        "(all) => all.map((each) => each.querySelector('svg, canvas')?.getBoundingClientRect())"
        ".map((box) => box && [box.width, box.height])",
    )
    assert len(sizes) > 10
    assert all(size and min(size) > 100 for size in sizes)


def test_plots_are_drawn_when_they_come_near_the_screen(browser: Browser, study_page: Path) -> None:
    with browser.new_context(offline=True, viewport=SCREEN) as context:
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.goto(study_page.as_uri())
        page.wait_for_selector("#plot-summary-0 .main-svg")
        page.wait_for_selector("#explore[data-ready]", state="attached")
        drawn = ".picture:has(.main-svg)"
        assert page.locator(drawn).count() == page.locator("#figure-summary .picture").count()
        page.click("nav a[href='#scores']")
        page.wait_for_selector("#plot-scores-0 .main-svg")
        page.pdf()
        every = page.locator(".picture").count()
        assert page.locator(drawn).count() == every, "paper shows all, and whoever looks next"


def test_no_table_is_wider_than_a_desk(browser: Browser, study_page: Path) -> None:
    with browser.new_context(offline=True, viewport={"width": 1440, "height": 900}) as context:
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.goto(study_page.as_uri())
        page.wait_for_selector("#explore[data-ready]", state="attached")
        page.click("#unfold")
        wide = page.eval_on_selector_all(
            ".scroll",
            "(all) => all.filter((each) => each.scrollWidth > each.clientWidth + 1)"
            ".map((each) => each.getAttribute('aria-label'))",
        )
        assert wide == []


def test_the_explorer_follows_the_mouse(desk: Opened) -> None:
    page = desk.page
    first = explored(page)
    page.click("#explore-next")
    second = explored(page)
    assert first[0] != second[0]
    assert first[1] != second[1]
    page.select_option("#explore-pick", index=10)
    third = explored(page)
    assert third[1] not in (first[1], second[1])
    assert "True class:" in page.inner_text("#explore-answer")
    page.check("#explore-minus")
    assert explored(page)[1] != third[1]
    page.uncheck("#explore-minus")
    link = page.locator("a[href^='#trajectory=']").first
    link.click()
    expect(page.locator("#explore-pick option:checked")).to_have_text(link.inner_text())


def test_the_explorer_follows_the_keyboard(desk: Opened) -> None:
    page = desk.page
    page.select_option("#explore-pick", index=0)
    page.focus("#explore-pick")
    first = explored(page)
    page.keyboard.press("ArrowDown")
    second = explored(page)
    assert first[0] != second[0]
    assert first[1] != second[1]
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "explore-next"
    page.keyboard.press("Enter")
    assert explored(page)[0] not in (first[0], second[0])
    page.focus("#explore-time")
    before = page.inner_text("#explore-now")
    page.keyboard.press("ArrowRight")
    assert page.inner_text("#explore-now") != before


def test_the_explorer_filters_and_sorts(desk: Opened) -> None:
    page = desk.page
    names = "(all) => all.map((each) => each.textContent)"
    whole = page.eval_on_selector_all("#explore-pick option", names)
    page.select_option("#explore-class", index=2)
    some = page.eval_on_selector_all("#explore-pick option", names)
    assert 0 < len(some) < len(whole)
    assert explored(page)[0] in some
    page.select_option("#explore-class", index=0)
    counts = []
    for which in ("wrong", "right"):
        page.select_option("#explore-right", which)
        counts.append(page.locator("#explore-pick option").count())
    assert sum(counts) == len(whole)
    page.select_option("#explore-right", "")
    page.select_option("#explore-order", "error")
    by_error = page.eval_on_selector_all("#explore-pick option", names)
    assert sorted(by_error) == sorted(whole)
    page.select_option("#explore-order", "")


def test_a_click_into_the_plot_sets_the_time(desk: Opened) -> None:
    page = desk.page
    place = page.locator("#explore-outputs")
    place.scroll_into_view_if_needed()
    times = []
    for share in (0.3, 0.8):
        box = place.bounding_box()
        assert box is not None
        place.click(position={"x": share * box["width"], "y": 60})
        times.append(float(page.inner_text("#explore-now").removesuffix(" s")))
    assert 0 < times[0] < times[1]
    seconds = page.evaluate("document.getElementById('explore-outputs').layout.shapes[0].x0")
    assert seconds == pytest.approx(times[1], abs=0.06)


def test_the_updated_twin_is_in_the_picture_in_space(desk: Opened) -> None:
    names = desk.page.evaluate(
        "document.getElementById('explore-pose').data.map((each) => each.name).filter(Boolean)"
    )
    assert names == ["nominal", "updated twin", "measured"]


def test_a_rate_of_ones_own(desk: Opened) -> None:
    """Two healthy test trajectories tell a third and two thirds apart."""
    page = desk.page
    page.fill("#calculate-rate", "60")
    result = page.inner_text("#calculate-result")
    assert "threshold" in result
    assert "327" in result, "a third of the 980 that are healthy, of 1000 with 2 % faulty"
    page.fill("#calculate-faulty", "10")
    assert "300" in page.inner_text("#calculate-result")
    page.fill("#calculate-rate", "20")
    assert "it requires at least 4 of them" in page.inner_text("#calculate-best")
    page.fill("#calculate-rate", "0")
    assert "0 % cannot be promised" in page.inner_text("#calculate-best")
    page.fill("#calculate-missed", "0")
    assert "never to raise an alarm (cost 0)" in page.inner_text("#calculate-best")


def test_dark_where_the_reader_likes_it_dark(desk: Opened, dark: Page) -> None:
    expect(dark.locator("body")).to_have_css("background-color", rgb(CHROME["paper"][1]))
    assert issues(dark) == []
    assert desk.errors == []


def test_a_phone_scrolls_one_way_only(phone: Opened) -> None:
    page = phone.page
    assert page.evaluate("document.scrollingElement.scrollWidth") <= PHONE["width"]
    right = page.eval_on_selector_all(
        ".picture .main-svg",
        "(all) => Math.max(...all.map((e) => e.getBoundingClientRect().right))",
    )
    assert right <= PHONE["width"]
    assert phone.errors == []


@pytest.mark.parametrize("where", ["desk", "phone"])
def test_axe_finds_no_issue(where: str, request: pytest.FixtureRequest) -> None:
    found: Opened = request.getfixturevalue(where)
    assert issues(found.page) == []


@pytest.fixture
def sheet(desk: Opened) -> Iterator[Page]:
    """The same page as wide as a sheet of paper."""
    page = desk.page
    page.set_viewport_size(A4)
    yield page
    page.emulate_media(media="screen")
    page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    page.set_viewport_size(SCREEN)


def test_it_prints_whole(sheet: Page) -> None:
    """Every heading is in the PDF's outline, and nothing is cut at the sheet's edge.

    The first table is made wider than the sheet, as one with the paper's columns is.
    """
    titles = sheet.locator("summary h2").all_inner_texts()
    document = sheet.pdf(tagged=True, outline=True, prefer_css_page_size=True)
    outline = re.findall(rb"/Title \((.*?)\)", document)
    assert {title.encode() for title in titles} <= set(outline)
    sheet.locator(".scroll table").first.evaluate("(table) => (table.style.minWidth = '900px')")
    sheet.emulate_media(media="print")
    sheet.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    beyond = sheet.eval_on_selector_all(
        "main *:not(svg *)",
        "(all) => all.filter((e) => e.getBoundingClientRect().right > innerWidth + 1)"
        ".map((e) => e.closest('section')?.id + ': ' + e.outerHTML.slice(0, 80))",
    )
    assert beyond == []


def test_the_summary_prints_on_one_sheet(sheet: Page) -> None:
    sheet.emulate_media(media="print")
    sheet.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    height = sheet.evaluate("document.getElementById('summary').getBoundingClientRect().height")
    assert 500 < height <= 970
    sections = sheet.eval_on_selector_all("details.part", "(all) => all.every((each) => each.open)")
    assert sections, "the rest prints too"


def test_the_first_screen_answers(browser: Browser, study_page: Path) -> None:
    """Before anything is opened: four uses with their answers, and what is missing."""
    with browser.new_context(offline=True, viewport=SCREEN) as context:
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.goto(study_page.as_uri())
        page.wait_for_selector("#plot-summary-0 .main-svg")
        assert page.locator("details.part[open]").count() == 0
        rows = page.locator(".uses tbody tr")
        assert rows.count() == 4
        answers = [rows.nth(row).locator("td").first.locator("b").inner_text() for row in range(4)]
        assert set(answers) <= {"yes", "likely", "cannot say", "no"}
        text = page.inner_text(".uses").replace("\u00a0", " ")
        assert re.search(r"Error [\d.]+ mm → [\d.]+ mm", text)
        assert "more healthy runs" in text
        assert "emulated" in page.inner_text(".rule")
        box = page.locator(".uses").bounding_box()
        assert box is not None
        assert box["y"] + box["height"] < SCREEN["height"]
        page.click("nav a[href='#explorer']")
        expect(page.locator("#explorer details.part")).to_have_attribute("open", "")


def test_without_scripts_figures_say_what_they_require(browser: Browser, study_page: Path) -> None:
    with browser.new_context(java_script_enabled=False) as context:
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.goto(study_page.as_uri())
        for part in page.locator("details.part > summary").all():
            part.click()
        said = page.locator(".picture p").all_inner_texts()
        assert len(said) > 8
        assert set(said) == {"This figure requires JavaScript."}
