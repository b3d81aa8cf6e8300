import typing

from .cellfile import load as load
from .cellfile.fleet_file import load_fleet as load_fleet
from .errors import DwellError as DwellError
from .estimators.placement_search import search as search
from .record import Run as Run
from .record import open_run as open_run
from .sim import Realisation as Realisation
from .sim import draw as draw
from .sim import simulate as simulate
from .sim import simulate_realisation as simulate_realisation
from .sim.fleet import simulate_fleet as simulate_fleet
from .version import __version__ as __version__

# The upper flats may add names (dwell.ros2).
def __getattr__(name: str) -> typing.Any: ...
