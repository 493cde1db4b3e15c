"""How the next pose is found: the discrete search and the paper's baselines."""

from jaxnbv.search.base import Problem as Problem
from jaxnbv.search.base import Proposal as Proposal
from jaxnbv.search.base import Search as Search
from jaxnbv.search.baselines import FarthestView as FarthestView
from jaxnbv.search.baselines import RandomView as RandomView
from jaxnbv.search.baselines import UncertaintyView as UncertaintyView
from jaxnbv.search.discrete import DiscreteSearch as DiscreteSearch
