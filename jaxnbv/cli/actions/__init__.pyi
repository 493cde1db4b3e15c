from .device import prepare as prepare
from .episodes import demo as demo
from .episodes import run as run
from .studies import report as report
from .studies import study as study
