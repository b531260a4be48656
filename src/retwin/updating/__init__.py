"""Updating a twin's own parameters: least squares (Eq. 2) and Bayes (Eq. 3), the rivals."""

from retwin.updating.bayes import calibration_ranks, identify_bayes
from retwin.updating.identify import Updated, identify
from retwin.updating.mcmc import MCMC
from retwin.updating.noise import Noise
from retwin.updating.npe import NPE
from retwin.updating.posterior import Posterior, PosteriorTwin
from retwin.updating.profile import Profile, profile
from retwin.updating.search import Evolution, LeastSquares, Optimum

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
    "identify_bayes",
    "profile",
]
