"""The page of the leaderboards in a real browser: what it shows, sorts and filters; phones; nothing from outside."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from leaderboards.boards import boards
from leaderboards.page import page as pages
from leaderboards.page import plots
from leaderboards.page.page import write_page
from leaderboards.publish import evidence_in
from leaderboards.results import Entry

REPOSITORY = Path(__file__).parents[2]
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]
SHOWN = ("craftax_classic", "minatar/breakout")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The page of a part of what is committed, and what it was made from."""
    standings = [s for s in evidence_in(REPOSITORY / "leaderboards")[0] if s.entry.config.task in SHOWN]
    tables = boards(standings)
    folder = tmp_path_factory.mktemp("page")
    return write_page([s.entry for s in standings], tables, folder), tables, standings


def test_it_holds_all_that_it_needs(made):
    path, *_ = made
    html = path.read_text()
    assert not re.findall(r'(?:src|href)="(?!#)[^"]*"|url\((?!#)|@import', html)
    ids = re.findall(r'\bid="([^"]*)"', html)
    assert len(ids) == len(set(ids)) > 20
    used = set(re.findall(r'(?:href="|url\()#([^")]*)', html))
    assert used <= set(ids)
    assert not any(color in html for color in plots.VARIABLES)  # each stand-in became the page's own colour


def test_the_same_runs_make_the_same_page(made, tmp_path):
    path, _, standings = made
    again = write_page([Entry(s.entry.records) for s in standings], boards(standings), tmp_path)
    assert again.read_bytes() == path.read_bytes()


def test_markup_in_a_cell_is_shown_as_text(made, tmp_path):
    _, tables, _ = made
    table = tables["minatar_breakout.csv"].copy()
    table["method"] = "<script>alert(1)</script>"
    html = write_page([], {"minatar_breakout.csv": table}, tmp_path).read_text()
    assert "<script>alert" not in html and "&lt;script&gt;alert(1)" in html


@pytest.mark.parametrize(("single", "profiles"), [(1, 1), (2, 0)])
def test_profiles_are_of_agents_with_many_runs(made, tmp_path, monkeypatch, single, profiles):
    """A few runs make stairs; they do not take the profiles of other agents away."""
    monkeypatch.setattr(pages, "PROFILE_RUNS", 5)
    _, tables, standings = made
    name = "minatar_breakout.csv"
    found = [s.entry for s in standings if s.entry.config.task == "minatar/breakout"]
    found = [entry for entry in found if entry.config.preset == "small" and entry.config.agent in ("mfrl", "random")]
    entries = [Entry(entry.records[:1]) if index < single else entry for index, entry in enumerate(found)]
    html = write_page(entries, {name: tables[name]}, tmp_path).read_text()
    assert len(found) == 2 and html.count("the share of runs above") == profiles


def test_the_committed_page_is_small():
    """Whoever reads it on a phone loads all of it."""
    assert (REPOSITORY / "leaderboards" / "index.html").stat().st_size < 400_000


def test_a_published_level_is_a_line_where_budgets_agree(made, tmp_path):
    """Of the best of those with the same metric and budget; ours are no such level."""
    _, tables, standings = made
    table = tables["minatar_breakout.csv"].copy()
    entries = [s.entry for s in standings if s.entry.config.task == "minatar/breakout"]
    entries = [entry for entry in entries if entry.config.preset == "small" and entry.config.agent == "mfrl"]
    theirs = (table["metric"] == "return") & ~table["measured_here"].astype(bool)
    assert theirs.sum() > 1 and pages.panel_of(entries, table, "").published is None
    table.loc[theirs, "steps"] = entries[0].config.protocol.steps
    best = table[theirs].sort_values("value").iloc[-1]
    panel = pages.panel_of(entries, table, "")
    assert panel.published == (best["method"], best["value"])
    told = [s.entry for s in standings if s.entry.config.agent in ("mfrl", "m6")]
    html = write_page(told, {"overall.csv": tables["overall.csv"], "minatar_breakout.csv": table}, tmp_path).read_text()
    assert html.count(f"published: {best['method']}") == 2  # in the family's picture, and in the game's


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("needs Chromium (Debian: chromium)")
    with sync_api.sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)


@pytest.fixture
def opened(browser, made):
    """Opens the page in a window of some size; afterwards nothing may have been complained of or asked for."""
    complaints: list[str] = []
    pages = []

    def opened(width=1280, scheme="light"):
        page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: request.url.startswith("file:") or complaints.append(request.url))
        page.goto(made[0].as_uri())
        pages.append(page)
        return page

    yield opened
    for page in pages:
        page.close()
    assert complaints == []


def column(page, task, heading):
    """The shown cells of a column, as text."""
    return page.evaluate(
        """([task, heading]) => {
            const table = document.querySelector(`#${task} table`);
            const index = [...table.tHead.rows[0].cells].findIndex((cell) => cell.textContent.trim() === heading);
            const rows = [...table.tBodies[0].rows].filter((row) => !row.hidden);
            return rows.map((row) => row.cells[index].innerText.trim());
        }""",
        [task, heading],
    )


def test_a_table_shows_what_its_csv_file_says(opened, made):
    _, tables, _ = made
    page = opened()
    table = tables["craftax_classic.csv"]
    rewards = table[table["metric"] == "reward_percent"]
    shown = [text for text in column(page, "craftax_classic", "Reward, % of the maximum") if text]
    assert [float(text.split()[0]) for text in shown] == [round(float(value), 2) for value in rewards["value"]]
    origins = column(page, "craftax_classic", "From")
    assert origins.count("measured") == rewards["measured_here"].sum() and "published" in origins


def test_sorting(opened):
    page = opened()
    heading = page.get_by_role("region", name="Table of Craftax-classic").get_by_role("columnheader", name="Reward, %")

    def rewards():
        return [float(text.split()[0]) for text in column(page, "craftax_classic", "Reward, % of the maximum") if text]

    before = rewards()
    heading.get_by_role("button").click()
    assert heading.get_attribute("aria-sort") == "descending"
    assert rewards() == sorted(before, reverse=True) != before
    heading.get_by_role("button").press("Enter")  # the keyboard sorts as well
    assert heading.get_attribute("aria-sort") == "ascending" and rewards() == sorted(before)
    cells = column(page, "craftax_classic", "Reward, % of the maximum")
    assert cells[-1] == "" and "" not in cells[: len(before)]  # what has no value stays last
    method = page.get_by_role("region", name="Table of Craftax-classic").get_by_role("columnheader", name="Method")
    method.get_by_role("button").click()
    names = column(page, "craftax_classic", "Method")
    assert names[0].startswith("3-D RoPE") and heading.get_attribute("aria-sort") is None


def test_filters_apply_to_all_tables(opened):
    page = opened()
    everything = len(column(page, "craftax_classic", "Method"))
    page.get_by_label("From").select_option("measured here")
    assert set(column(page, "craftax_classic", "From")) == {"measured"} == set(column(page, "minatar_breakout", "From"))
    page.get_by_label("From").select_option("all")
    page.get_by_label("Sees").select_option("symbols")
    assert column(page, "craftax_classic", "Method") == [] and column(page, "minatar_breakout", "Method")
    assert not page.locator("#craftax_classic").is_visible()  # no empty tables, and none of their figures
    assert not page.get_by_role("navigation").get_by_role("link", name="Craftax-classic").is_visible()
    page.get_by_label("Sees").select_option("all")
    page.get_by_label("From").select_option("published")
    assert page.locator("#minatar_breakout").is_visible() and page.locator("figure:visible").count() == 0
    page.get_by_label("From").select_option("all")
    page.get_by_label("Budget").select_option("1,000,000 steps")
    assert set(column(page, "craftax_classic", "Steps")) == {"1,000,000"}
    assert re.fullmatch(r"[0-9]+ of [0-9]+ rows", page.locator("output").inner_text())
    page.get_by_label("Budget").select_option("all")
    assert len(column(page, "craftax_classic", "Method")) == everything and page.locator("output").inner_text() == ""


UNFOLD = "document.querySelectorAll('details').forEach((details) => { details.open = true; })"


def test_a_phone_shows_every_score_and_its_method(opened):
    """Without scrolling sideways; all other columns come when asked for, beside the method, which stays."""
    page = opened(390)
    cells = "[...document.querySelectorAll('tbody .number:not(.minor), th[scope=row]')].filter((c) => c.offsetWidth)"
    edges = page.evaluate(f"{cells}.map((cell) => cell.getBoundingClientRect().right)")
    assert len(edges) > 60 and max(edges) <= 390
    minutes = page.locator("#craftax_classic thead th", has_text="Minutes")
    assert not minutes.is_visible()
    page.get_by_label("all columns").check()
    assert minutes.is_visible()
    page.locator("#craftax_classic .scroll").evaluate("(box) => { box.scrollTo(300, 300); }")
    for part in ("tbody th[scope=row]", "thead th:nth-child(2)"):
        assert page.locator(f"#craftax_classic {part}").nth(0).bounding_box()["x"] >= 16
    box = page.locator("#craftax_classic .scroll").bounding_box()
    cell = page.locator("#craftax_classic thead th").nth(1).bounding_box()
    assert abs(cell["y"] - box["y"]) < 3


@pytest.mark.parametrize("width", [390, 1280])
def test_a_link_shows_its_heading(opened, width):
    """Below what stays at the top."""
    page = opened(width)
    page.get_by_role("navigation").get_by_role("link", name="minatar/breakout").click()
    top = page.locator("#minatar_breakout h2").bounding_box()["y"]
    bar = page.locator(".filters").bounding_box()
    assert max(0, bar["y"] + bar["height"]) <= top < 300


def test_results_are_one_step_away_from_the_keyboard(opened):
    page = opened()
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.textContent") == "Skip to the results"
    page.keyboard.press("Enter")
    assert page.evaluate("window.scrollY") > 100


def test_pictures_come_before_tables(opened):
    """Each section with curves of several agents begins with them."""
    page = opened()
    for id in ("overall", "craftax_classic", "minatar_breakout"):
        figure, table = (page.locator(f"#{id} {part}").first.bounding_box()["y"] for part in ("figure", "table"))
        assert figure < table


@pytest.mark.parametrize("width", [390, 1280])
def test_nothing_runs_over_the_edge(opened, width):
    page = opened(width)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.evaluate(UNFOLD)
    figures = "[...document.querySelectorAll('figure svg')]"
    sizes = page.evaluate(f"{figures}.map((svg) => svg.getBoundingClientRect().width)")
    assert len(sizes) >= 6 and all(200 < size <= width for size in sizes)
    texts = f"{figures}.flatMap((svg) => [...svg.querySelectorAll('text')])"
    heights = page.evaluate(f"{texts}.map((text) => text.getBoundingClientRect().height)")
    assert min(heights) >= 8  # pixels: still to be read


def test_light_and_dark(opened):
    style = "(name) => getComputedStyle(document.querySelector(name))"
    script = f"[({style})('body').backgroundColor, ({style})('svg text').fill]"
    colors = [opened(scheme=scheme).evaluate(script) for scheme in ("light", "dark")]
    (light, light_ink), (dark, dark_ink) = [[brightness(color) for color in pair] for pair in colors]
    assert light > 200 > 60 > light_ink and dark < 60 < 200 < dark_ink


def brightness(color):
    return sum(map(int, re.findall(r"[0-9]+", color)[:3])) / 3


def test_screen_readers_have_names_for_everything(opened):
    page = opened()
    page.evaluate(UNFOLD)
    nameless = """[...document.querySelectorAll('table')].filter((table) => !table.caption.textContent.trim()
        || [...table.tHead.rows[0].cells].some((cell) => cell.scope !== 'col' || !cell.textContent.trim())
        || [...table.querySelectorAll('tr[data-origin]')].some(
            (row) => row.querySelectorAll('th[scope=row]').length !== 1)).length"""
    assert page.evaluate(nameless) == 0
    assert page.get_by_role("img").count() == page.locator("figure svg[aria-label]").count() >= 6
    assert page.locator("html[lang=en]").count() == page.locator("main").count() == page.locator("h1").count() == 1
