"""The site in real headless Chromium, opened from the file system as a reader would."""

from __future__ import annotations

import json
import re
import shutil
import threading
import urllib.error
import urllib.request
from contextlib import contextmanager

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import expect, sync_playwright
from site_helpers import CLOSE, DRIVE, ROOT, STRAIGHT, Answer, write_run

from leaderboard.build import Options
from leaderboard.build import build as build_site
from leaderboard.runs import JudgedRun
from leaderboard.serve import make_server
from racecar.closed_loop import State
from racecar.instance import load_instance

HOSTILE = "<img src=x onerror=\"document.title='owned'\">"
#: axe would ask for the style sheet once more, which the page's policy forbids.
NO_PRELOAD = {"resultTypes": ["violations"], "preload": False}
PAGES = ["index.html", "plots.html", "instances.html", "enter.html", "data.html",
         "tools/alpha.html", "tools/beta.html", f"instances/{CLOSE}.html",
         f"instances/{STRAIGHT}.html"]  # fmt: skip


@pytest.fixture(scope="module")
def chromium():
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("there is no chromium here; install Debian's package")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()


@contextmanager
def opened(chromium, site, address, **options):
    """Open a page; in the end there must have been no error and no request to elsewhere."""
    context = chromium.new_context(**{"viewport": {"width": 1440, "height": 900}, **options})
    page = context.new_page()
    wrong = []
    page.on("console", lambda m: wrong.append(m.text) if m.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    # A request that leaving a page cuts off is no failure: the icon's, on a slow machine.
    page.on(
        "requestfailed",
        lambda r: None if r.failure == "net::ERR_ABORTED" else wrong.append(f"failed: {r.url}"),
    )
    inside = site.as_uri() + "/"
    page.on("request", lambda r: None if r.url.startswith(inside) else wrong.append(r.url))
    page.goto(inside + address)
    yield page
    assert wrong == []
    context.close()


def shows(page, state):
    """Wait until the address ends in a state."""
    expect(page).to_have_url(re.compile(re.escape(state) + "$"))


def column(page, table, number):
    cells = page.locator(f"{table} tbody tr:visible > :nth-child({number})")
    return [text.strip() for text in cells.all_inner_texts()]


def test_a_click_sorts_and_the_address_says_so(chromium, site):
    with opened(chromium, site, "index.html") as page:
        assert column(page, "#scores-1", 2) == ["alpha", "beta", "gamma"]
        page.get_by_role("button", name="PAR-2, s").first.click()
        head = page.locator("#scores-1 th[data-key=par2]")
        assert head.get_attribute("aria-sort") == "descending"
        times = [float(text) for text in column(page, "#scores-1", 9)]
        assert times == sorted(times, reverse=True)
        shows(page, "#sort=-par2")
        address = page.url
        page.keyboard.press("Enter")  # the button has the focus still: the keyboard sorts, too
        assert head.get_attribute("aria-sort") == "ascending"
    with opened(chromium, site, address.rpartition("/")[2]) as page:
        assert [float(text) for text in column(page, "#scores-1", 9)] == times


def test_a_filter_leaves_the_tools_asked_for(chromium, site):
    with opened(chromium, site, "index.html") as page:
        page.get_by_label("Filter tools").fill("MM")
        assert column(page, "#scores-1", 2) == ["gamma"]
        expect(page.locator("#status")).to_have_text("1 of 3 tools in quick")
        shows(page, "#tool=MM")
    with opened(chromium, site, "index.html#tool=bet") as page:
        assert column(page, "#scores-1", 2) == ["beta"]
        assert page.get_by_label("Filter tools").input_value() == "bet"


def test_instances_are_found_sorted_and_opened(chromium, site):
    with opened(chromium, site, "instances.html") as page:
        expect(page.locator("#grid [role=status]")).to_have_text("3 of 3 instances")
        page.get_by_label("Answered").select_option("disputed")
        assert column(page, "#grid table", 1) == [CLOSE]
        shows(page, "#state=disputed")
        page.get_by_label("Answered").select_option("")
        page.get_by_label("Search").fill("td3 clearance")
        assert column(page, "#grid table", 1) == [DRIVE, STRAIGHT]
        page.get_by_role("button", name="Instance").click()
        page.get_by_role("button", name="Instance").click()
        assert column(page, "#grid table", 1) == [STRAIGHT, DRIVE]
        page.get_by_role("link", name=STRAIGHT).click()
        expect(page.locator("h1")).to_have_text(STRAIGHT)


def test_the_slider_moves_the_car(chromium, site):
    with opened(chromium, site, f"instances/{DRIVE}.html") as page:
        car = page.locator("g.car")
        before = car.get_attribute("transform")
        slider = page.get_by_role("slider")
        slider.focus()
        for _ in range(10):
            page.keyboard.press("ArrowRight")
        expect(page.locator("#at")).to_have_text("10")
        assert car.get_attribute("transform") != before
        expect(page.locator("#readout")).to_contain_text("Time 1.0 s")
        shows(page, "#step=10")
        page.keyboard.press("End")
        expect(page.locator("#at")).to_have_text("70")
        # As far as the simulator says: in the second hall the car drives along -y.
        x = float(re.search(r"translate\((\S+) ", car.get_attribute("transform"))[1])
        assert -1.5 < x < 0
    with opened(chromium, site, f"instances/{DRIVE}.html#step=33&run=2") as page:
        expect(page.locator("#at")).to_have_text("33")
        assert page.locator("#run").input_value() == "2"


def test_the_reach_tube_and_the_witness_are_drawn(chromium, site):
    with opened(chromium, site, f"instances/{STRAIGHT}.html") as page:
        assert page.locator(".tube g").count() == 6
        assert page.locator(".tube g.now").count() == 1
        assert page.locator("#track .trace").count() == 9
        page.get_by_label("Reach tube").uncheck()
        expect(page.locator(".tube g").first).to_be_hidden()
    with opened(chromium, site, f"instances/{CLOSE}.html") as page:
        assert page.locator("#run").input_value() == "witness"
        expect(page.locator("#readout")).to_contain_text("Here the car is in the unsafe set")
        assert page.locator("#track .witness").count() == 1


def test_the_scan_is_the_models(chromium, site):
    instance = load_instance(ROOT / f"quick/json/{DRIVE}.json")
    plant = instance.make_plant()
    random = np.random.default_rng(1)
    with opened(chromium, site, f"instances/{DRIVE}.html") as page:
        for _ in range(20):
            s, f, theta = random.uniform(0.3, 1.2), random.uniform(0.3, 9.9), random.uniform(-1, 1)
            x, y, heading = plant.track.to_global(0, s, f, theta)
            found = page.evaluate(
                "([x, y, heading]) => ClosedLap.scan(ClosedLap.scene.walls, ClosedLap.scene.lidar,"
                " x, y, heading, [3]).map((one) => one.distance)",
                [float(x), float(y), float(heading)],
            )
            expected = plant.scan_rows(State.start(s, f, 0.0, theta))[:, 0]
            expected[3] = plant.lidar.range
            assert found == pytest.approx(expected, abs=1e-9)


def painted(page, selector):
    """Whether something of a colour of its own is on a canvas: more than the axes."""
    return page.locator(f"{selector} canvas").evaluate(
        """canvas => {
          const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
          const colours = new Set();
          for (let i = 0; i < data.length; i += 4)
            if (data[i + 3] > 200) colours.add(`${data[i]},${data[i + 1]},${data[i + 2]}`);
          return colours.size;
        }"""
    )


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_plots_are_drawn(chromium, site, theme):
    with opened(chromium, site, "plots.html", color_scheme=theme) as page:
        for name in ("cactus", "scatter", "rays", "neurons", "width"):
            colour = page.evaluate("ClosedLap.colour(0)")
            assert painted(page, f"#{name}") > 3, (name, colour)
        page.get_by_text("The same as a table").first.click()
        rows = page.locator("#cactus-table tbody tr").all_inner_texts()
        # alpha solved all three, within 10 s; beta one; gamma none.
        assert rows[0].split() == ["alpha", "0", "1", "3", "3", "3", "3"]
        assert rows[1].split() == ["beta", "0", "1", "1", "1", "1", "1"]
        assert rows[2].split() == ["gamma", *"000000"]
        page.get_by_label("Up").select_option("gamma")
        shows(page, "#y=gamma")
        page.locator("#scatter ~ details summary").click()
        page.locator("#scatter-table").get_by_role("link", name=CLOSE).click()
        expect(page.locator("h1")).to_have_text(CLOSE)
    with opened(chromium, site, f"instances/{DRIVE}.html", color_scheme=theme) as page:
        for name in ("margin", "steering"):
            assert painted(page, f"#{name}") > 3


def test_a_series_can_be_hidden_by_keyboard(chromium, site):
    with opened(chromium, site, "plots.html") as page:
        button = (
            page.locator("section", has_text="Solved within a time")
            .get_by_role("button", name="alpha")
            .first
        )
        button.focus()
        page.keyboard.press("Space")
        assert button.get_attribute("aria-pressed") == "false"


def test_the_theme_is_kept_from_page_to_page(chromium, site):
    with opened(chromium, site, "index.html", color_scheme="light") as page:
        paper = "getComputedStyle(document.body).backgroundColor"
        light = page.evaluate(paper)
        button = page.get_by_role("button", name="Theme")
        button.click()
        button.click()
        assert page.evaluate(paper) != light
        page.get_by_role("link", name="Data", exact=True).click()
        expect(page.get_by_role("button", name="Theme: dark")).to_be_visible()
        assert page.evaluate(paper) != light


@pytest.mark.parametrize(("theme", "width"), [("light", 1440), ("light", 390), ("dark", 1440)])
@pytest.mark.parametrize("address", PAGES)
def test_no_barrier_for_assistive_technology(chromium, site, address, theme, width):
    size = {"viewport": {"width": width, "height": 900}, "color_scheme": theme}
    with opened(chromium, site, address, **size) as page:
        for details in page.locator("details").all():
            details.evaluate("one => { one.open = true; }")
        found = Axe().run(page, options=NO_PRELOAD).response["violations"]
        assert [(v["id"], v["nodes"][0]["html"]) for v in found] == []
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_the_ranking_works_without_scripts(chromium, site):
    with opened(chromium, site, "index.html", java_script_enabled=False) as page:
        assert column(page, "#scores-1", 2) == ["alpha", "beta", "gamma"]
        expect(page.get_by_text("history, not ranked")).to_be_visible()


class Hostile(JudgedRun):
    """A run whose store was tampered with: names and texts that are markup."""

    def records(self):
        change = {"tool": HOSTILE, "tool_version": HOSTILE, "detail": HOSTILE}
        return [record.model_copy(update=change) for record in super().records()]

    @property
    def shared(self):
        info = super().shared
        tool = info.tool.model_copy(update={"name": HOSTILE, "version": HOSTILE})
        machine = {**info.machine, "processor": HOSTILE}
        return info.model_copy(update={"tool": tool, "machine": machine})


def test_markup_in_a_run_is_text_everywhere(chromium, tmp_path):
    answers = {
        CLOSE: Answer("sat", 1.0, {"s": 0.28, "f": 9.9, "v": 0.0, "theta": 0.0}, log=HOSTILE),
        STRAIGHT: Answer("unsat", log="</pre></details><script>document.title='owned'</script>"),
        DRIVE: Answer("unknown"),
    }
    write_run(tmp_path / "run", "tame", answers)
    other = write_run(tmp_path / "other", "other", {CLOSE: Answer("unsat")})
    site = tmp_path / "site"
    build_site([Hostile(tmp_path / "run"), JudgedRun(other)], site, Options(ROOT))
    tools = [p.name for p in (site / "tools").iterdir() if p.name != "other.html"]
    assert len(tools) == 1
    assert re.fullmatch(r"[A-Za-z0-9_.-]+\.html", tools[0])
    addresses = ["index.html", "plots.html", "instances.html", "data.html", f"tools/{tools[0]}",
                 *(f"instances/{name}.html" for name in (CLOSE, STRAIGHT, DRIVE))]  # fmt: skip
    for address in addresses:
        with opened(chromium, site, address) as page:
            assert page.title() != "owned"
            assert page.locator("main img").count() == 0
            if address != "instances.html":
                text = page.locator("main").inner_text() + page.locator("main").inner_html()
                assert "<img src=x" in text or "&lt;img src=x" in text
    data = json.loads((site / f"data/results/{tools[0][:-5]}.json").read_text())
    assert data["tool"] == HOSTILE


def test_serve_shows_the_site(site):
    with make_server(site, "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}"
        with urllib.request.urlopen(f"{address}/", timeout=10) as answer:
            assert answer.read() == (site / "index.html").read_bytes()
        with pytest.raises(urllib.error.HTTPError):
            urllib.request.urlopen(f"{address}/../../etc/passwd", timeout=10)
        server.shutdown()
