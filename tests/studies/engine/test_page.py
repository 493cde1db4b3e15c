"""The page of studies, from folders with records made by hand."""

import base64
import re

import pytest
from PIL import Image
from toy import ToyStudy

from jaxnbv.checks import InputError
from jaxnbv.studies.engine.page import chapters, write_page
from jaxnbv.studies.engine.records import RecordFolder

POINTS = {"farthest": [[100, 4000], [200, 3000], [300, 3500]], "random": [[100, 1000], [200, 2000], [300, 4500]]}
CONFIG = {"study": {"type": ToyStudy.__qualname__, "views": 2, "odd": "<b>|"}, "methods": ["farthest", "random"]}


def written(folder):
    """A study of three scenes with a picture, and a chart of an earlier state with fewer scenes."""

    def run(index):
        methods = {name: {"points": of[index]} for name, of in POINTS.items()}
        return {"scene": index, "methods": methods, "seconds": 2.0 + index}

    RecordFolder(folder, CONFIG).collect(range(3), run, progress=False)
    for name in ("picture_0", "chart"):
        Image.new("RGB", (4, 3), "red").save(folder / f"{name}.png")
    return folder


def test_a_chapter_tells_means_differences_times_and_versions(tmp_path):
    (chapter,) = chapters(written(tmp_path))
    assert chapter.title == ToyStudy.title
    assert [caption for caption, _ in chapter.images] == ["chart.png", "picture_0"]
    assert list(chapter.tables) == ["all: 3 scenes", "even: 2 scenes", "odd: 1 scene"]
    tables = dict(chapter.tables["all: 3 scenes"])
    assert "<td>3500.0 +- 288.7*</td>" in tables["Points, by view"]  # of 3000, 3500, 4000: 500 / sqrt(3)
    assert "<td>+1000.0 [" in tables["Points: farthest minus another method"]
    assert "Many points (%), by view" in dict(chapter.tables["odd: 1 scene"])
    (verdict,) = chapter.verdicts
    assert (verdict.num_held, verdict.num_methods) == (0, 1)
    facts = " ".join(chapter.facts)
    assert "3 seconds per scene" in facts
    assert re.search(r"jax \d", facts)


def test_html_holds_its_images_and_nothing_of_the_settings_is_code(tmp_path):
    folder = written(tmp_path / "runs" / "study-toy")
    page = write_page(tmp_path / "runs", tmp_path / "new" / "page.html").read_text()
    assert ToyStudy.title in page
    assert "study-toy" not in page
    images = [base64.b64decode(image) for image in re.findall(r'src="data:image/png;base64,([^"]+)"', page)]
    assert len(images) == 2
    assert images[1] == (folder / "picture_0.png").read_bytes()
    assert images[0] != (folder / "chart.png").read_bytes()
    assert "<b>" not in page
    assert "&lt;b&gt;|" in page
    assert "Far apart | more is seen.</strong> Holds against 0 of 1: level with random" in page
    assert page.count("<summary>even: 2 scenes</summary>") == 1
    assert not re.search(r"(src|href)=.?http", page)


def test_only_studies_of_one_kind_are_named_after_their_folders(tmp_path):
    for name in ("one", "two"):
        written(tmp_path / name)
    assert [chapter.title for chapter in chapters(tmp_path)] == [f"{ToyStudy.title}: {name}" for name in ("one", "two")]


def test_what_is_no_study_is_refused(tmp_path):
    with pytest.raises(InputError, match="no folder"):
        chapters(tmp_path / "none")
    with pytest.raises(InputError, match="no study that has a scene"):
        chapters(tmp_path)
    with pytest.raises(InputError, match=r"must end in \.html"):
        write_page(written(tmp_path / "a"), tmp_path / "page.pdf")
    RecordFolder(tmp_path / "b", {"study": {"type": "OtherStudy"}}).collect(range(1), lambda index: {}, progress=False)
    with pytest.raises(InputError, match="'OtherStudy', which this version does not know"):
        chapters(tmp_path)
