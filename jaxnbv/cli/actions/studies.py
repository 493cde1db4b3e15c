"""What the commands of `jaxnbv study` work with."""

# ruff: noqa: F401

from jaxnbv.experiments.heat import figures as heat_figures
from jaxnbv.experiments.heat import pictures as heat_pictures
from jaxnbv.experiments.heat import report as heat_report
from jaxnbv.experiments.heat import study as heat_study
from jaxnbv.experiments.meshes import mesh_files
from jaxnbv.experiments.parts import figures as part_figures
from jaxnbv.experiments.parts import pictures as part_pictures
from jaxnbv.experiments.parts import report as part_report
from jaxnbv.experiments.parts import study as part_study
from jaxnbv.experiments.pyramid import figures as pyramid_figures
from jaxnbv.experiments.pyramid import pictures as pyramid_pictures
from jaxnbv.experiments.pyramid import report as pyramid_report
from jaxnbv.experiments.pyramid import study as pyramid_study
from jaxnbv.experiments.reconstruction import figures as reconstruction_figures
from jaxnbv.experiments.reconstruction import pictures as reconstruction_pictures
from jaxnbv.experiments.reconstruction import report as reconstruction_report
from jaxnbv.experiments.reconstruction import study as reconstruction_study
from jaxnbv.experiments.records import RecordFolder
from jaxnbv.networks import part_segmenter, pyramid_classifier
from jaxnbv.presets import imagination
from jaxnbv.storage import describe
