"""The page of the live monitor in a real browser: Debian's Chromium, headless.

The browser is the one RETWIN_BROWSER names, else `chromium`, as in `tests/report/test_browser.py`.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect, sync_playwright
from served import ASSETS, LEAKING, LEVEL, STEPS, TWIN, Served, served

from retwin.report.figures.style import CHROME

pytestmark = pytest.mark.slow
PATIENCE = 60_000  # ms, for machines that are busy
SCREEN = {"width": 1440, "height": 900}
PHONE = {"width": 375, "height": 800}


@dataclass
class Opened:
    """A page, its errors, and the addresses that it requested."""

    page: Page
    url: str
    errors: list[str] = field(default_factory=list)
    requested: list[str] = field(default_factory=list)

    def go(self, *parts: str) -> Page:
        """Show a part of the page, and wait until it is there."""
        self.page.goto(f"{self.url}/#/{'/'.join(quote(each, safe='') for each in parts)}")
        expect(self.page.locator("h1")).not_to_be_empty()
        return self.page


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("page")) as made:
        for name in ASSETS:
            made.send(name, 0, STEPS - 100 * (name == "plain"))
        made.explanations.wait()
        yield made


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    wanted = os.environ.get("RETWIN_BROWSER")
    path = shutil.which(wanted or "chromium")
    if path is None and wanted:
        pytest.fail(f"RETWIN_BROWSER is {wanted}, which is not installed")
    if path is None:
        pytest.skip("no Chromium: apt-get install chromium, or name one in RETWIN_BROWSER")
    with sync_playwright() as play:
        options = ["--no-sandbox", "--disable-gpu"]
        started = play.chromium.launch(executable_path=path, args=options, timeout=PATIENCE)
        yield started
        started.close()


def opened(browser: Browser, server: Served, **options: Any) -> Opened:
    found = Opened(browser.new_context(**options).new_page(), server.url)
    page = found.page
    page.set_default_timeout(PATIENCE)
    page.on("console", lambda entry: entry.type == "error" and found.errors.append(entry.text))
    page.on("pageerror", lambda error: found.errors.append(str(error)))
    page.on("dialog", lambda dialog: found.errors.append(dialog.message))
    page.on("request", lambda request: found.requested.append(request.url))
    return found


@pytest.fixture(scope="module")
def desk(browser: Browser, server: Served) -> Opened:
    return opened(browser, server, viewport=SCREEN, color_scheme="light")


@pytest.fixture(scope="module", params=["desk", "phone", "dark"])
def each(request: pytest.FixtureRequest, browser: Browser, server: Served) -> Opened:
    """On a desk, on a phone, and in the dark."""
    size = PHONE if request.param == "phone" else SCREEN
    scheme = "dark" if request.param == "dark" else "light"
    return opened(browser, server, viewport=size, color_scheme=scheme)


def first_alarm(server: Served) -> str:
    return str(next(iter(server.store.log("alarm"))).sequence)


def serious(page: Page) -> list[tuple[str, str]]:
    """What axe-core finds that is serious or critical: the rule, and where."""
    return [
        (found["id"], node["html"][:120])
        for found in Axe().run(page).response["violations"]
        if found["impact"] in ("serious", "critical")
        for node in found["nodes"]
    ]


def test_every_part_is_readable_everywhere(each: Opened, server: Served) -> None:
    """Names that are markup are shown as they are; nothing is serious to axe, or runs off."""
    for parts, text in (
        ((), LEAKING),
        (("asset", LEAKING), LEVEL),
        (("asset", ASSETS[1]), ASSETS[1]),
        (("asset", ASSETS[2]), ASSETS[2]),
        (("alarms",), LEAKING),
        (("alarm", first_alarm(server)), "leak</td><script>alert(2)</script>"),
        (("versions", TWIN), "<b>number</b> 2"),
    ):
        page = each.go(*parts)
        expect(page.locator("main").get_by_text(text).first).to_be_visible()
        expect(page.locator("#link")).to_have_text("live")
        width = page.evaluate("document.scrollingElement.scrollWidth")
        assert width <= page.viewport_size["width"], parts
        assert serious(page) == [], parts
        assert page.locator("main img, main script, main b:not(.meter b)").count() == 0
    assert each.errors == []
    assert all(address.startswith(server.url) for address in each.requested)


def test_dark_where_the_reader_likes_it_dark(desk: Opened) -> None:
    page = desk.go()
    for scheme, place in (("dark", 1), ("light", 0)):
        page.emulate_media(color_scheme=scheme)
        colour = CHROME["paper"][place]
        parts = [str(int(colour[at : at + 2], 16)) for at in (1, 3, 5)]
        expect(page.locator("body")).to_have_css("background-color", f"rgb({', '.join(parts)})")


def test_a_machine_is_drawn_and_followed(desk: Opened, server: Served) -> None:
    page = desk.go("asset", "plain")
    expect(page.locator("canvas")).to_have_count(4)
    newest = page.locator("dl div", has_text="Newest sample")
    expect(newest).to_contain_text(f"{STEPS - 100} used")
    server.send("plain", STEPS - 100, STEPS)
    expect(newest).to_contain_text(f"{STEPS} used")
    assert page.evaluate("[...document.querySelectorAll('canvas')].every((c) => c.width > 300)")


def test_an_alarm_is_acknowledged_by_keyboard(desk: Opened, server: Served) -> None:
    page = desk.go("alarm", first_alarm(server))
    page.wait_for_selector("textarea")
    expect(page.locator("canvas").first).to_be_visible()
    for words in ("me", "closed the valve"):
        for _ in range(30):
            page.keyboard.press("Tab")
            focused = page.evaluate("document.activeElement.tagName")
            if focused in ("INPUT", "TEXTAREA"):
                break
        page.keyboard.type(words)
    page.keyboard.press("Tab")
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
    page.keyboard.press("Enter")
    page.keyboard.type("not the token that it is")
    page.keyboard.press("Enter")
    expect(page.locator("dialog[open] input")).to_have_value("")
    page.keyboard.type(server.token)
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="Acknowledged")).to_be_visible()
    assert "closed the valve" in page.inner_text("main")
    assert page.evaluate("sessionStorage.getItem('token')") == server.token
    # The browser itself reports the answer 401 to the wrong token.
    assert [error for error in desk.errors if "401" not in error] == []


def test_a_better_version_is_promoted_and_rolled_back(desk: Opened, server: Served) -> None:
    page = desk.go("versions", TWIN)
    page.evaluate(f"sessionStorage.setItem('token', '{server.token}')")
    page.get_by_role("button", name="Promote").click()
    expect(page.locator("section", has_text="Version 2")).to_contain_text("Active")
    page.get_by_role("button", name="Roll back").click()
    expect(page.locator("section", has_text="Version 1")).to_contain_text("Active")


def test_a_lost_server_is_shown(browser: Browser, server: Served) -> None:
    found = opened(browser, server, viewport=SCREEN)
    page = found.go()
    expect(page.locator("#link")).to_have_text("live")
    page.context.set_offline(True)
    page.evaluate("dispatchEvent(new Event('hashchange'))")
    expect(page.locator("#link")).to_have_text("no connection")
    page.context.set_offline(False)
    page.evaluate("dispatchEvent(new Event('hashchange'))")
    expect(page.locator("#link")).to_have_text("live", timeout=PATIENCE)
