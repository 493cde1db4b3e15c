from . import studies as studies
from .checkpoints import convert as convert
from .device import prepare as prepare
from .episodes import demo as demo
from .episodes import run as run
