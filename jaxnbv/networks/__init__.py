"""Classifiers: PointNet++ and published checkpoints, a small rotation-invariant network, training and calibration."""

from jaxnbv.networks.checkpoints import convert_checkpoint as convert_checkpoint
from jaxnbv.networks.checkpoints import load_checkpoint as load_checkpoint
from jaxnbv.networks.checkpoints import load_safetensors as load_safetensors
from jaxnbv.networks.checkpoints import load_torch_checkpoint as load_torch_checkpoint
from jaxnbv.networks.checkpoints import save_safetensors as save_safetensors
from jaxnbv.networks.classifier import CloudClassifier as CloudClassifier
from jaxnbv.networks.grouping import ball_query as ball_query
from jaxnbv.networks.invariant import InvariantClassifier as InvariantClassifier
from jaxnbv.networks.pointnet2 import PointNet2Classifier as PointNet2Classifier
from jaxnbv.networks.pretrained import load_invariant as load_invariant
from jaxnbv.networks.pretrained import pyramid_classifier as pyramid_classifier
from jaxnbv.networks.pretrained import save_invariant as save_invariant
from jaxnbv.networks.torch_format import read_torch_tensors as read_torch_tensors
from jaxnbv.networks.training import calibrate as calibrate
from jaxnbv.networks.training import expected_calibration_error as expected_calibration_error
from jaxnbv.networks.training import log_probabilities as log_probabilities
from jaxnbv.networks.training import train as train
