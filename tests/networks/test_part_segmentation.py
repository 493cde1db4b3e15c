"""Part segmentation against reference outputs in the published layout and a plain NumPy network; checkpoints;
clouds."""

import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import published_networks as published
import pytest
from published_networks import layers, near_sphere
from safetensors.numpy import save_file

import jaxnbv as nbv
from jaxnbv.networks import (
    CATEGORIES,
    CloudSegmenter,
    PointNet2PartSegmenter,
    category_index,
    load_checkpoint,
    part_mask,
)
from jaxnbv.networks.layers import FeaturePropagation, PooledMLP, SetAbstraction

RNG = np.random.default_rng(0)
SAMPLING = {
    "ssg": ((512, (0.2,), (32,)), (128, (0.4,), (64,))),
    "msg": ((512, (0.1, 0.2, 0.4), (32, 64, 128)), (128, (0.4, 0.8), (64, 128))),
}
segment = eqx.filter_jit(lambda network, *arguments: network(*arguments))


def small_network():
    """A network with few centres and narrow layers, sixteen categories and fifty parts."""
    return PointNet2PartSegmenter(
        (
            SetAbstraction((PooledMLP(layers(RNG, 9, 8, 9)),), (0.6,), (8,), 12),
            SetAbstraction((PooledMLP(layers(RNG, 12, 10, 11)),), (1.0,), (8,), 5),
        ),
        PooledMLP(layers(RNG, 14, 12, 13)),
        (
            FeaturePropagation(layers(RNG, 11 + 13, 12)),
            FeaturePropagation(layers(RNG, 9 + 12, 10)),
            FeaturePropagation(layers(RNG, 25 + 10, 14)),
        ),
        layers(RNG, 14, 12)[0],
        layers(RNG, 12, 50)[0],
    )


def random_state(kind, inputs, categories=16, parts=50):
    """`inputs` counts coordinates twice, like the first level."""

    def head(widths):
        below = 12
        for number, own in ((3, widths[2]), (2, widths[1]), (1, categories + 3 + widths[0])):
            for i, pair in enumerate(itertools.pairwise((own + below, 9, 7 + number))):
                yield f"fp{number}.mlp_convs.{i}", f"fp{number}.mlp_bns.{i}", *pair, (1,)
            below = 7 + number
        yield from (("conv1", "bn1", below, 9, (1,)), ("conv2", None, 9, parts, (1,)))

    return published.random_state(RNG, kind, SAMPLING[kind], inputs, head)


def plain_network(state, kind, points, normals, category, categories=16):
    features = points if normals is None else np.concatenate([points, normals], axis=1)
    one_hot = np.tile(np.eye(categories)[category], (len(points), 1))
    stages, x = published.encode(state, kind, SAMPLING[kind], points, features)
    stages = [(points, np.concatenate([one_hot, points, features], axis=1)), *stages]
    x = np.tile(x, (len(stages[-1][0]), 1))
    coarse = None
    for number, (points, own) in zip((3, 2, 1), reversed(stages), strict=True):
        if coarse is not None:
            squared = ((points[:, None] - coarse) ** 2).sum(axis=-1)
            nearest = np.argsort(squared, axis=1, kind="stable")[:, :3]
            weights = 1 / (np.take_along_axis(squared, nearest, axis=1) + 1e-8)
            x = np.einsum("nk,nkf->nf", weights / weights.sum(axis=1, keepdims=True), x[nearest])
        x = np.concatenate([own, x], axis=1)
        x = published.perceptron(state, x, f"fp{number}.mlp_convs", f"fp{number}.mlp_bns")
        coarse = points
    x = published.layer(state, published.layer(state, x, "conv1", "bn1"), "conv2")
    return x - np.log(np.exp(x).sum(axis=1, keepdims=True))


def test_log_probabilities_are_those_of_the_reference(shared):
    network = load_checkpoint(shared / "reference" / "pointnet2_partseg_msg.pth")
    with np.load(shared / "reference" / "pointnet2_partseg_msg_io.npz") as saved:
        points, categories, expected = (saved[name] for name in ("points", "category", "log_probs"))
    assert network.uses_normals
    assert network.num_categories == 16
    assert np.ptp(expected) > 1
    for cloud, category, log_p in zip(jnp.asarray(points), categories, expected, strict=True):
        result = segment(network, cloud[:, :3], cloud[:, 3:], jnp.asarray(category))
        np.testing.assert_allclose(result, log_p, atol=3e-5)


@pytest.mark.parametrize(("kind", "inputs", "n"), [("ssg", 6, 60), ("msg", 9, 560)])
def test_against_a_plain_network(x64, tmp_path, kind, inputs, n):
    """Both layouts, with and without normals, and with fewer points than centres, which are then repeated."""
    state = random_state(kind, inputs)
    save_file(state, tmp_path / "net.safetensors")
    network = load_checkpoint(tmp_path / "net.safetensors")
    assert isinstance(network, PointNet2PartSegmenter)
    assert network.uses_normals == (inputs == 9)
    points, normals = near_sphere(RNG, n)
    answers = []
    for category in (4, 15):
        plain = [np.asarray(a) for a in (points, normals)]
        answers.append(plain_network(state, kind, plain[0], plain[1] if inputs == 9 else None, category))
        log_p = segment(network, points, normals, jnp.asarray(category))
        np.testing.assert_allclose(log_p, answers[-1], atol=1e-10)
    assert np.abs(answers[0] - answers[1]).max() > 0.01


def test_masked_rows_and_capacity_do_not_matter():
    network, (points, normals) = small_network(), near_sphere(RNG, 30)
    expected = segment(network, points, normals, jnp.asarray(3))
    assert np.ptp(expected, axis=0).max() > 0.01
    np.testing.assert_allclose(np.exp(expected).sum(axis=1), 1.0, atol=1e-5)
    place = np.sort(RNG.permutation(40)[:30])
    mask = np.zeros(40, bool)
    mask[place] = True
    wide = np.full((2, 40, 3), np.nan, np.float32)
    wide[:, place] = points, normals
    log_p = segment(network, *wide, jnp.asarray(3), mask)
    np.testing.assert_allclose(log_p[place], expected, atol=1e-5)


def test_calls_that_cannot_be_answered_are_refused():
    network, (points, normals) = small_network(), near_sphere(RNG, 30)
    for category in (-1, 16, np.asarray(50)):
        with pytest.raises(nbv.InputError, match="the network has 0 to 15"):
            network(points, normals, category)
    with pytest.raises(nbv.InputError, match="n > 0"):
        network(points[:0], normals[:0], 3)


def test_tensors_that_make_no_segmenter_are_named(tmp_path):
    state = random_state("msg", 9)

    def problem(changes, without=()):
        arrays = {name: array for name, array in {**state, **changes}.items() if name not in without}
        save_file(arrays, tmp_path / "net.safetensors")
        with pytest.raises(nbv.InputError, match=r"net\.safetensors does not hold") as error:
            load_checkpoint(tmp_path / "net.safetensors")
        return str(error.value)

    ones = np.ones((4, 5, 1))
    assert "fp2.mlp_bns.1.running_mean is missing" in problem({}, ["fp2.mlp_bns.1.running_mean"])
    assert "fp3.mlp_convs.0.weight has shape (4, 5, 1); expected (any, 25)" in problem({"fp3.mlp_convs.0.weight": ones})
    few = np.ones((9, 9 + 3 + 6, 1))
    assert "fp1.mlp_convs.0.weight has no inputs for categories" in problem({"fp1.mlp_convs.0.weight": few})
    assert "takes 5 inputs; expected 6 (points) or 9" in problem({"sa1.conv_blocks.0.0.weight": ones})
    assert "conv2 has entries that are not finite" in problem({"conv2.bias": np.full(50, np.inf)})
    assert "not part of such a network, such as ['fc3.weight']" in problem({"fc3.weight": ones})


def test_the_parts_of_all_categories_make_up_the_fifty():
    mask = part_mask()
    assert mask.shape == (16, 50)
    assert mask.sum(axis=0).tolist() == [1] * 50
    assert mask.sum(axis=1).tolist() == [4, 2, 2, 4, 4, 3, 3, 2, 4, 2, 6, 2, 3, 3, 3, 3]
    assert np.flatnonzero(mask[category_index("chair")]).tolist() == [12, 13, 14, 15]
    assert [category_index(category.name) for category in CATEGORIES] == list(range(16))
    assert len({category.synset for category in CATEGORIES}) == 16
    with pytest.raises(nbv.InputError, match=r"no category 'sofa'.*chair"):
        category_index("sofa")


answers_of = eqx.filter_jit(lambda segmenter, cloud: (segmenter(cloud), *segmenter.predict(cloud)))


def test_a_cloud_segmenter_gives_probabilities_of_the_categorys_parts():
    network, (points, normals) = small_network(), near_sphere(RNG, 30)
    segmenter = CloudSegmenter(network, "Table", num_points=40, scale=0.5)
    cloud = nbv.PointCloud.from_arrays(2 * points, normals, 50)
    p, fed, labels = answers_of(segmenter, cloud)
    p = np.asarray(p)
    assert p.shape == (40, 50)
    np.testing.assert_array_equal(np.asarray(fed.mask), np.arange(40) < 30)
    assert not p[30:].any()
    assert not p[:, :47].any()
    np.testing.assert_allclose(p[:30].sum(axis=1), 1.0, atol=1e-6)
    # The network's own answer for the points in the order that it gets, at its scale, given the category.
    log_p = segment(network, 0.5 * fed.points, fed.normals, jnp.asarray(15), fed.mask)
    expected = np.exp(np.asarray(log_p, np.float64))[:30, 47:]
    np.testing.assert_allclose(p[:30, 47:], expected / expected.sum(axis=1, keepdims=True), atol=1e-5)
    np.testing.assert_array_equal(labels, np.where(np.arange(40) < 30, p.argmax(axis=1), -1))
    assert set(np.asarray(labels[:30]).tolist()) <= {47, 48, 49}
    p, _, labels = answers_of(segmenter, nbv.PointCloud(cloud.points, cloud.normals, jnp.zeros(50, bool)))
    assert not np.asarray(p).any()
    assert (np.asarray(labels) == -1).all()


def test_scenes_of_all_categories_and_scales_share_one_program(compilations):
    network, cloud = small_network(), nbv.PointCloud.from_arrays(*near_sphere(RNG, 30), 50)
    segmenters = [CloudSegmenter(network, index, 40, 1.0 + 0.1 * index) for index in range(16)]
    answers_of(segmenters[0], cloud)
    compilations.clear()
    answers = [answers_of(segmenter, cloud)[0] for segmenter in segmenters]
    assert not compilations
    for answer, allowed in zip(answers, part_mask(), strict=True):
        np.testing.assert_array_equal(np.asarray(answer).any(axis=0), allowed)
