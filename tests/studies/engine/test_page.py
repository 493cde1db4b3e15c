"""The page of studies, of folders with records made by hand."""

import base64
import re

import numpy as np
import pytest
from PIL import Image
from toy import ToyStudy

from jaxnbv.checks import InputError
from jaxnbv.studies.engine.chapters import chapters
from jaxnbv.studies.engine.page import write_page
from jaxnbv.studies.engine.records import RecordFolder

POINTS = {"farthest": [[100, 4000], [200, 3000], [300, 3500]], "random": [[100, 1000], [200, 2000], [300, 4500]]}
CONFIG = {"study": {"type": ToyStudy.__qualname__, "views": 2, "odd": "<b>|"}, "methods": ["farthest", "random"]}


def written(folder):
    """A study of three scenes with a chart and a picture."""

    def run(index):
        methods = {name: {"points": of[index]} for name, of in POINTS.items()}
        return {"scene": index, "methods": methods, "seconds": 2.0 + index}

    RecordFolder(folder, CONFIG).collect(range(3), run, progress=False)
    for name in ("picture_0", "points"):
        Image.new("RGB", (4, 3), "red").save(folder / f"{name}.png")
    return folder


def test_a_chapter_tells_means_differences_times_and_versions(tmp_path):
    (chapter,) = chapters(written(tmp_path))
    assert chapter.title == ToyStudy.title
    assert [caption for caption, _ in chapter.images] == ["points", "picture 0"]
    tables = {table.caption: table for table in chapter.tables if not table.group}
    points = tables["Points, by view"]
    assert points.header == ["view", "1", "2"]
    means = {row[0]: float(re.match(r"[\d.]+", row[2])[0]) for row in points.rows}
    assert means == {name: pytest.approx(np.mean(of, axis=0)[1], abs=0.05) for name, of in POINTS.items()}
    assert points.rows[0][2].endswith("**")
    (difference,) = tables["Points: farthest minus another method"].rows
    assert difference[0] == "random"
    assert difference[1].startswith("+1000.0 [")
    groups = {(table.caption, table.group) for table in chapter.tables}
    assert ("Many points in %, by view", "odd: 1 scene") in groups
    assert ("Many points in %, by view", "") in groups
    (verdict,) = chapter.claims
    assert verdict.against == {"random": ("level with", difference[1])}
    facts = " ".join(chapter.facts)
    assert "3 scenes" in facts
    assert "3 seconds a scene" in facts
    assert re.search(r"jax \d", facts)


def test_html_holds_its_images_and_nothing_of_the_settings_is_code(tmp_path):
    folder = written(tmp_path / "runs" / "study-toy")
    page = write_page(tmp_path / "runs", tmp_path / "new" / "page.html").read_text()
    assert f"{ToyStudy.title}: study-toy" in page
    images = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert [base64.b64decode(image) for image in images] == [
        (folder / f"{name}.png").read_bytes() for name in ("points", "picture_0")
    ]
    assert "<b>" not in page
    assert "&lt;b&gt;|" in page
    assert '<td class="best">' in page
    assert "Far apart | more is seen.</strong> Holds against 0 of 1: level with random" in page
    assert page.count("<summary>even: 2 scenes</summary>") == 1
    assert "http" not in page


def test_markdown_has_its_images_beside_it(tmp_path):
    """And none of an earlier page."""
    written(tmp_path / "runs")
    (tmp_path / "studies").mkdir()
    for name in ("3-of_a_study_that_is_gone.png", "mine.png"):
        (tmp_path / "studies" / name).write_bytes(b"PNG")
    page = write_page(tmp_path / "runs", tmp_path / "studies.md").read_text()
    kept = {path.name for path in (tmp_path / "studies").iterdir()}
    assert kept == {"0-points.png", "0-picture_0.png", "mine.png"}
    linked = re.findall(r"!\[[^]]+\]\(([^)]+)\)", page)
    assert linked == ["studies/0-points.png", "studies/0-picture_0.png"]
    assert all((tmp_path / name).is_file() for name in linked)
    lines = page.splitlines()
    assert f"| {ToyStudy.title} | 3 | Far apart \\| more is seen. | 0 of 1 |" in lines
    start = lines.index("**Points, by view**")
    head, rule, first, second = lines[start + 2 : start + 6]
    assert head == "| view | 1 | 2 |"
    assert rule == "| --- | ---: | ---: |"
    assert first.startswith("| farthest | ")
    assert "**3500.0 +- 288.7**" in first  # of 3000, 3500, 4000: 500 / sqrt(3)
    assert second.startswith("| random | ")


def test_what_is_no_study_is_refused(tmp_path):
    with pytest.raises(InputError, match="no folder"):
        chapters(tmp_path / "none")
    with pytest.raises(InputError, match="no study that has a scene"):
        chapters(tmp_path)
    with pytest.raises(InputError, match=r"must end in \.html or \.md"):
        write_page(written(tmp_path / "a"), tmp_path / "page.pdf")
    RecordFolder(tmp_path / "b", {"study": {"type": "OtherStudy"}}).collect(range(1), lambda index: {}, progress=False)
    with pytest.raises(InputError, match="'OtherStudy', which this version does not know"):
        chapters(tmp_path)
