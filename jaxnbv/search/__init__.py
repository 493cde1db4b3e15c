"""Searches for the next pose: over candidates, by gradient ascent, by both, and the paper's baselines."""

from jaxnbv.search.base import Baseline as Baseline
from jaxnbv.search.base import CandidateSearch as CandidateSearch
from jaxnbv.search.base import Search as Search
from jaxnbv.search.baselines import FarthestView as FarthestView
from jaxnbv.search.baselines import RandomView as RandomView
from jaxnbv.search.baselines import UncertaintyView as UncertaintyView
from jaxnbv.search.candidates import Candidates as Candidates
from jaxnbv.search.candidates import GivenPoses as GivenPoses
from jaxnbv.search.candidates import Reach as Reach
from jaxnbv.search.candidates import SphereCandidates as SphereCandidates
from jaxnbv.search.discrete import DiscreteSearch as DiscreteSearch
from jaxnbv.search.discrete import TieBreakSearch as TieBreakSearch
from jaxnbv.search.gradient import GradientSearch as GradientSearch
from jaxnbv.search.gradient import HybridSearch as HybridSearch
from jaxnbv.search.halving import HalvingSearch as HalvingSearch
from jaxnbv.search.pose_space import ConstrainedPoses as ConstrainedPoses
from jaxnbv.search.pose_space import FreePoses as FreePoses
from jaxnbv.search.pose_space import PoseSpace as PoseSpace
from jaxnbv.search.pose_space import SpherePoses as SpherePoses
from jaxnbv.search.problem import Problem as Problem
from jaxnbv.search.proposal import Proposal as Proposal
from jaxnbv.search.proposal import Trajectories as Trajectories
