"""Training of networks on labelled clouds, and the clouds that the shipped ones are trained on."""

from jaxnbv.studies.training.loop import calibrate as calibrate
from jaxnbv.studies.training.loop import expected_calibration_error as expected_calibration_error
from jaxnbv.studies.training.loop import fit as fit
from jaxnbv.studies.training.loop import log_probabilities as log_probabilities
from jaxnbv.studies.training.loop import train as train
