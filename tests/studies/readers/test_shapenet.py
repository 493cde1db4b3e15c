"""The reader of ShapeNetCore on tiny folders of the layouts of its two versions, whole, partial and damaged."""

import warnings

import numpy as np
import pytest
import trimesh

from jaxnbv.checks import InputError
from jaxnbv.networks.categories import CATEGORIES
from jaxnbv.studies.readers import SYNSETS, ShapeNet

CAR, CHAIR = "02958343", "03001627"


def meshes(folder, form, **models):
    for synset, names in models.items():
        for name in names.split():
            file = folder / synset[1:] / name / form
            file.parent.mkdir(parents=True)
            trimesh.creation.box((0.2, 0.1, 0.4)).export(file)


@pytest.fixture(params=["model.obj", "models/model_normalized.obj"], ids=["v1", "v2"])
def folder(request, tmp_path):
    meshes(tmp_path, request.param, _02958343="c1 a1 b1", _03001627="d1")
    (tmp_path / "taxonomy.json").write_text("[]")
    return tmp_path


def test_categories_by_name_or_synset(folder):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cars = ShapeNet(folder, "car")
        both = ShapeNet(str(folder), ["Chair", CAR])
    assert (cars.classes, [file.name for file in cars.files]) == (("car",), ["a1", "b1", "c1"])
    assert both.classes == ("chair", "car")
    assert [(shape.name, shape.label) for shape in both] == [("d1", 0), ("a1", 1), ("b1", 1), ("c1", 1)]
    # Upward is y in the file and here.
    np.testing.assert_allclose(np.ptp(cars[0].mesh.vertices, axis=0), [1.25, 0.625, 2.5])
    with pytest.raises(IndexError):
        cars[3]


def test_models_that_are_chosen_keep_their_order(folder):
    assert [shape.name for shape in ShapeNet(folder, "car", ["c1", "a1", "c1"])] == ["c1", "a1"]
    assert [shape.name for shape in ShapeNet(folder, ("car", "chair"), ("d1", "b1"))] == ["b1", "d1"]
    message = f"2 of the 3 models have no mesh in .*{CAR}: d1, e1; unpack"
    with pytest.raises(InputError, match=message):
        ShapeNet(folder, "car", ["e1", "a1", "d1"])
    with pytest.raises(InputError, match="no model is chosen"):
        ShapeNet(folder, "car", [])


def test_a_category_that_no_table_knows_goes_by_its_synset(folder):
    (folder / CAR).rename(folder / "04490091")
    assert ShapeNet(folder, "04490091").classes == ("04490091",)


def test_categories_and_folders_that_do_not_exist(folder):
    with pytest.raises(InputError, match="no category 'truck' in ShapeNet: give a synset, or choose from airplane"):
        ShapeNet(folder, "truck")
    with pytest.raises(InputError, match="no folder for 1 of the 2 classes: 02691156"):
        ShapeNet(folder, ["car", "airplane"])
    with pytest.raises(InputError, match="there is no folder"):
        ShapeNet(folder / "nowhere", "car")
    with pytest.raises(InputError, match="no category is chosen"):
        ShapeNet(folder, [])


def test_what_a_copy_lacks_is_named_by_path(folder):
    (file,) = (folder / CAR / "b1").rglob("*.obj")
    file.unlink()
    with pytest.warns(UserWarning, match=rf"1 of the 3 meshes of .*{CAR} are not there .*: {file}; unpack"):
        cars = ShapeNet(folder, "car")
    assert [shape.name for shape in cars] == ["a1", "c1"]
    with pytest.raises(InputError, match="1 of the 1 models have no mesh"):
        ShapeNet(folder, "car", "b1")
    (file,) = (folder / CHAIR / "d1").rglob("*.obj")
    file.unlink()
    with pytest.raises(
        InputError, match=rf"none of the 1 meshes of .*{CHAIR} is there: .*{CHAIR}/d1/models/model_norm"
    ):
        ShapeNet(folder, "chair")
    (folder / "02691156").mkdir()
    with pytest.raises(InputError, match=r"there are no meshes of .*02691156"):
        ShapeNet(folder, "airplane")


def test_a_model_without_faces_is_named_when_it_is_read(folder):
    """The first version has a knife and a rifle that are empty."""
    cars = ShapeNet(folder, "car")
    (file,) = (folder / CAR / "b1").rglob("*.obj")
    file.write_text("# nothing\n")
    with pytest.raises(InputError, match=str(file)):
        cars[1]
    assert cars[2].name == "c1"


def test_synsets_agree_with_those_of_the_parts():
    assert {category.name: category.synset for category in CATEGORIES}.items() <= SYNSETS.items()
    # 55 of the second version, and the two more of the first.
    assert len({*SYNSETS.values()}) == 57
