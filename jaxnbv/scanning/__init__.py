"""Surfaces that rays can hit, simulated scans of them, free space and obstacles."""

from jaxnbv.scanning import metrics as metrics
from jaxnbv.scanning.free_space import Carving as Carving
from jaxnbv.scanning.free_space import carve as carve
from jaxnbv.scanning.grid import Grid as Grid
from jaxnbv.scanning.grid import GridSurface as GridSurface
from jaxnbv.scanning.grid import mean_depth as mean_depth
from jaxnbv.scanning.grid import scan_samples as scan_samples
from jaxnbv.scanning.looks import Looks as Looks
from jaxnbv.scanning.mesh import TriangleMesh as TriangleMesh
from jaxnbv.scanning.mesh import mesh_from_sdf as mesh_from_sdf
from jaxnbv.scanning.mesh_files import MeshParts as MeshParts
from jaxnbv.scanning.mesh_files import as_surface as as_surface
from jaxnbv.scanning.mesh_files import load_mesh as load_mesh
from jaxnbv.scanning.mesh_files import load_parts as load_parts
from jaxnbv.scanning.obstacles import Obstacles as Obstacles
from jaxnbv.scanning.obstacles import barrier_of as barrier_of
from jaxnbv.scanning.scanner import DepthNoise as DepthNoise
from jaxnbv.scanning.scanner import Hits as Hits
from jaxnbv.scanning.scanner import Noise as Noise
from jaxnbv.scanning.scanner import SensorNoise as SensorNoise
from jaxnbv.scanning.scanner import Surface as Surface
from jaxnbv.scanning.scanner import pixel_area as pixel_area
from jaxnbv.scanning.scanner import scan as scan
from jaxnbv.scanning.screened_poisson import screened_poisson as screened_poisson
from jaxnbv.scanning.sphere_tracing import SDFSurface as SDFSurface
