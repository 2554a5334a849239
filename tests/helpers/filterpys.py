"""filterpy's filter as the oracle of ours."""

from math import sqrt

import numpy as np
from filterpy.kalman import KalmanFilter


class Oracle(KalmanFilter):
    """filterpy's filter, with the `mahalanobis` of 2.0.0 (1.4.5's raises on numpy 2)."""

    @property
    def mahalanobis(self) -> float:
        return sqrt(np.dot(np.dot(self.y.T, self.SI), self.y).item())
