"""The sampler of surfaces: its presets, and the use of observations, against closed forms."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import jaxnbv as nbv
from jaxnbv.sampler import MODELS

preset = nbv.SurfaceSampler.preset


def test_the_papers_model_has_its_published_values_and_is_not_carved():
    paper = preset("paper")
    assert eqx.tree_equal(paper.model, nbv.GeometricSPSR(0.005, 0.2, 50, 0.01, 1.5))
    assert paper.carving is None


@pytest.mark.parametrize(("given", "side"), [({"longest_side": 1.25}, 1.25), ({"volume": nbv.Box.cube(1.0)}, 1.0)])
def test_the_default_model_knows_the_box_and_carves_by_it(given, side):
    screened = preset("screened", **given)
    assert screened.carving.volume == screened.model.values[0].volume == nbv.Box.cube(side)


def test_lengths_are_in_proportion_to_the_object():
    large, small = (preset("screened", side).model for side in (2.5, 1.25))
    assert eqx.tree_equal(large, nbv.ScreenedSPSR())
    assert jnp.allclose(small.base.lengthscale, 0.5 * large.base.lengthscale)
    assert jnp.array_equal(small.base.variance, large.base.variance)
    assert small.offset == 0.5 * large.offset
    assert small.base.truncation > large.base.truncation


def test_solid_objects_have_no_values_in_empty_space():
    kinds = [[type(one).__name__ for one in preset("screened", solid=solid).model.values] for solid in (False, True)]
    assert kinds == [["OutsideBoundary", "OnSurface", "EmptySpace"], ["OutsideBoundary", "OnSurface"]]


def test_quick_surfaces_have_fewer_frequencies():
    for name in MODELS:
        full, quick = (preset(name, quick=quick).model for quick in (False, True))
        truncations = [getattr(model, "base", model).truncation for model in (full, quick)]
        assert truncations[1] < truncations[0]


def test_the_preset_is_the_default_and_another_name_is_refused():
    assert eqx.tree_equal(preset(), nbv.SurfaceSampler())
    for message, wrong in {
        r"no model 'mine': choose from screened, paper": ("mine",),
        r"-1\.0": ("screened", -1.0),
    }.items():
        with pytest.raises(nbv.InputError, match=message):
            preset(*wrong)


RADII = 0.25 + 0.15 * np.arange(8)
GRID, CAMERA, KEY = nbv.Grid(26, 1.6), nbv.Camera(height=30, width=30), jax.random.key(2)
POSES = nbv.look_at(jnp.array([[0.0, 0.2, 2.5], [2.3, 0.0, -0.9]]))
SCANS = nbv.scan(nbv.SDFSurface(nbv.sdf.Sphere(0.6)), CAMERA, POSES)
AWAY = np.linalg.norm(np.stack(np.meshgrid(*[GRID.axis] * 3, indexing="ij"), axis=-1), axis=-1)
# For few nodes rounding decides whether they are inside a ball.
SHARE = (AWAY[..., None] < RADII).mean(axis=-1)


class Balls(nbv.surfaces.Fields):
    def __call__(self, x):
        return 0.3 + jnp.linalg.norm(x, axis=-1) - jnp.asarray(RADII, x.dtype)[:, None]


class BallsPosterior(nbv.surfaces.SurfacePosterior):
    """Balls of eight radii with the level 0.3, for any observations."""

    level: Float[Array, ""]

    def sample(self, key, num_samples):
        assert num_samples == len(RADII)
        return Balls()

    def mean(self, x):
        return 0.3 + jnp.linalg.norm(x, axis=-1) - RADII.mean()


class BallsModel(nbv.SurfaceModel):
    def condition(self, observations):
        return BallsPosterior(jnp.asarray(0.3))


def balls(carving=nbv.Carving()):  # noqa: B008
    return nbv.SurfaceSampler(BallsModel(), GRID, len(RADII), carving)


def planner_of(sampler, obstacles=None):
    search = nbv.FarthestView(6)
    return nbv.Planner(nbv.Coverage(), search, CAMERA, sampler, obstacles=obstacles, capacity=200, max_views=4)


def seen(sampler, obstacles=None):
    """The observations after both scans."""
    planner = planner_of(sampler, obstacles)
    return planner.observe(planner.init(POSES[0], SCANS[0]), POSES[1], SCANS[1])


def test_the_probability_is_the_share_of_the_samples_that_hold_a_node():
    for observations in (SCANS[0], seen(balls(None))):
        np.testing.assert_allclose(balls(None).probability_inside(observations), SHARE, atol=1e-6)
    assert len(np.unique(SHARE)) == 9
    # A cloud alone shows nothing to be empty, but the volume still carves.
    small = balls(nbv.Carving(nbv.Box.cube(0.8)))
    np.testing.assert_allclose(
        small.probability_inside(SCANS[0]), np.where(small.carving.outside(GRID), 0.0, SHARE), atol=1e-6
    )


TABLE = nbv.Obstacles((nbv.sdf.HalfSpace([0.0, -0.3, 0.0], [0.0, 1.0, 0.0]),))


@pytest.mark.parametrize("carving", [nbv.Carving(), None])
def test_nothing_is_imagined_where_the_object_cannot_be(carving):
    """Within obstacles, with and without carving."""
    sampler = balls(carving)
    observations = seen(sampler, TABLE)
    nowhere = np.asarray(GRID.axis)[None, :, None] < -0.3
    if carving is not None:
        nowhere = nowhere | np.asarray(observations.empty_nodes) | np.asarray(carving.outside(GRID))
    nowhere = np.broadcast_to(nowhere, SHARE.shape)
    assert (nowhere & (SHARE > 0)).sum() > 50
    np.testing.assert_allclose(sampler.probability_inside(observations), np.where(nowhere, 0.0, SHARE), atol=1e-6)
    values, mean = np.asarray(sampler.sample(observations, KEY).values), np.asarray(sampler.mean(observations))
    assert (values[:, nowhere] > 0).all()
    assert (mean[nowhere] > 0).all()
    np.testing.assert_allclose(mean[~nowhere], (AWAY - RADII.mean())[~nowhere], atol=1e-5)
    np.testing.assert_allclose(values[:, ~nowhere], (AWAY - RADII[:, None, None, None])[:, ~nowhere], atol=1e-5)


def test_a_cut_by_the_volume_is_no_surface():
    """A slab cuts balls at the top. From above a ray meets the cut, which is no hit. From the side it hits the ball."""
    slab = nbv.Carving(nbv.Box((-1.25, -1.25, -1.25), (1.25, 0.1, 1.25)))
    surfaces = balls(slab).sample(SCANS[0], KEY)
    poses = nbv.look_at(jnp.array([[0.0, 2.5, 0.1], [0.0, 0.0, 2.5]]))
    above, beside = nbv.scanning.scan_samples(surfaces, CAMERA, poses).mask.sum(-1).T
    largest = np.argmax(RADII)
    assert int(above[largest]) < 0.1 * int(beside[largest])
    whole = balls().sample(SCANS[0], KEY)
    # The smallest ball reaches at most two spacings beyond the slab, so that nothing of it is cut.
    small = [nbv.scanning.scan_samples(one, CAMERA, POSES).mask[0, 1].sum() for one in (surfaces, whole)]
    assert int(small[0]) == int(small[1]) > 0


@pytest.mark.parametrize("margin", [0.0, 0.2])
def test_a_users_box_does_not_close_the_object_at_its_faces(margin):
    box = nbv.Box((-1.0, -0.5, -0.8), (1.0, 0.9, 0.7))
    rows = nbv.surfaces.OutsideBoundary(box, 200, margin=margin).rows(nbv.Observations.start(SCANS[0]))
    np.testing.assert_allclose(box(rows.points), margin, atol=1e-4)
    pair = preset(volume=box).model.values[0], nbv.SurfaceSampler().within(box).model.values[0]
    assert all(one.margin == 0.2 and one.volume == box for one in pair)
    assert preset().model.values[0].margin == 0.0


def test_a_given_posterior_is_not_computed_again():
    sampler, observations = nbv.SurfaceSampler(nbv.GeometricSPSR(0.1, truncation=6), GRID, 3), SCANS[0]
    posterior = sampler.posterior(observations)
    np.testing.assert_array_equal(
        sampler.sample(observations, KEY, posterior).values, sampler.sample(observations, KEY).values
    )
    other = BallsPosterior(jnp.asarray(0.3))
    np.testing.assert_allclose(sampler.mean(observations, other), balls().mean(observations), atol=1e-6)


def test_scans_of_samples_end_at_the_obstacles():
    wall = nbv.Obstacles((nbv.sdf.Cuboid([0.1, 1.0, 1.0]).translate([1.4, 0.0, -0.5]),))
    surfaces = balls().sample(SCANS[0], KEY)
    free, ended = (nbv.scanning.scan_samples(surfaces, CAMERA, POSES, b) for b in (None, wall.barrier(CAMERA, POSES)))
    assert ended.mask[:, 0].any()
    assert free.mask[:, 1].any()
    assert not ended.mask[:, 1].any()
    depth = [planner_of(balls(), wall).expected_depth(surfaces, pose) for pose in POSES]
    assert np.isfinite(depth[0]).any()
    assert not np.isfinite(depth[1]).any()


def test_another_box_takes_the_place_of_the_default_one_alone():
    box, own = nbv.Box.cube(1.4), nbv.Box.cube(2.0)
    model = nbv.ScreenedSPSR(
        values=(
            nbv.surfaces.OutsideBoundary(),
            nbv.surfaces.OutsideBoundary(own, 77),
            nbv.surfaces.OutsideBoundary(value=2.0),
        )
    )
    before = nbv.SurfaceSampler(model, GRID, 5, nbv.Carving(margin_voxels=1.5))
    after = before.within(box)
    assert [source.volume for source in after.model.values] == [box, own, box]
    assert after.carving == nbv.Carving(box, 1.5)
    assert [source.margin for source in after.model.values] == [0.2, 0.0, 0.2]
    # Everything else is unchanged.
    default = {"volume": nbv.Box(), "margin": 0.0}
    back = [dataclasses.replace(one, **default) for one in (after.model.values[0], after.model.values[2])]
    values = (back[0], after.model.values[1], back[1])
    model = dataclasses.replace(after.model, values=values)
    assert eqx.tree_equal(dataclasses.replace(after, model=model, carving=before.carving), before)
    sampler = nbv.SurfaceSampler(carving=nbv.Carving(own)).within(box)
    assert sampler.carving.volume == own
    assert eqx.tree_equal(preset("screened", 1.25).within(box), preset("screened", 1.25))
    assert eqx.tree_equal(preset("screened").within(box).carving, nbv.Carving(box))


@pytest.mark.parametrize("made_by", [balls(None), dataclasses.replace(balls(), grid=nbv.Grid(26, 1.5))])
def test_observations_of_another_grid_are_refused(made_by):
    own, observations, fits = balls(), seen(made_by), seen(balls())
    for use in (
        own.adapt,
        own.posterior,
        lambda observations: own.sample(observations, KEY),
        lambda observations: own.carve(observations, jnp.zeros((26,) * 3)),
        own.mean,
        own.probability_inside,
        own.mean_mesh,
        lambda observations: planner_of(own).observe(observations, POSES[1], SCANS[1]),
    ):
        with pytest.raises(nbv.InputError, match=r"surfaces are carved on Grid\(resolution=26, half_extent=1\.6\)"):
            use(observations)
        use(fits)


def test_without_carving_observations_of_any_grid_are_accepted():
    observations = seen(balls())
    adapted = balls(None).adapt(observations)
    assert adapted.empty_nodes is None
    np.testing.assert_array_equal(adapted.cloud.points, observations.cloud.points)


@pytest.mark.parametrize("carving", [None, nbv.Carving()])
def test_a_cloud_alone_is_from_no_pose_and_shows_nothing_to_be_empty(carving):
    alone = balls(carving).adapt(SCANS[0])
    assert eqx.tree_equal(alone, nbv.Observations.start(SCANS[0], 0, carving and GRID))
    assert int(alone.num_views) == 0
    assert carving is None or not alone.empty_nodes.any()


def test_values_of_another_grid_are_refused():
    with pytest.raises(nbv.InputError, match=r"\(25, 25, 25\).* but the grid has \(26, 26, 26\) nodes"):
        balls().carve(SCANS[0], jnp.zeros((25,) * 3))
