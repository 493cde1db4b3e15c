"""The study of a recording, and independent counts of its measures."""

import numpy as np
import pytest
from PIL import Image
from small_recording import COUNT, known_sensor, plain, recorded, tum

import jaxnbv as nbv
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.run import run_scene
from jaxnbv.studies.recorded import COVERAGE, EVEN, NEW_AREA, ORACLE, RecordedStudy
from jaxnbv.studies.shown_voxels import bounds_of

LOW, HIGH = (0.6, 1.6, 0.3), (1.4, 2.4, 0.9)
VIEWS = 3
SMALL = {"num_samples": 2, "grid_resolution": 24, "capacity": 200}


def configured(folder, **options):
    settings = SMALL | {"box": (*LOW, *HIGH)} | options
    return RecordedStudy.configured("screened", VIEWS, quick=True, folder=folder, **settings)[""]


@pytest.fixture(scope="module")
def sequence():
    return recorded()


@pytest.fixture(scope="module")
def study(sequence, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    known_sensor(plain, folder, sequence)
    return configured(folder)


def test_a_study_takes_intrinsics_and_unit(study, sequence, tmp_path):
    folder = tmp_path / "sequence"
    folder.mkdir()
    tum(folder, *sequence)
    same = configured(folder, intrinsics=(40.0, 40.0, 23.5, 17.5), depth_scale=1 / 5000)
    np.testing.assert_array_equal(same.recording.is_shown, study.recording.is_shown)


def test_the_default_box_is_around_what_was_seen(study):
    box = configured(study.folder, box=None).box
    assert [*box.low, *box.high] == bounds_of(nbv.readers.RecordedFrames(study.folder))


def test_settings_are_used_and_unknown_options_refused(study):
    assert configured(study.folder, num_starts=7, voxel=0.05).num_starts == 7
    with pytest.raises(TypeError, match="num_start"):
        configured(study.folder, num_start=7)


@pytest.fixture(scope="module")
def record(study):
    # The other methods have searches of all studies, and each compiles its own planner.
    return run_scene(study, 1, (NEW_AREA, "random", EVEN, ORACLE))


def test_every_method_is_measured_by_what_its_frames_show(study, record):
    acquisitions = {method: type(study.acquisition(method, study.scene(1))) for method in study.methods}
    assert acquisitions == dict.fromkeys(study.methods, nbv.NewSurface) | {COVERAGE: nbv.Coverage}
    first, is_shown = record["first"], study.recording.is_shown
    for name, method in record["methods"].items():
        frames = method["frames"]
        assert frames[0] == first, name
        assert len(set(frames)) == VIEWS
        expected = [is_shown[frames[: count + 1]].any(axis=0).mean() for count in range(VIEWS)]
        assert method["covered"] == pytest.approx(expected)
    assert record["methods"][EVEN]["frames"] == [(first + 3 * part) % COUNT for part in range(VIEWS)]
    gain = [is_shown[[first, other]].any(axis=0).sum() for other in range(COUNT)]
    best = record["methods"][ORACLE]
    assert gain[best["frames"][1]] == max(gain)
    assert all(method["covered"][1] <= best["covered"][1] for method in record["methods"].values())
    of_new = study.measures[1].compute(record, NEW_AREA)
    own = record["methods"][NEW_AREA]["covered"]
    assert of_new[3] == pytest.approx((own[2] - own[0]) / (best["covered"][2] - best["covered"][0]))


def test_its_pictures_show_every_method(study, record, tmp_path):
    (path,) = write_pictures([record], study, tmp_path, pixels=40)
    assert path.name == "scene_0001.png"
    pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
    assert len(np.unique(pixels, axis=0)) > 20


def test_first_views_differ_and_show_enough(study):
    firsts = [study.first_view(study.scene(index)) for index in range(4)]
    assert len(set(firsts)) == 4
    assert all(study.recording.is_shown[first].mean() >= 0.05 for first in firsts)


def test_what_the_study_cannot_use_is_named(study, sequence, tmp_path):
    known_sensor(plain, tmp_path, sequence)
    with pytest.raises(ValueError, match="give one of the models screened, paper"):
        RecordedStudy.configured("known", VIEWS, quick=True, folder=tmp_path)
    with pytest.raises(ValueError, match="no voxel"):
        run_scene(configured(tmp_path, box=(9, 9, 9, 10, 10, 10)), 0)
