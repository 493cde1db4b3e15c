"""Analytic signed distance functions and constructive solid geometry of them."""

from jaxnbv.scanning.sdf.base import Difference as Difference
from jaxnbv.scanning.sdf.base import Intersection as Intersection
from jaxnbv.scanning.sdf.base import Matrix as Matrix
from jaxnbv.scanning.sdf.base import Rotated as Rotated
from jaxnbv.scanning.sdf.base import Scalar as Scalar
from jaxnbv.scanning.sdf.base import Scaled as Scaled
from jaxnbv.scanning.sdf.base import SignedDistance as SignedDistance
from jaxnbv.scanning.sdf.base import SmoothUnion as SmoothUnion
from jaxnbv.scanning.sdf.base import Translated as Translated
from jaxnbv.scanning.sdf.base import Union as Union
from jaxnbv.scanning.sdf.base import Vector as Vector
from jaxnbv.scanning.sdf.base import corner_distance as corner_distance
from jaxnbv.scanning.sdf.base import least_of_last as least_of_last
from jaxnbv.scanning.sdf.base import nonnegative as nonnegative
from jaxnbv.scanning.sdf.base import parameter as parameter
from jaxnbv.scanning.sdf.sampled import Sampled as Sampled
from jaxnbv.scanning.sdf.sampled import solid_of_mesh as solid_of_mesh
from jaxnbv.scanning.sdf.shapes import Capsule as Capsule
from jaxnbv.scanning.sdf.shapes import Cone as Cone
from jaxnbv.scanning.sdf.shapes import Cuboid as Cuboid
from jaxnbv.scanning.sdf.shapes import Cylinder as Cylinder
from jaxnbv.scanning.sdf.shapes import HalfSpace as HalfSpace
from jaxnbv.scanning.sdf.shapes import Sphere as Sphere
from jaxnbv.scanning.sdf.shapes import Torus as Torus
