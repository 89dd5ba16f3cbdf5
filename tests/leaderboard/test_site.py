"""The page in a real browser: use by mouse, by keyboard and on a phone."""

import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import fabricated
import pytest
from browser import open_browser
from fabricated import (
    DIA,
    ENVIRONMENT,
    PHOTOGRAPHS,
    SETTINGS,
    baselines,
    draw_picture,
    inapplicable,
    ldp,
    localizations,
    reconstructions,
)

from bench.runner.directory import photograph_path, reconstruction_path
from bench.runner.records import experiment_id
from leaderboard import site
from leaderboard.comparison import build_groups, load_records
from leaderboard.group_tables import build_pairs_table
from leaderboard.recipe import find_plugin
from leaderboard.site.experiments import build_view
from leaderboard.site.overview import build_overview

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

HOSTILE = """"><script>window.owned = 1</script><img src=x onerror="window.owned = 2">'{{ 7 * 7 }}</style></script>"""
NONE, AFFINE, NEAREST = {"name": "none"}, {"name": "affine", "dim": 4}, {"name": "nearest"}
DAYS = ["day", "night"] * 4


def results(folder: Path) -> Path:
    """Five defenses, of which one is unranked and one comes from somebody who means harm."""
    hostile = {"name": HOSTILE, HOSTILE: HOSTILE}
    strange = PHOTOGRAPHS | {"name": f"zoo {HOSTILE}", "hash": "sha256:" + "f" * 64}
    reconstructed = [
        *reconstructions(NONE, [0.8, 0.7, 0.9] * 2),
        *reconstructions(AFFINE, [0.4, 0.5, 0.3] * 2),
        *reconstructions(AFFINE, [0.6, 0.5, 0.7] * 2, attack=NEAREST),
        *reconstructions(ldp(16.0), [0.5, 0.4, 0.6] * 2),
        *reconstructions(ldp(4.0), [0.2, 0.1, 0.3] * 2),
        *reconstructions({"name": "new"}, [0.01, 0.01, 0.01] * 2, attack=NEAREST),
        *reconstructions(hostile, [0.95, 0.95, 0.95] * 2, reason=None, notes=[HOSTILE]),
        *baselines(NONE, 6),
        *reconstructions(NONE, [0.5], dataset=strange),
    ]
    others = [
        inapplicable({"name": "new"}, DIA, f"no adapted attacker {HOSTILE}"),
        inapplicable(NONE, NEAREST, "nearest attacks Subspaces; none releases Descriptors"),
        *localizations(NONE, [1, 1, 1, 1, 1, 1, 1, 0], DAYS),
        *localizations(AFFINE, [1, 1, 1, 0, 0, 1, 0, 0], DAYS),
        *localizations(ldp(16.0), [1, 1, 1, 1, 1, 0, 0, 0], DAYS),
        *localizations(ldp(4.0), [1, 0, 0, 0, 0, 0, 0, 0], DAYS),
        *localizations({"name": "new"}, [0] * 8, DAYS),
    ]
    for number, record in enumerate(reconstructed):
        draw_picture(reconstruction_path(folder, record), number)
        if record["sample"] != "2.png":  # of which the photograph has gone
            draw_picture(photograph_path(folder, record), 1000 + int(record["sample"][0]))
    return fabricated.write(folder, [*reconstructed, *others])


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("leaderboard")
    return site.write([results(folder / "runs")], folder / "site").page


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with open_browser() as opened:
        yield opened


@pytest.fixture
def page(browser: Any, index: Path) -> Iterator[Any]:
    """The page as it opens. At the end there are no console messages and no network requests."""
    yield from opened(browser, index, {"width": 1200, "height": 900})


@pytest.fixture
def phone(browser: Any, index: Path) -> Iterator[Any]:
    yield from opened(browser, index, {"width": 360, "height": 740})


def opened(browser: Any, index: Path, size: dict[str, int]) -> Iterator[Any]:
    context = browser.new_context(viewport=size)
    page = context.new_page()
    page.set_default_timeout(10_000)
    messages, requests = [], []
    page.on("console", lambda message: messages.append(message.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(index.as_uri())
    yield page
    context.close()
    assert messages == []
    assert [url for url in requests if not url.startswith(index.parent.as_uri())] == []
    assert requests


def listed(page: Any, column: str = "defense") -> list[str]:
    """Return the values of a column in the visible rows, from top to bottom."""
    values = page.locator(f'.group:visible tbody tr:visible [data-column="{column}"]')
    return [value.get_attribute("data-value") for value in values.all()]


def column_button(page: Any, label: str) -> Any:
    return page.locator(".group:visible thead").get_by_role("button", name=label, exact=True)


def position(locator: Any) -> dict[str, float]:
    return dict(locator.bounding_box())


def dialog(page: Any) -> Any:
    return page.locator("dialog[open]")


def shows(page: Any, title: str) -> None:
    """Wait until the experiment of that title is open."""
    playwright.expect(dialog(page).locator("h2")).to_have_text(title)


def closed(page: Any) -> None:
    """Wait until no experiment is open."""
    playwright.expect(dialog(page)).to_have_count(0)


LDP4, LDP16 = "ldp:epsilon=4,subset_size=2", "ldp:epsilon=16,subset_size=2"


@pytest.mark.exhaustive
def test_it_opens_ranked_with_the_strongest_attack_on_each(page: Any) -> None:
    defenses = listed(page)
    assert defenses[:4] == [LDP4, LDP16, "affine:dim=4", "none"]
    assert defenses[4].startswith('">')
    assert defenses[5:] == ["new"]
    assert listed(page, "rank") == ["1.0", "2.0", "3.0", "4.0", "5.0", ""]
    assert listed(page, "attack")[2] == "nearest"
    assert page.locator("tr:visible .note", has_text="unranked: no adapted attacker").count() == 1


@pytest.mark.exhaustive
def test_sorting_by_a_column_both_ways_with_what_is_missing_last(page: Any) -> None:
    column_button(page, "ε/descriptor").click()
    assert listed(page, "epsilon_descriptor") == ["4.0", "16.0", "", "", "", ""]
    assert page.locator('.group:visible th[aria-sort="ascending"]').inner_text().strip().startswith("ε/descriptor")
    column_button(page, "ε/descriptor").click()
    assert listed(page, "epsilon_descriptor") == ["16.0", "4.0", "", "", "", ""]
    column_button(page, "SSIM").click()
    scores = [float(value) for value in listed(page, "ssim")]
    assert scores == sorted(scores)
    assert listed(page)[0] == "new"  # an unranked one is first only on request
    column_button(page, "rank").click()
    assert listed(page)[0] == LDP4


@pytest.mark.exhaustive
def test_sorting_by_keyboard(page: Any) -> None:
    column_button(page, "MAE").focus()
    page.keyboard.press("Enter")
    ascending = [float(value) for value in listed(page, "mae")]
    assert ascending == sorted(ascending)
    page.keyboard.press("Space")
    assert [float(value) for value in listed(page, "mae")] == ascending[::-1]


@pytest.mark.exhaustive
def test_filtering_by_words_and_showing_all_attacks(page: Any) -> None:
    box = page.locator(".group:visible .filter")
    box.fill("LDP epsilon=16")
    assert listed(page) == [LDP16]
    assert page.locator(".group:visible .count").inner_text() == "1 of 11 rows"
    box.fill("nearest affine")
    assert listed(page, "attack") == ["nearest"]
    page.locator(".group:visible .only").uncheck()
    box.fill("affine")
    assert listed(page, "attack") == ["nearest", "dia"]
    box.fill("no such thing")
    assert listed(page) == []
    box.fill("")
    assert len(listed(page)) == 11


@pytest.mark.exhaustive
def test_a_row_opens_its_experiment_by_click_and_the_way_back_closes_it(page: Any) -> None:
    page.locator("tr:visible .open", has_text="ldp").first.click()
    shown = dialog(page)
    shows(page, "ldp against dia")
    assert "bench run --defense ldp:epsilon=4,dictionary=FILE --attack dia:weights=FILE" in shown.locator("pre").inner_text()
    text = shown.inner_text()
    assert "ε of a descriptor" in text
    assert "ε of an image, basic composition" in text
    assert "410 (400 to 420)" in text  # 4 for each of 102.5 (100 to 105) keypoints
    assert "Not covered by ε: the keypoints' positions, the number of keypoints." in text
    shown.locator("summary").click()
    assert ENVIRONMENT["source"] in shown.inner_text()
    page.go_back()
    closed(page)


@pytest.mark.exhaustive
def test_a_row_opens_its_experiment_by_keyboard(page: Any) -> None:
    page.locator(".group:visible .only").focus()
    for _ in range(40):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.className") == "open":
            break
    page.keyboard.press("Enter")
    shows(page, "ldp against dia")
    page.keyboard.press("Escape")
    closed(page)
    playwright.expect(page.locator("a.open:focus")).to_have_count(1)  # the focus is back on the link


@pytest.mark.exhaustive
def test_a_point_of_the_plot_opens_its_experiment(page: Any) -> None:
    chart = page.locator(".group:visible .chart").first
    points = chart.locator(".point")
    assert points.count() == 5
    assert chart.locator("path.front").first.get_attribute("d").startswith("M")
    point = chart.get_by_role("link", name="affine:dim=4, rank 3: recall (0.25 m, 2°) 0.5, SSIM 0.6 by nearest")
    point.click()
    shows(page, "affine against nearest")
    page.keyboard.press("Escape")
    closed(page)
    chart.get_by_role("link", name="none, rank 4").focus()
    page.keyboard.press("Enter")
    shows(page, "none against dia")
    dialog(page).get_by_role("link", name="recall (0.25 m, 2°), day").click()  # the other axis
    shows(page, "none")
    assert "Localization on gallery" in dialog(page).inner_text()


@pytest.mark.exhaustive
def test_the_slider_uncovers_the_photograph(page: Any) -> None:
    page.locator("tr:visible .open").first.click()
    stage, slider = dialog(page).locator(".stage"), dialog(page).locator(".stage input")
    for name in ("original", "reconstruction"):
        playwright.expect(dialog(page).locator(f".{name}")).to_have_js_property("naturalWidth", 256)

    def covered() -> str:
        return str(page.evaluate("getComputedStyle(document.querySelector('dialog[open] .reconstruction')).clipPath"))

    assert covered() == "inset(0px 0px 0px 50%)"
    slider.focus()
    page.keyboard.press("Home")
    assert covered() in ("inset(0px 0px 0px 0%)", "inset(0px)")
    page.keyboard.press("ArrowRight")
    assert covered() == "inset(0px 0px 0px 1%)"
    box = stage.bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.75, box["y"] + box["height"] / 2)
    page.mouse.up()
    fraction = float(covered().rpartition(" ")[2].removesuffix("%)"))
    assert fraction == pytest.approx(75, abs=4)
    assert slider.get_attribute("aria-valuetext") == f"{fraction:g} % photograph"


@pytest.mark.exhaustive
def test_another_photograph_can_be_chosen_and_a_missing_one_is_noted(page: Any) -> None:
    page.locator("tr:visible .open").first.click()
    reconstruction = dialog(page).locator(".reconstruction")
    first = reconstruction.get_attribute("src")
    assert dialog(page).locator("output").inner_text() == "0.png · SSIM 0.2"
    dialog(page).get_by_role("button", name="1.png").click()
    assert reconstruction.get_attribute("src") != first
    assert reconstruction.get_attribute("alt") == "Reconstruction of 1.png"
    dialog(page).get_by_role("button", name="2.png").click()
    assert "the results folder has no photograph of this sample" in dialog(page).locator("output").inner_text()
    assert dialog(page).locator(".stage input").is_disabled()
    assert not dialog(page).locator(".original").is_visible()


@pytest.mark.exhaustive
def test_the_pictures_above_the_table_are_of_one_sample_in_the_order_of_the_ranking(page: Any) -> None:
    pictures = page.locator(".overview:visible li")
    captions = [re.sub(r"\s+", " ", picture.inner_text()).strip() for picture in pictures.all()]
    assert captions[:5] == [
        "photograph 0.png",
        "ldp epsilon=4, subset_size=2 by dia SSIM 0.2",
        "ldp epsilon=16, subset_size=2 by dia SSIM 0.5",
        "affine dim=4 by nearest SSIM 0.6",
        "none by dia SSIM 0.8",
    ]
    assert captions[5].endswith("by dia SSIM 0.95")
    assert captions[6:] == ["new by nearest SSIM 0.01"]
    for picture in page.locator(".group:visible li img").all():
        playwright.expect(picture).to_have_js_property("naturalWidth", 256)
    sources = [picture.locator("img").get_attribute("src") for picture in pictures.all()]
    assert len(set(sources)) == 7
    assert position(page.locator(".overview:visible"))["y"] < position(page.locator(".frame table:visible"))["y"]
    # The same files are in the rows, and in the dialogs.
    rows = page.locator(".group:visible tbody tr:visible .open img")
    assert [row.get_attribute("src") for row in rows.all()] == sources[1:]
    pictures.nth(3).locator("a").click()
    shows(page, "affine against nearest")
    assert dialog(page).locator(".reconstruction").get_attribute("src") == sources[3]
    assert dialog(page).locator(".original").get_attribute("src") == sources[0]


@pytest.mark.exhaustive
def test_the_pictures_above_the_table_open_their_experiments_by_keyboard(page: Any) -> None:
    page.locator(".suite summary:visible").first.focus()
    for title in ("ldp against dia", "ldp against dia", "affine against nearest"):
        page.keyboard.press("Tab")
        page.keyboard.press("Enter")
        shows(page, title)
        page.keyboard.press("Escape")
        closed(page)
        playwright.expect(page.locator(".overview a:focus")).to_have_count(1)  # the focus is back
    link = page.get_by_role("link", name="Reconstruction of 0.png affine dim=4 by nearest SSIM 0.6")
    playwright.expect(link).to_be_focused()


@pytest.mark.exhaustive
def test_nothing_moves_when_pictures_load(browser: Any, index: Path) -> None:
    """The positions of all rows are those of a page without its picture files. The negative control has no sizes."""
    style = ".overview img, .open img { width: auto !important; height: auto !important; position: static !important }"
    positions = {}
    for name in ("loaded", "absent", "loaded without sizes", "absent without sizes"):
        page = browser.new_page(viewport={"width": 1200, "height": 2000})
        if name.startswith("absent"):
            page.route("**/*.webp", lambda route: route.abort())
        page.goto(index.as_uri())
        for picture in page.locator("img:visible").all():
            playwright.expect(picture).to_have_js_property("complete", True)
        if name.endswith("without sizes"):
            page.evaluate(
                """(style) => {
                    for (const one of document.images) for (const name of ["width", "height"]) one.removeAttribute(name);
                    const sheet = new CSSStyleSheet();
                    sheet.replaceSync(style);
                    document.adoptedStyleSheets.push(sheet);
                }""",
                style,
            )
        positions[name] = [position(row) for row in page.locator(".group:visible tbody tr:visible").all()]
        page.close()
    assert positions["loaded"] == positions["absent"]
    assert positions["loaded without sizes"] != positions["absent without sizes"]


@pytest.mark.exhaustive
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_pictures_have_alternative_texts_and_captions_have_contrast(browser: Any, index: Path, scheme: str) -> None:
    page = browser.new_page(color_scheme=scheme)
    page.goto(index.as_uri())
    pictures = page.locator(".overview img, .open img").all()
    assert {re.sub(r" \d\.png$", "", picture.get_attribute("alt")) for picture in pictures} == {"Photograph", "Reconstruction of"}
    assert {picture.get_attribute("loading") for picture in pictures} == {"lazy"}

    def contrast(text: str, background: str) -> float:
        ratio = """([text, background]) => {
            const style = getComputedStyle(document.documentElement);
            const luminance = (name) => [0.2126, 0.7152, 0.0722].reduce((sum, weight, channel) => {
                const value = parseInt(style.getPropertyValue(name).trim().slice(1 + 2 * channel, 3 + 2 * channel), 16) / 255;
                return sum + weight * (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
            }, 0);
            const [low, high] = [luminance(text), luminance(background)].sort((a, b) => a - b);
            return (high + 0.05) / (low + 0.05);
        }"""  # WCAG 2
        return float(page.evaluate(ratio, [text, background]))

    texts = [("--ink", "--paper"), ("--accent", "--paper"), ("--soft", "--paper"), ("--soft", "--tint")]
    assert min(contrast(*pair) for pair in texts) >= 4.5
    assert contrast("--rule", "--paper") < 4.5  # the negative control: no colour of text
    page.close()


@pytest.mark.exhaustive
def test_on_a_phone_the_photograph_stays_beside_the_reconstructions(phone: Any) -> None:
    strip, pictures = phone.locator(".overview:visible ul"), phone.locator(".overview:visible li")
    assert strip.evaluate("(one) => one.scrollWidth > 2 * one.clientWidth")
    before = position(pictures.first)
    assert position(pictures.last)["x"] > 360

    def is_uncovered(number: int) -> bool:
        box, photograph = position(pictures.nth(number)), position(pictures.first)
        assert photograph["x"] == before["x"]
        return photograph["x"] + photograph["width"] <= box["x"] and box["x"] + box["width"] <= 360

    pictures.last.locator("a").focus()
    assert is_uncovered(6)
    assert not is_uncovered(3)
    pictures.nth(3).locator("a").focus()
    assert is_uncovered(3)
    assert phone.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth")


@pytest.mark.exhaustive
def test_an_experiment_has_an_address(browser: Any, index: Path) -> None:
    for page in opened(browser, index, {"width": 1200, "height": 900}):
        address = page.locator("tr:visible .open").nth(3).get_attribute("href")
        page.goto("about:blank")
        page.goto(index.as_uri() + address)
        shows(page, "none against dia")


@pytest.mark.exhaustive
def test_other_results_are_chosen_from_a_list(page: Any) -> None:
    page.get_by_label("Results").select_option(index=2)
    assert page.locator(".group:visible h2").inner_text() == "Localization on gallery"
    assert listed(page) == ["none", LDP16, "affine:dim=4", LDP4, "new"]  # the most useful first
    assert page.locator(".group:visible .chart").count() == 0


@pytest.mark.exhaustive
def test_on_a_phone_nothing_runs_over_the_side(phone: Any) -> None:
    def fits() -> bool:
        return bool(phone.evaluate("document.documentElement.scrollWidth <= document.documentElement.clientWidth"))

    assert fits()
    phone.locator(".group:visible .only").uncheck()
    assert fits()
    phone.get_by_label("Sort by").locator("visible=true").select_option("ssim")
    scores = [float(value) for value in listed(phone, "ssim") if value]
    assert scores == sorted(scores)
    phone.get_by_label("Sort by").locator("visible=true").select_option("")
    phone.locator("tr:visible .open").first.click()
    assert phone.evaluate("(box => box.scrollWidth <= box.clientWidth)(document.querySelector('dialog[open]'))")
    assert dialog(phone).locator(".stage").bounding_box()["width"] <= 360
    phone.get_by_role("button", name="Close").click()
    phone.get_by_label("Results").select_option(index=1)  # whose name is long, and one word
    assert fits()


@pytest.mark.parametrize("width", [pytest.param(1420, marks=pytest.mark.slow), pytest.param(390, marks=pytest.mark.exhaustive)])
def test_identification_is_beside_ssim_and_in_sight(browser: Any, tmp_path: Path, width: int) -> None:
    records = [*reconstructions(ldp(4.0), [0.4, 0.5, 0.3] * 2), *baselines(NONE, 6)]
    for record, value in zip(records, [1.0, 1.0, 0.25, 1.0, 1 / 30, 0.5, *[1 / 128.5] * 12], strict=True):
        record["metrics"] |= {"identified": value, "psnr": 15.0, "face": 0.5}
    index = site.write([fabricated.write(tmp_path / "runs", records)], tmp_path / "site").page
    for page in opened(browser, index, {"width": width, "height": 900}):
        names = page.locator("thead th").evaluate_all("all => all.map(one => one.dataset.column)")
        assert names[names.index("ssim") + 1] == "identified"
        assert not {"identified_rank_1", "identified_bits"} & set(names), "they are in the column of identified"
        entry = page.locator('tbody tr:visible [data-column="identified"]').first
        frame, box = position(page.locator(".frame")), position(entry)
        assert frame["x"] <= box["x"]
        assert box["x"] + box["width"] <= frame["x"] + frame["width"]
        text = entry.inner_text().replace("\xa0", " ")
        assert re.fullmatch(r"0\.6\d+\s\[.+\]\s*3 of 6 \[0\.19, 0\.81\]\s*\d\.\d bits \[\d\.\d, \d\.\d\]", text)
        page.locator("tr:visible .open").first.click()
        assert "identified, bits of 8 (chance 0)" in dialog(page).inner_text()


@pytest.mark.exhaustive
def test_strings_of_users_are_text(page: Any) -> None:
    page.locator(".group:visible .only").uncheck()
    page.locator(".open", has_text="window.owned").locator("visible=true").first.click()
    dialog(page).locator("summary").click()
    text = dialog(page).inner_text()
    assert HOSTILE in text
    assert "{{ 7 * 7 }}" in text
    for number in range(2):
        page.evaluate("location.hash = ''")
        page.get_by_label("Results").select_option(index=number)
    assert page.evaluate("window.owned") is None
    assert page.locator("script").count() == 1
    assert page.locator("img[onerror]").count() == 0


@pytest.mark.exhaustive
def test_even_a_script_that_got_in_would_not_run(browser: Any, index: Path, tmp_path: Path) -> None:
    """The negative control of the escaping: unescaped markup does run a script without the policy, and not with it."""
    text = index.read_text(encoding="utf-8")
    policy = next(line for line in text.splitlines() if "Content-Security-Policy" in line)
    owned = {}
    for name, changed in (("with", text), ("without", text.replace(policy, ""))):
        (tmp_path / f"{name}.html").write_text(
            changed.replace("<main>", "<main><script>window.owned = 1</script>"), encoding="utf-8"
        )
        page = browser.new_page()
        page.goto((tmp_path / f"{name}.html").as_uri())
        owned[name] = page.evaluate("window.owned")
        page.close()
    assert owned == {"with": None, "without": 1}


def write_pictured(folder: Path, records: Sequence[dict[str, Any]], pictured: Sequence[dict[str, Any]]) -> Path:
    """Write records of which some have pictures."""
    for number, one in enumerate(pictured):
        draw_picture(reconstruction_path(folder, one), number)
    return fabricated.write(folder, records)


@pytest.mark.slow
def test_the_sample_above_the_table_is_the_first_that_most_ranked_defenses_have(tmp_path: Path) -> None:
    def choose(name: str, records: Sequence[dict[str, Any]], pictured: Sequence[dict[str, Any]]) -> str:
        (group,) = build_groups(load_records(write_pictured(tmp_path / name, records, pictured)))
        table = build_pairs_table(group)
        views = [build_view(group, table, row, [], tmp_path / "site", find_plugin) for row in table.rows]
        overview = build_overview(group, views)
        assert overview is not None
        return overview.sample

    none, affine, ranked = (reconstructions(one, [0.8, 0.7, 0.6, 0.5, 0.6, 0.7]) for one in (NONE, AFFINE, ldp(4.0)))
    unranked = [
        *reconstructions({"name": "new"}, [0.8] * 6, attack=NEAREST),
        *reconstructions({"name": "newer"}, [0.8] * 6, attack=NEAREST),
    ]
    records = [*none, *affine, *ranked, *unranked, *baselines(NONE, 6)]
    pictured = [*none, *affine[1:], *ranked[1:], unranked[0], unranked[6]]
    assert choose("one", records, pictured) == "1.png"  # three ranked defenses; 0.png has one, and two unranked ones
    pictured.remove(affine[1])
    assert choose("two", records, pictured) == "2.png"
    assert choose("three", records[::-1], pictured) == "2.png"  # workers write records as they finish
    assert choose("four", unranked, [unranked[1], unranked[2], unranked[8]]) == "2.png"  # without ranks, all rows count


@pytest.mark.slow
def test_a_defense_without_a_picture_shows_the_reason(tmp_path: Path) -> None:
    none, affine = reconstructions(NONE, [0.8, 0.7]), reconstructions(AFFINE, [0.4, 0.5])
    failed = fabricated.record("0.png", {}, defense=ldp(8.0), status="failed", reason="out of memory")
    records = [
        *none,
        *affine,
        *reconstructions(ldp(4.0), [0.2, 0.3])[1:],
        *[failed, *reconstructions(ldp(8.0), [0.2, 0.3])[1:]],
        fabricated.record("0.png", {"angle": 40.0}, defense={"name": "other"}, attack=NEAREST),
        inapplicable({"name": "new"}, DIA, "no network is trained for new"),
    ]
    page = site.write([write_pictured(tmp_path / "runs", records, none)], tmp_path / "site").page.read_text(encoding="utf-8")
    assert re.findall(r'<span class="absent">(.*)</span>', page) == [
        "The results folder has no photograph of this sample.",
        "The results folder has no reconstruction of this sample.",
        "not done",
        "failed: out of memory",
        "This attack returns no image.",
        "n/a: no network is trained for new",
    ]


@pytest.mark.slow
def test_a_group_without_pictures_has_none_above_its_table(tmp_path: Path) -> None:
    text = site.write([fabricated.write(tmp_path, localizations(NONE, [1, 0], DAYS[:2]))], tmp_path / "site").page.read_text()
    assert "<table>" in text
    assert '<section class="overview"' not in text
    assert "<img" not in text


@pytest.mark.slow
def test_names_of_records_lead_to_no_other_files(tmp_path: Path) -> None:
    """Somebody's records are shown with the pictures that lie beside them, and with no others."""
    secret = draw_picture(tmp_path / "secret.png", 1)
    (record,) = reconstructions(NONE, [0.5])
    record["sample"] = "../../../secret"
    folder = fabricated.write(tmp_path / "runs", [record])
    picture = reconstruction_path(folder, record)
    assert folder in picture.resolve().parents
    picture.parent.mkdir(parents=True)
    picture.symlink_to(secret)
    written = site.write([folder], tmp_path / "site").page
    assert not (written.parent / "pictures").exists()
    picture.unlink()
    shutil.copy(secret, picture)  # the control: a picture that lies there
    assert (site.write([folder], tmp_path / "site").page.parent / "pictures").exists()
    assert record["experiment_id"] == experiment_id({"name": "reconstruction"}, NONE, DIA, PHOTOGRAPHS, 0, SETTINGS)


@pytest.mark.slow
def test_it_is_written_alike_again(tmp_path: Path) -> None:
    records = reconstructions(NONE, [0.8, 0.7]) + reconstructions(ldp(4.0), [0.2, 0.3])
    folder = fabricated.write(tmp_path / "runs", records)
    site.write([folder], tmp_path / "site")
    before = {path: path.read_bytes() for path in (tmp_path / "site").rglob("*") if path.is_file()}
    assert {path.suffix for path in before} == {".html", ".md", ".csv", ".tex", ".png", ".pdf"}
    site.write([folder], tmp_path / "site")
    assert {path: path.read_bytes() for path in (tmp_path / "site").rglob("*") if path.is_file()} == before
