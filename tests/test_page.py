"""The page of a report as text: it is whole, safe, small, and says what the record says."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from browser import RECORD, angles, sphere

from beltrami_cli.errors import DataError
from beltrami_cli.grid import Grid
from beltrami_cli.report import index, page, words
from beltrami_cli.report.subject import Map, Subject
from beltrami_cli.surface import Mesh

NASTY = "a</script><script>alert(1)</script> & \"b\" 'c' <d>"


class Read(HTMLParser):
    """Every address that a page names, the text of its cells, and its scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.scripts: list[str] = []
        self.tags: list[str] = []
        self.words = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href", "srcset", "poster", "data")]
        if tag == "script":
            self.scripts.append("")

    def handle_data(self, data):
        if self.tags[-1:] == ["script"]:
            self.scripts[-1] += data
        elif self.tags[-1:] != ["style"]:
            self.words += data


def scene_of(text: str) -> dict:
    found = re.search(r'<script type="application/json" id="scene">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def unpacked(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def circle() -> Subject:
    turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    points = np.stack([8 + 6 * np.cos(turn), 8 + 6 * np.sin(turn), 0 * turn], 1)
    mesh = Mesh(points, np.stack([np.arange(60), (np.arange(60) + 1) % 60], 1))
    values = np.sin(turn)
    volume = np.random.default_rng(0).random((17, 17, 1))
    maps = (Map("before", values + 0.1, volume), Map("after", values, volume / 2))
    return Subject(
        "circle", maps, mesh, Grid.from_spacing((17, 17, 1)), compares=True, difference="removed", record=RECORD
    )


def flat() -> Subject:
    volume = np.random.default_rng(0).random((12, 13, 14))
    return Subject(
        "flat", (Map("before", None, volume), Map("after", None, volume / 2)), None, Grid.from_spacing((12, 13, 14)),
        compares=True, difference="removed", record=RECORD,
    )  # fmt: skip


def three_channels() -> Subject:
    one = angles(sphere(2))
    maps = tuple(replace(m, values=np.stack([m.values, 2 * m.values, 3 * m.values], 1)) for m in one.maps)
    return replace(one, maps=maps, period=None)


SUBJECTS = {
    "sphere": lambda: angles(sphere(2)),
    "cortex": lambda: angles(sphere(2, structure="CortexLeft")),
    "circle": circle,
    "flat": flat,
    "channels": three_channels,
    "volume alone": lambda: replace(flat(), maps=flat().maps[:1], compares=False, record=None),
    "compared": lambda: replace(angles(sphere(2)), maps=angles(sphere(2)).maps * 3, compares=False, record=None),
}


@pytest.mark.parametrize("name", SUBJECTS)
def test_a_page_names_nothing_outside_itself(name, tmp_path):
    file = tmp_path / "page.html"
    page.write(file, SUBJECTS[name]())
    read = Read(file.read_text(encoding="utf-8"))
    assert all(address.startswith("data:") for address in read.addresses)
    own = [script for script in read.scripts if "plotly.js v" not in script[:200]]
    assert not any("http" in script or "import(" in script for script in own)
    has_scene = name not in ("circle", "flat", "volume alone")
    assert (file.stat().st_size > 4e6) == has_scene
    assert "img" in read.tags


def test_letters_of_drawings_stay_readable_on_a_telephone():
    least = int(
        re.search(r"\.picture img \{[^}]*min-width: (\d+)px", Path(page.__file__).with_name("page.css").read_text())[1]
    )
    for subject in (circle(), flat(), three_channels()):
        for address in Read(page.page(subject)).addresses:
            if not address.startswith("data:image/svg"):
                continue
            svg = base64.b64decode(address.partition(",")[2]).decode()
            points = float(re.search(r'width="([\d.]+)pt"', svg)[1])
            sizes = [100 * float(each) for each in re.findall(r"scale\(([\d.]+) -[\d.]+\)", svg)]
            assert len(sizes) > 5
            assert min(sizes) * least / points >= 11


def test_names_are_text_and_never_markup(tmp_path):
    subject = angles(sphere(1), title=NASTY)
    maps = tuple(replace(each, title=NASTY) for each in subject.maps)
    record = {**RECORD, "Warnings": [NASTY], "Parameters": {NASTY: NASTY}, "Outputs": [NASTY]}
    text = page.page(replace(subject, maps=maps, record=record, notes=(NASTY,)))
    read = Read(text)
    assert "alert(1)" not in "".join(read.scripts[:1]) and len(read.scripts) == 3
    assert read.words.count(NASTY) >= 6
    assert scene_of(text)["maps"][0]["title"] == NASTY


def test_a_name_that_is_no_text_is_spelt_out(tmp_path):
    file = tmp_path / "page.html"
    page.write(file, replace(flat(), title="caf\udce9"))
    assert "caf\\udce9" in file.read_text(encoding="utf-8")


@pytest.mark.parametrize(("titles", "named"), [(("noisy", "denoised"), "noisy, denoised"), (("", ""), "Maps")])
def test_a_page_without_a_title_has_no_empty_heading(titles, named, monkeypatch):
    monkeypatch.setattr(page, "_pictures", lambda *_: [])
    maps = tuple(replace(each, title=title) for each, title in zip(flat().maps, titles, strict=True))
    text = page.page(replace(flat(), title="", maps=maps))
    assert "<h1" not in text
    assert f"<title>{named}</title>" in text


@pytest.mark.parametrize(("period", "of"), [(360.0, "°"), (2 * np.pi, " rad"), (24.0, ""), (None, "")])
def test_angles_have_their_unit(period, of):
    said = dict(words.facts(RECORD, period))
    assert said["Noise"] == f"39.9{of} → 0.593{of}"
    assert said["Removed (rms, voxels)"] == f"40.5{of}"
    assert said["Smoothness (FWHM)"] == "1.02 → 11.8 mm"


def test_the_time_leaves_out_the_picture():
    assert dict(words.facts({"Seconds": {"read": 0.25, "flow": 3.75, "report": 9.0}}))["Denoised in"] == "4.0 s"
    assert "Denoised in" not in dict(words.facts({"Seconds": {}}))


def test_a_flow_without_iterations_is_explained():
    note = "The flow changed nothing"
    assert note not in page.page(circle())
    none = replace(circle(), record={**RECORD, "Iterations": 0})
    assert f"{note}: what was removed is the extension to the surface alone." in page.page(none)
    at_vertices = tuple(replace(each, volume=None) for each in none.maps)
    assert f"{note}." in page.page(replace(none, maps=at_vertices, grid=None))


def test_parameters_that_are_not_set_take_one_line():
    record = {"Parameters": {"phi": None, "beta": 0.5, "edge": None, "seed": 0}}
    (table,) = words.tables(record)
    assert table.rows == [("beta", "0.5"), ("seed", "0"), ("not set", "phi, edge")]


def test_a_beta_that_was_chosen_is_said():
    record = {"Parameters": {"flow": "beltrami", "beta": "auto"}, "Choice": {"beta": 0.03333}}
    assert dict(words.facts(record))["Flow"] == "beltrami, beta 0.0333"
    assert next(words.tables(record)).rows[1] == ("beta", "0.03333 (auto)")
    unknown = {"Parameters": {"flow": "beltrami", "beta": "auto"}, "Choice": {"beta": None}}
    assert dict(words.facts(unknown))["Flow"] == "beltrami, beta auto"


def test_a_surface_without_any_value_says_so():
    one = angles(sphere(1))
    maps = tuple(replace(each, values=np.full_like(each.values, np.nan), filled=None) for each in one.maps)
    text = page.page(replace(one, maps=maps))
    assert "No values." in text
    assert scene_of(text)["scales"] == [None]
    assert "Histograms" not in Read(text).words
    assert "No values." not in page.page(one)


def test_what_was_done_and_every_parameter_are_said():
    words = Read(page.page(circle())).words
    for said in (
        "39.9 → 0.593",
        "40.5",
        "1.02 → 11.8 mm",
        "beltrami, beta 0.0251",
        "auto",
        "the noise of neighbours <looks>",
    ):
        assert said in words, said
    for said in ("depth", "-2, 2", "no", "ab" * 32, "/study/<map> & 'more'.nii.gz", "41.25", "beltrami_cli 0.0"):
        assert said in words, said


@pytest.mark.parametrize("key", [*RECORD, None])
@pytest.mark.parametrize("hole", ["absent", "null", "empty"])
def test_every_key_of_the_record_may_be_missing(key, hole, monkeypatch):
    monkeypatch.setattr(page, "_pictures", lambda *_: [])
    record = {k: v for k, v in RECORD.items() if k != key} if key else {}
    if hole == "null" and key:
        record[key] = None
    if hole == "empty" and key:
        record[key] = type(RECORD[key])()
    assert "circle" in page.page(replace(circle(), record=record))


def test_holes_within_the_record():
    holes = {key: dict.fromkeys(value) if isinstance(value, dict) else value for key, value in RECORD.items()}
    assert "circle" in page.page(replace(circle(), record=holes))


def test_the_scene_holds_the_surface_and_its_values():
    subject = angles(sphere(3))
    scene = scene_of(page.page(subject))
    mesh = subject.mesh
    assert np.array_equal(unpacked(scene["triangles"], "<u4").reshape(-1, 3), mesh.cells)
    placed = unpacked(scene["forms"][0]["positions"], "<u2").reshape(-1, 3) / 65535 - scene["forms"][0]["half"]
    assert np.abs(placed * 40 - mesh.vertices_ras_mm).max() < 40 / 65535
    for shown, drawn in zip(subject.maps, scene["maps"], strict=True):
        assert np.array_equal(unpacked(drawn["values"][0], "<f4"), shown.values.astype("f4"), equal_nan=True)
    assert np.array_equal(unpacked(scene["maps"][1]["filled"], "u1"), subject.maps[1].filled)
    assert scene["scales"] == [{"low": 0.0, "high": 360.0, "cyclic": True}]
    assert len(scene["views"]) == 4
    assert scene["best"]["name"] == "facing the data"
    assert scene["unit"] == "°"


def test_outlines_stand_a_little_off_the_surface():
    scene = scene_of(page.page(angles(sphere(4))))
    ends = unpacked(scene["forms"][0]["borders"], "<f4").reshape(-1, 3)
    radius = np.linalg.norm(ends, axis=1) / 0.5
    assert len(ends) > 40
    assert radius.min() > 1.0
    assert radius.max() < 1.02


@pytest.mark.slow
def test_a_quarter_of_a_million_triangles_stay_below_15_megabytes(tmp_path):
    mesh = sphere(7, structure="CortexLeft")  # 327,680
    file = tmp_path / "page.html"
    page.write(file, angles(mesh))
    assert file.stat().st_size < 15e6
    text = file.read_text(encoding="utf-8")
    scene = scene_of(text)
    triangles = unpacked(scene["triangles"], "<u4").reshape(-1, 3)
    assert 0.95 * page.TRIANGLES < len(triangles) <= page.TRIANGLES
    assert f"shown with {len(triangles):,} of 327,680 triangles" in text
    assert [form["name"] for form in scene["forms"]] == ["inflated", "folded"]
    known = np.isfinite(unpacked(scene["maps"][0]["values"][0], "<f4")).mean()
    assert known == pytest.approx(0.8, abs=0.02)


def test_many_channels_and_maps_are_cut_short_and_it_is_said(monkeypatch):
    monkeypatch.setattr(page, "CHANNELS", 2)
    text = page.page(three_channels())
    assert "Shown: the first 2 of 3 channels." in text
    assert len(scene_of(text)["maps"][0]["values"]) == 2
    assert "the first 4 of 6 maps" in page.page(SUBJECTS["compared"]())


def test_the_same_subject_makes_the_same_page():
    assert page.page(circle()) == page.page(circle())


def test_a_bug_in_a_drawing_is_not_told_as_a_full_disk(monkeypatch, tmp_path):
    def broken(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(page, "_pictures", broken)
    with pytest.raises(ZeroDivisionError):
        page.write(tmp_path / "page.html", flat())


def test_a_folder_that_is_not_there_is_told_in_a_line(tmp_path):
    with pytest.raises(DataError, match="cannot be written"):
        page.write(tmp_path / "absent" / "page.html", flat())


# The index of a batch


def row(job: str, output: Path, **changes) -> dict:
    filled = {
        "job": job, "config": "study.toml", "output": str(output), "status": "done", "seconds": 12.345,
        "noise_before": 39.914, "noise_after": 0.5932, "iterations": 5, "stop_reason": "auto", "warnings": (),
        "tries": 1, "reason": "",
    }  # fmt: skip
    return {**filled, **changes}


def test_the_index_links_what_is_there(tmp_path):
    folder = tmp_path / "o & <p>"
    folder.mkdir()
    for name in ("a.json", "a report#1.html", "b.png"):
        (folder / name).write_text("{}")
    rows = [
        row(NASTY, folder / "a.nii.gz"),
        row("b", folder / "b.nii.gz", status="failed", reason="<no> memory", warnings=("w & 1", "w2")),
        {"job": "c", "status": "open"},
    ]
    pages = {NASTY: folder / "a report#1.html", "b": folder / "b.png"}
    file = tmp_path / "index.html"
    index.write(file, rows, pages)
    read = Read(file.read_text(encoding="utf-8"))
    where = "o%20%26%20%3Cp%3E"
    assert set(read.addresses) == {"data:,", f"{where}/a%20report%231.html", f"{where}/a.json", f"{where}/b.png"}
    assert NASTY in read.words
    assert "<no> memory" in read.words
    assert "39.9" in read.words
    assert re.search(r"1\s*failed\s*1\s*open\s*1\s*done", read.words)
    assert read.tags.count("img") == 1
    assert file.stat().st_size < 20_000


def test_the_index_knows_where_it_will_be(tmp_path):
    (tmp_path / "r.html").write_text("")
    staged = tmp_path / "hidden"
    staged.mkdir()
    index.write(staged / "i.html", [row("a", tmp_path / "a.nii.gz")], {"a": tmp_path / "r.html"}, folder=tmp_path)
    assert '"r.html"' in (staged / "i.html").read_text()


def test_an_index_of_no_job(tmp_path):
    index.write(tmp_path / "i.html", [], {})
    assert "0 jobs" in (tmp_path / "i.html").read_text()


def test_a_vertex_without_a_triangle_does_not_shrink_the_surface():
    mesh = sphere(2)
    lonely = Mesh(np.concatenate([mesh.vertices_ras_mm, [[1e4, 0, 0]]]), mesh.cells)
    count = len(lonely.vertices_ras_mm)
    scene, _ = page._scene(Subject("s", (Map("a", np.arange(count, dtype=float)),), lonely), 1)
    assert np.allclose(scene["forms"][0]["half"], 0.5, atol=0.01)


def test_a_hemisphere_that_is_named_is_not_taken_by_its_position():
    mesh = angles(sphere(3)).mesh
    assert mesh is not None
    half = replace(mesh, vertices_ras_mm=mesh.vertices_ras_mm * 40 / np.abs(mesh.vertices_ras_mm).max() - [45.0, 0, 0])
    values = (Map("a", np.zeros(len(half.vertices_ras_mm))),)
    notes = [
        page._scene(Subject("s", values, replace(half, structure=name)), 1)[1] for name in ("CortexLeft", "Cortex")
    ]
    assert notes == [[], ["3-D: taken for a left hemisphere, by its position."]]
