"""The studies of trucks, household objects and scans on a small scale: their records beyond those of pyramids."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from PIL import Image
from test_pyramid_study import small_study

from jaxnbv.checks import InputError
from jaxnbv.networks import InvariantClassifier, save_checkpoint
from jaxnbv.readers import class_meshes
from jaxnbv.studies.classification.objects import HouseholdStudy, OmniObject3DStudy, PyramidStudy, TruckStudy
from jaxnbv.studies.engine.chart import chart
from jaxnbv.studies.engine.pictures import write_pictures
from jaxnbv.studies.engine.results import results, summary
from jaxnbv.studies.engine.run import run_scene
from jaxnbv.studies.scenes import HOUSEHOLD, FirstView

SCENE = 4


@pytest.mark.parametrize("kind", [HouseholdStudy, PyramidStudy])
def test_the_first_view_can_be_one_after_which_the_classifier_is_wrong(kind):
    """It is the first such view in the random order of candidates. For a pyramid it must not show the pattern."""
    study = small_study(kind=kind, first=FirstView.MISCLASSIFIED)
    for index in range(3):
        scene = study.scene(index)
        first = study.first_view(scene)
        assert int(study.classifier(scene.task.scans[first]).argmax()) != scene.task.label
        if kind is PyramidStudy:
            assert int(scene.task.cue_pixels[first]) == 0
    always_right = lambda cloud: jnp.log(jnp.eye(len(kind.objects.classes))[scene.task.label])  # noqa: E731
    with pytest.raises(InputError, match="shows enough of"):
        dataclasses.replace(study, classifier=always_right).first_view(scene)


def test_first_views_of_trucks_are_random_and_grouped_by_what_they_show():
    study = small_study(kind=TruckStudy)
    firsts = [study.first_view(study.scene(index)) for index in range(12)]
    assert len({*firsts}) > 5
    for pixels, group in ((0, "first view without cargo"), (3, "first view with cargo")):
        assert TruckStudy.group({"methods": {"farthest": {"pixels": [[pixels, 400]]}}}) == group


@pytest.mark.parametrize("kind", [HouseholdStudy, pytest.param(TruckStudy, marks=pytest.mark.slow)])
def test_records_tables_charts_and_pictures(kind, tmp_path):
    """If the whole object tells its class, no pixels are counted."""
    record = json.loads(json.dumps(run_scene(small_study(kind=kind), SCENE), allow_nan=False))
    assert list(record["methods"]) == list(kind.methods)
    assert record["label"] == SCENE % len(kind.objects.classes)
    for method in record["methods"].values():
        assert np.shape(method["log_p"])[1:] == (3, 10)
        assert bool(method["pixels"]) == bool(kind.cue)
    table = results([record], kind)
    assert ("seen" in {*table["quantity"]}) == bool(kind.cue)
    assert kind.title in summary(table, kind)
    assert chart(table, kind)[:4] == b"\x89PNG"
    (picture,) = write_pictures([record], small_study(kind=kind), tmp_path, pixels=24)
    with Image.open(picture) as image:
        assert np.asarray(image.convert("L")).std() > 5


def box_files(folder, *names):
    for name in names:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box((1.0, 0.5, 0.25)).export(file)


def test_meshes_in_place_of_procedural_objects(tmp_path):
    box_files(tmp_path, "chair/a.off", "desk/b.obj")
    study = small_study(kind=HouseholdStudy, meshes=class_meshes(tmp_path, HOUSEHOLD))
    assert study.num_scenes == 2
    record = run_scene(study, 1, ("farthest", "coverage"))
    assert (record["label"], record["name"]) == (HOUSEHOLD.index("desk"), "desk b")
    assert len({tuple(view["position"]) for view in record["methods"]["coverage"]["views"]}) == 3
    points = study.scene(1).task.scans[record["first"]].to_numpy()[0]
    # A box of sides 2.5, 1.25 and 0.625, with noise of 0.01.
    away = np.abs(np.abs(points) - [1.25, 0.625, 0.3125]).min(axis=1)
    assert away.max() < 0.06
    (picture,) = write_pictures([record], study, tmp_path, pixels=24)
    assert picture.exists()
    with pytest.raises(InputError, match="no scene 2: the study has 2 meshes"):
        run_scene(study, 2)
    with pytest.raises(InputError, match="2 meshes of cargo and 0 of trucks: give both, or none"):
        small_study(kind=TruckStudy, meshes=class_meshes(tmp_path, HOUSEHOLD))


def test_a_network_of_ones_own_takes_the_place_of_the_shipped_one(tmp_path):
    network = InvariantClassifier(5, jax.random.key(0), groups=(20, 8))
    save_checkpoint(network, tmp_path / "mine.safetensors")
    box_files(tmp_path, "mango/mango_001/Scan/Scan.obj")
    settings = {"meshes": tmp_path, "classifier": tmp_path / "mine.safetensors"}
    (study,) = OmniObject3DStudy.configured("screened", 2, True, **settings).values()
    assert study.scene(0).name == "mango mango_001"
    assert (study.classifier.num_points, study.imagined_classifier.num_points) == OmniObject3DStudy.network_points
    np.testing.assert_array_equal(study.classifier.network.head[1].bias, network.head[1].bias)
    with pytest.raises(InputError, match=r"knows 5 classes; the study has 10: bathtub, bed"):
        HouseholdStudy.configured("screened", 2, True, classifier=tmp_path / "mine.safetensors")
    for name, word in (("meshes", "--classifier FILE"), ("classifier", "--meshes FOLDER.* lemon, mango")):
        with pytest.raises(InputError, match=f"nothing ships for the study omniobject3d: give {word}"):
            OmniObject3DStudy.configured("screened", 2, True, **{name: settings[name]})
