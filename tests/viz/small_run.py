"""A small planner and a small scene for the tests of pictures, which share compiled programs."""

import base64
import gzip
import json
import re
from html.parser import HTMLParser

import jax
import jax.numpy as jnp

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Sphere

CAMERA = nbv.Camera(height=12, width=12)
FIRST = nbv.look_at((0.8, 0.9, 2.2))
SCENE = nbv.SDFSurface(Sphere(0.7) | Sphere(0.35).translate([0.8, 0.3, 0.0]))


def small_planner(search, acquisition=None, **changes) -> nbv.Planner:
    imagined = {"model": nbv.GeometricSPSR(0.05, 0.2, 8), "num_samples": 2, "grid": nbv.Grid(24)}
    imagined |= {name: changes.pop(name) for name in ("carving", "obstacles", *imagined) if name in changes}
    acquisition = nbv.Coverage() if acquisition is None else acquisition
    options = {"camera": CAMERA, "capacity": 512, "sampler": nbv.SurfaceSampler(**imagined)}
    return nbv.Planner(acquisition, search, **(options | changes))


def small_run(search, views=3, scene=SCENE, acquisition=None, noise=None, first=FIRST, **changes) -> nbv.Episode:
    planner = small_planner(search, acquisition, **changes)
    noise = nbv.SensorNoise() if noise is None else noise
    return nbv.simulate(planner, scene, first, views, jax.random.key(0), noise, progress=False)


def scene_in_space(page: str) -> dict:
    """Unpack the data that a report stores for its view in space."""
    packed = re.search('id="inspace">([^<]*)<', page)
    return json.loads(gzip.decompress(base64.b64decode(packed[1])))


class NoisySpheres(nbv.surfaces.Fields):
    radii: jax.Array

    def __call__(self, x):
        return (jnp.linalg.norm(x, axis=-1) - self.radii[:, None]).astype(x.dtype)


class SpherePosterior(nbv.surfaces.SurfacePosterior):
    level: jax.Array

    def sample(self, key, num_samples):
        return NoisySpheres(0.9 + 0.03 * jax.random.normal(key, (num_samples,)))


class SphereModel(nbv.SurfaceModel):
    """A model whose samples are spheres with radii from N(0.9, 0.03^2), which depend only on the key."""

    def condition(self, cloud):
        return SpherePosterior(jnp.asarray(0.0))


class Page(HTMLParser):
    """The elements of a page: tag, attributes and the text that follows it."""

    def __init__(self, text):
        super().__init__()
        self.elements = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.elements.append([tag, dict(attributes), ""])

    def handle_data(self, text):
        if self.elements:
            self.elements[-1][2] += text

    def of(self, *tags):
        """Attributes of all elements with these tags."""
        return [attributes for tag, attributes, _ in self.elements if tag in tags]

    @property
    def tables(self):
        """Tables by caption, with the cells of each row by the row's name."""
        tables = {}
        for tag, _, raw in self.elements:
            text = raw.strip()
            if tag == "caption":
                rows = tables[text] = []
            elif tag == "tr":
                rows.append([])
            elif tag == "th" or (tag == "td" and text.strip()):
                rows[-1].append(text)
        return tables
