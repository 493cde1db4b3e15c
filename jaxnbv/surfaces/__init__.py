"""p(f) and p(f | D): distributions over implicit surfaces."""

from jaxnbv.surfaces.base import Fields as Fields
from jaxnbv.surfaces.base import SurfaceModel as SurfaceModel
from jaxnbv.surfaces.base import SurfacePosterior as SurfacePosterior
from jaxnbv.surfaces.spsr import GeometricSPSR as GeometricSPSR
from jaxnbv.surfaces.trigonometric import TrigonometricFields as TrigonometricFields
