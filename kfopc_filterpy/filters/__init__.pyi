from .power_budget import PowerBudgetKalmanFilter as PowerBudgetKalmanFilter
from .random_walk import RandomWalkKFOPC as RandomWalkKFOPC
