"""The page of a report in a browser: drawn, offline, in step, and driven from the keyboard."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import angles, browser, is_there, open_page, pixels, sphere
from test_page import circle, row, three_channels

from beltrami_cli.report import index, page
from beltrami_cli.report.subject import Map, Subject

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not is_there(), reason="needs playwright and Chromium"),
    pytest.mark.xdist_group("browser"),
]


@pytest.fixture(scope="module")
def chromium():
    with browser() as started:
        yield started


@pytest.fixture(scope="module")
def cortex_file(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("page") / "a page & <more>.html"
    page.write(file, angles(sphere(3, structure="CortexLeft")))
    return file


@pytest.fixture(scope="module")
def opened(chromium, cortex_file):
    return open_page(chromium, cortex_file, height=640)


@pytest.fixture
def window(opened):
    """The cortex as its page opens."""
    window, _ = opened
    window.keyboard.press("r")
    settle(window)
    return window


def settle(window) -> None:
    """Wait until what a key asked for is drawn."""
    window.evaluate(
        "() => new Promise(done => { let n = 8; (function next() { n-- ? requestAnimationFrame(next) : done(); })(); })"
    )


def scenes(window) -> list[np.ndarray]:
    """What each scene shows, those that are hidden left out, in the order of the document."""
    return [pixels(each.screenshot()) for each in window.locator(".plot").all() if each.is_visible()]


def first(window) -> np.ndarray:
    """What the first scene shows."""
    return pixels(window.locator(".plot").first.screenshot())


def letters(window) -> str:
    """At the left, right, bottom and top of every pane, which must agree."""
    panes = {" ".join(pane.locator(".letter").all_inner_texts()) for pane in window.locator(".pane").all()}
    assert len(panes) == 1
    return panes.pop()


def cameras(window) -> list[dict]:
    """The eye of each scene as plotly.js has it."""
    return window.evaluate(
        "() => [...document.querySelectorAll('.plot')].map(plot => plot._fullLayout.scene._scene.getCamera().eye)"
    )


def eyes(window) -> np.ndarray:
    return np.array([[eye["x"], eye["y"], eye["z"]] for eye in cameras(window)])


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Share of pixels that differ clearly."""
    return float((np.abs(before - after).max(-1) > 20).mean())


def pressed(window, key: str) -> str | None:
    return window.locator(f'button[data-key="{key}"]').get_attribute("aria-pressed")


def test_nothing_is_asked_of_the_network_and_nothing_goes_wrong(opened):
    window, log = opened
    settle(window)
    assert log.errors == []
    assert [address[:5] for address in log.requests if not address.startswith(("data:", "blob:"))] == ["file:"]


def test_every_scene_is_drawn(window):
    drawn = scenes(window)
    assert len(drawn) == 4
    for scene in drawn:
        colours = np.unique(scene.reshape(-1, 3), axis=0)
        assert len(colours) > 300
        assert 0.1 < (scene.min(-1) < 250).mean() < 0.9


def test_before_and_after_differ_and_the_grey_of_missing_parts_is_seen(window):
    window.keyboard.press("2")  # towards the cap that is missing before, and filled in after
    settle(window)
    before, after, *_ = scenes(window)
    assert changed(before, after) > 0.05

    def grey(scene: np.ndarray) -> float:
        return ((np.ptp(scene, axis=-1) < 6) & (scene.max(-1) < 190) & (scene.min(-1) > 90)).mean()

    assert grey(before) > max(0.05, 3 * grey(after))


def test_a_drag_in_one_scene_turns_all_while_it_goes_on(window):
    before, place = scenes(window), window.locator(".plot").first.bounding_box()
    middle = place["x"] + place["width"] / 2, place["y"] + place["height"] / 2
    start = eyes(window)
    window.mouse.move(*middle)
    window.mouse.down()
    for step in range(1, 7):
        window.mouse.move(middle[0] + 15 * step, middle[1] + 4 * step)
    settle(window)
    midway = eyes(window)
    window.mouse.up()
    settle(window)
    end, after = eyes(window), scenes(window)
    assert np.ptp(start, axis=0).max() < 1e-6
    assert np.linalg.norm(midway - start, axis=1).min() > 0.3
    assert np.ptp(midway, axis=0).max() < 1e-6
    assert np.ptp(end, axis=0).max() < 1e-6
    assert window.locator("#view").inner_text() == "Seen: turned"
    assert all(changed(one, other) > 0.03 for one, other in zip(before, after, strict=True))


def test_the_wheel_brings_all_nearer(window):
    start = np.linalg.norm(eyes(window), axis=1)
    window.locator(".plot").nth(1).click()
    window.mouse.wheel(0, -100)
    window.wait_for_timeout(200)
    settle(window)
    end = np.linalg.norm(eyes(window), axis=1)
    assert end / start == pytest.approx(np.exp(-0.15), abs=1e-3)


def test_keys_1_to_4_look_from_four_sides_and_name_them(window):
    assert window.locator("#view").inner_text() == "Seen: facing the data"
    assert window.locator('button[aria-current="true"]').count() == 0
    towards, seen = [], []
    for key in "1234":
        window.keyboard.press(key)
        settle(window)
        current = window.locator('button[aria-current="true"]').get_attribute("data-key")
        seen.append((current, window.locator("#view").inner_text().removeprefix("Seen: "), letters(window)))
        at = eyes(window)
        assert np.ptp(at, axis=0).max() < 1e-3
        towards.append(at[0] / np.linalg.norm(at[0]))
    assert np.round(towards, 3).tolist() == [[-1, 0, 0], [1, 0, 0], [0, 0, 1], [0, -1, 0]]
    assert seen == [
        ("1", "lateral", "A P I S"),
        ("2", "medial", "P A I S"),
        ("3", "dorsal", "L R P A"),
        ("4", "posterior", "L R I S"),
    ]


def test_arrows_turn_a_scene_that_has_the_focus_and_all_others(window):
    window.keyboard.press("1")  # from the left
    settle(window)
    start = eyes(window)[0]
    window.locator(".pane").first.focus()
    for key, towards in (("ArrowRight", (0, -1)), ("ArrowLeft", (0, 1)), ("ArrowUp", (1, 0)), ("ArrowDown", (-1, 0))):
        window.keyboard.press(key)
        settle(window)
        at = eyes(window)
        assert np.ptp(at, axis=0).max() < 1e-3
        if key in ("ArrowRight", "ArrowUp"):
            up, across = (np.array(towards) * np.sin(np.radians(10))).tolist()
            assert at[0] / np.linalg.norm(at[0]) == pytest.approx([-np.cos(np.radians(10)), across, up], abs=1e-3)
        else:  # back again
            assert at[0] == pytest.approx(start, abs=1e-3)
    assert letters(window) == "A P I S"
    for _ in range(4):
        window.keyboard.press("ArrowUp")
    assert letters(window) == "A P IL SR"
    window.keyboard.press("+")
    settle(window)
    assert np.linalg.norm(eyes(window)[0]) / np.linalg.norm(start) == pytest.approx(0.9, abs=1e-3)
    assert window.locator("#view").inner_text() == "Seen: turned"


def test_outlines_and_missing_parts_are_toggled(window):
    window.keyboard.press("2")
    settle(window)
    before = first(window)
    for key in "fm":
        window.keyboard.press(key)
        settle(window)
        assert pressed(window, key) == "false"
        assert changed(before, first(window)) > 0.0005
        window.keyboard.press(key)
        settle(window)
        assert pressed(window, key) == "true"
    assert changed(before, first(window)) < 0.0002


def test_the_inflated_copy_is_hidden_and_comes_back_in_step(window):
    window.keyboard.press("i")
    assert (pressed(window, "i"), len(scenes(window))) == ("false", 2)
    window.keyboard.press("3")
    settle(window)
    window.keyboard.press("i")
    settle(window)
    assert (pressed(window, "i"), len(scenes(window))) == ("true", 4)
    assert np.ptp(eyes(window), axis=0).max() < 1e-3


def test_b_swaps_the_maps_in_place(window):
    place = window.locator("#panes").bounding_box()
    left = {**place, "width": place["width"] / 2 - 6}
    before = pixels(window.screenshot(clip=left))
    window.keyboard.press("b")
    settle(window)
    swapped = pixels(window.screenshot(clip=left))
    assert "after" in window.locator("#said").inner_text()
    window.keyboard.press("b")
    settle(window)
    assert changed(before, swapped) > 0.03
    assert changed(before, pixels(window.screenshot(clip=left))) < 0.0002


def test_every_button_is_reached_by_tab_and_shows_it(window):
    window.locator("h1").click()
    reached = []
    for _ in range(14):
        window.keyboard.press("Tab")
        reached.append(window.evaluate("() => document.activeElement.dataset.key || document.activeElement.className"))
        assert window.evaluate("() => getComputedStyle(document.activeElement).outlineStyle") != "none"
    assert reached == [*"1234", "r", "i", "f", "m", "b", "?", *["pane"] * 4]


def test_help_opens_and_closes(window):
    window.keyboard.press("?")
    assert window.locator("#help").is_visible()
    window.keyboard.press("Escape")
    assert not window.locator("#help").is_visible()


def test_the_value_under_the_pointer_is_told(window):
    window.keyboard.press("1")
    settle(window)
    place = window.locator(".plot").nth(1).bounding_box()
    window.mouse.move(place["x"] + place["width"] / 2, place["y"] + place["height"] / 2)
    window.mouse.move(place["x"] + place["width"] / 2 + 2, place["y"] + place["height"] / 2)
    window.wait_for_selector("#tip:visible", timeout=3000)
    said = window.locator("#tip").inner_text().split("\n")
    assert said[0].startswith("before")
    assert said[1].endswith("°")
    assert float(said[1].removeprefix("after").removesuffix("°")) == pytest.approx(180, abs=15)


def test_the_key_has_units_and_says_what_is_there(window):
    said = window.locator("#key").inner_text().split("\n")
    assert {"0°", "90°", "180°", "270°", "missing", "filled in: paler, outlined"} <= set(said)


def test_channels_change_surface_and_drawings(chromium, tmp_path):
    subject = three_channels()
    for shown in subject.maps:
        assert shown.values is not None
        shown.values[:, 2] = np.nan
    before, after = subject.maps
    everywhere = np.ones(len(after.values), bool)  # which has no border to draw
    subject = replace(subject, maps=(before, replace(after, filled=everywhere)))
    page.write(tmp_path / "channels.html", subject)
    window, log = open_page(chromium, tmp_path / "channels.html", height=640)
    assert len(scenes(window)) == 2
    ticks = window.locator("#key").inner_text()
    assert ticks.split("\n")[-2:] == ["missing", "filled in: paler"]
    assert not window.locator('button[data-key="f"]').is_visible()
    window.keyboard.press("c")
    settle(window)
    assert window.locator("#channel").input_value() == "1"
    assert window.locator("#key").inner_text() != ticks
    assert window.locator("section.picture[data-channel]:visible h2").all_inner_texts() == ["Histograms, channel 2"]
    window.locator("#channel").focus()
    window.keyboard.press("ArrowDown")
    settle(window)
    assert window.locator("#channel").input_value() == "2"
    # Of a channel without a value there is nothing that colours could mean.
    assert window.locator("#key").inner_text() == "missing"
    assert window.locator("section.picture[data-channel]:visible").count() == 0
    window.keyboard.press("c")
    settle(window)
    assert window.locator("#key").inner_text() == ticks
    assert log.errors == []


def test_a_curve_needs_no_script_and_a_telephone_scrolls_its_drawings(chromium, tmp_path):
    page.write(tmp_path / "curve.html", circle())
    window, log = open_page(chromium, tmp_path / "curve.html", width=420)
    assert log.errors == []
    assert window.locator("img").evaluate_all("images => images.every(each => each.width >= 840)")
    boxes = window.locator(".picture .scroll")
    assert boxes.evaluate_all("boxes => boxes.every(each => each.clientWidth < 420 && each.scrollWidth >= 840)")
    assert window.locator("img").evaluate_all("images => images.every(each => each.naturalWidth > 300 && each.alt)")
    assert window.evaluate("() => document.documentElement.scrollWidth <= innerWidth")


def test_the_index_is_sorted_by_click_and_key(chromium, tmp_path):
    rows = [row(name, tmp_path / name, seconds=s) for name, s in (("b", 9.5), ("a", 100.0), ("c", None))]
    index.write(tmp_path / "index.html", rows, {})
    window, log = open_page(chromium, tmp_path / "index.html")

    def order() -> str:
        return "".join(window.locator("tbody th").all_inner_texts())

    window.get_by_role("button", name="Job").click()
    assert order() == "abc"
    window.get_by_role("button", name="Seconds").focus()
    window.keyboard.press("Enter")
    assert order() == "bac"
    window.keyboard.press("Enter")
    assert order() == "abc"
    assert window.locator('th[aria-sort="descending"]').inner_text().startswith("Seconds")
    assert log.errors == []


def test_the_scale_tells_values_apart_that_differ_little(chromium, tmp_path):
    mesh = sphere(2)
    values = 15_000 + 30 * np.linspace(0, 1, len(mesh.vertices_ras_mm))
    page.write(tmp_path / "p.html", Subject("s", (Map("a", values),), mesh))
    window, _ = open_page(chromium, tmp_path / "p.html")
    labels = window.locator("#key .bar b").all_inner_texts()
    assert labels == ["15005", "15010", "15015", "15020", "15025"]
    window.close()
