"""Identification of a twin's own parameters by least squares (Eq. 2) and Bayes (Eq. 3).

These are the baselines that a corrected twin is compared with.
"""

from retwin.update.identification.bayes import calibration_ranks
from retwin.update.identification.identify import Updated, identify
from retwin.update.identification.mcmc import MCMC
from retwin.update.identification.npe import NPE
from retwin.update.identification.posterior import Posterior, PosteriorTwin
from retwin.update.identification.problem import Noise
from retwin.update.identification.profile import Profile, profile
from retwin.update.identification.search import Evolution, LeastSquares, Optimum

__all__ = [
    "MCMC",
    "NPE",
    "Evolution",
    "LeastSquares",
    "Noise",
    "Optimum",
    "Posterior",
    "PosteriorTwin",
    "Profile",
    "Updated",
    "calibration_ranks",
    "identify",
    "profile",
]
