"""The demonstration object, a mug on a saucer. Parts of its surface show from few directions only."""

import math

from jaxnbv.scanning.sdf import Capsule, Cone, Cuboid, Cylinder, SignedDistance, SmoothUnion, Sphere, Torus
from jaxnbv.scanning.sphere_tracing import SDFSurface


def demo_object() -> SDFSurface:
    """Return an empty mug on a saucer, with a spoon in the mug and two lumps of sugar beside the mug.

    The y axis is up. The longest side, across the saucer, is 2.5. Only few directions show the inside of the mug, the
    bowl of the spoon, the underside of the saucer, and what is behind the mug. Nothing is thinner than 0.06, except the
    lip of the spoon's bowl.
    """
    return SDFSurface((_saucer() | _mug() | _spoon() | _sugar()).translate([0.0, -0.87, 0.0]))


def _saucer() -> SignedDistance:
    plate = Cone(0.62, 1.2, 0.13).translate([0.0, 0.15, 0.0])
    hollow = Cone(0.62, 1.2, 0.13).translate([0.0, 0.25, 0.0])
    rim = Torus(1.2, 0.05).translate([0.0, 0.28, 0.0])
    foot = (Cylinder(0.6, 0.05) - Cylinder(0.5, 0.1)).translate([0.0, 0.03, 0.0])
    return SmoothUnion(plate - hollow, rim, 0.04) | foot


def _mug() -> SignedDistance:
    outside = Cone(0.46, 0.62, 0.6)
    inside = Cone(0.38, 0.54, 0.6).translate([0.0, 0.09, 0.0])
    rim = Torus(0.575, 0.045).translate([0.0, 0.6, 0.0])
    ring = Torus(0.3, 0.07).rotate([1.0, 0.0, 0.0], 0.5 * math.pi)
    handle = ring.translate([0.6, 0.02, 0.0])
    return (SmoothUnion(SmoothUnion(outside, handle, 0.1) - inside, rim, 0.03)).translate([0.0, 0.71, 0.0])


def _spoon() -> SignedDistance:
    high = [-0.62, 1.7, -0.3]
    stem = Capsule([0.24, 0.3, 0.11], high, 0.04)
    bowl = (Sphere(0.18) - Sphere(0.11).translate([-0.03, 0.11, 0.0])).translate([0.16, 0.36, 0.08])
    return SmoothUnion(stem, Sphere(0.07).translate(high), 0.1) | bowl


def _sugar() -> SignedDistance:
    cube = Cuboid([0.12, 0.12, 0.12], 0.03)
    first = cube.rotate([0.0, 1.0, 0.0], 0.3).translate([-0.55, 0.3, 0.6])
    second = cube.rotate([0.0, 1.0, 0.0], 1.0).translate([-0.78, 0.31, 0.3])
    return first | second
