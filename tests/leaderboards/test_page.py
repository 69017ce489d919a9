"""The page of the leaderboards in a real browser: what it shows, sorts and filters; phones; nothing from outside."""

from __future__ import annotations

import base64
import io
import re
import shutil
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from leaderboards.boards import boards
from leaderboards.inspections import inspections_in
from leaderboards.page import page as pages
from leaderboards.page import plots, svg
from leaderboards.page.page import write_page
from leaderboards.publish import evidence_in
from leaderboards.results import Entry
from tests.leaderboards.test_inspections import write_inspection

REPOSITORY = Path(__file__).parents[2]
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]
SHOWN = ("craftax_classic", "minatar/breakout")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The page of a part of what is committed, with world models besides, and what it was made from."""
    standings = [s for s in evidence_in(REPOSITORY / "leaderboards")[0] if s.entry.config.task in SHOWN]
    tables = boards(standings)
    folder = tmp_path_factory.mktemp("page")
    write_inspection(folder, {"m5 seed 0": 1.0, "m5 seed 1": 2.0, "m6 seed 0": 0.5}, task=SHOWN[1])
    return write_page([s.entry for s in standings], tables, folder, inspections_in(folder)), tables, standings


def test_it_holds_all_that_it_needs(made):
    path, tables, _ = made
    html = path.read_text()
    assert not re.findall(r'(?:src|href)="(?!#|data:image/png;base64,)[^"]*"|url\((?!#)|@import', html)
    ids = re.findall(r'\bid="([^"]*)"', html)
    assert len(ids) == len(set(ids)) >= len(tables)
    used = set(re.findall(r'(?:href="|url\()#([^")]*)', html))
    assert used <= set(ids)
    assert not any(color in html for color in plots.VARIABLES)  # each stand-in became the page's own colour


def test_the_same_runs_make_the_same_page(made, tmp_path):
    path, _, standings = made
    entries = [Entry(s.entry.records) for s in standings]
    again = write_page(entries, boards(standings), tmp_path, inspections_in(path.parent))
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
    assert html.count(f"published: {best['method']}") == 1  # in the family's picture, which is the game's
    assert '<use href="#picture-' in html


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


def test_numbers_sort_as_numbers(opened):
    """Also where they are read off the text: thousands have commas there, and small print follows."""
    page = opened()
    for heading in ("Steps", "Seeds", "Minutes"):
        page.locator("#craftax_classic thead th", has_text=heading).get_by_role("button").click()
        shown = [text.split()[0] for text in column(page, "craftax_classic", heading) if text]
        values = [float(text.replace(",", "")) for text in shown]
        assert values == sorted(values, reverse=True) and values[0] > values[-1]


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


def test_world_models_beside_reality(opened, made):
    """Curves and a filmstrip in the section of their task, filtered by its budget."""
    page = opened()
    models = page.locator("#minatar_breakout .models")
    assert page.locator(".models").count() == 1 and models.locator("figure").count() == 2
    texts = models.locator("svg text").all_text_contents()
    for text in ("m5", "m6", "first frame repeated", "real frame", "symbols right, %", "squared error"):
        assert texts.count(text) == 1
    assert models.locator("figcaption").first.inner_text() == "After 102,400 real steps; runs: 2 of m5, 1 of m6."
    strip = models.get_by_role("img", name="Frames of rollouts")
    file = (made[0].parent / "evidence" / SHOWN[1] / "inspect" / "filmstrip.png").read_bytes()
    assert base64.b64decode(strip.get_attribute("src").split(",")[1]) == file
    assert strip.evaluate("(image) => image.complete && image.naturalWidth") == 6 * 60 + 5 * 2
    assert "steps 0, 1, 2, 3, 4, 5; from above real, m5 seed 0" in models.locator("figcaption").last.inner_text()
    page.get_by_label("Budget").select_option("1,000,000 steps")
    assert page.locator("#minatar_breakout").is_visible() and not models.is_visible()
    page.get_by_label("Budget").select_option("102,400 steps")
    assert models.is_visible()


def test_a_picture_that_is_shown_again_is_written_once(opened):
    """A family of one game shows what the game does."""
    page, pictures = opened(), []
    for id, written in (("overall", True), ("craftax_classic", False)):
        drawing = page.locator(f"#{id} figure svg").first
        assert (drawing.locator("text").count() > 5) is written and drawing.locator("use").count() == 1 - written
        drawing.evaluate("(svg) => { svg.style = 'position: fixed; inset: 0; z-index: 9; background: white'; }")
        shown = page.screenshot(clip={"x": 0, "y": 0, "width": 544, "height": 350})
        pictures.append(np.asarray(Image.open(io.BytesIO(shown)).convert("L"), int))
    assert abs(pictures[0] - pictures[1]).max() < 20 and np.ptp(pictures[0]) > 200


def test_few_bytes_are_the_same_picture(browser):
    """Lines, gaps, markers, areas, bars and turned text, with or without what `svg_of` leaves out."""
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        figure = Figure(figsize=(5, 3))
        axes = figure.subplots()
        axes.plot([0, 1, 2, 3, 4], [1, 2, np.nan, 2, 5], "s-")
        axes.fill_between([0, 1, 2], [0, 1, 0], [2, 3, 1], alpha=0.4)
        axes.barh([1, 2], [3, 2.5])
        axes.annotate("far", (2, 2), (3, 3), arrowprops={"arrowstyle": "->"})
        axes.set(xlabel="along & across", ylabel="up", title="two\nlines")
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg")
        whole = buffer.getvalue()
        light = svg.as_file(svg.svg_of(figure, "", {}), ":root { --paper: white; }")
    assert len(light) < len(whole) / 2
    page = browser.new_page(viewport={"width": 480, "height": 288})
    pictures = []
    for text in (whole[whole.index("<svg") :], light):
        page.set_content(f"<style>* {{ margin: 0; font-family: sans-serif !important; }}</style>{text}")
        pictures.append(np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("L"), float))
    page.close()
    difference = abs(pictures[0] - pictures[1])
    assert difference.mean() < 0.02 * pictures[0].std() and (difference > 128).mean() < 1e-3


def test_tables_need_no_script(browser, made):
    page = browser.new_context(java_script_enabled=False).new_page()
    page.goto(made[0].as_uri())
    rows = page.locator("tr[data-origin]")
    assert rows.count() > 50 and rows.last.is_visible()
    page.context.close()


UNFOLD = "document.querySelectorAll('details').forEach((details) => { details.open = true; })"


def test_a_phone_shows_every_score_and_its_method(opened):
    """Without scrolling sideways; all other columns come when asked for, beside the method, which stays."""
    page = opened(390)
    cells = (
        "[...document.querySelectorAll('td:not(:nth-last-child(-n+6)), th[scope=row]')].filter((c) => c.offsetWidth)"
    )
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
    pictures = "[...document.querySelectorAll('figure svg, figure img')]"
    sizes = page.evaluate(f"{pictures}.map((picture) => picture.getBoundingClientRect().width)")
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
    assert page.get_by_role("img").count() == page.locator("figure svg[aria-label], figure img[alt]").count() >= 6
    assert page.locator("html[lang=en]").count() == page.locator("main").count() == page.locator("h1").count() == 1
