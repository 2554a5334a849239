from .random_walk import RandomWalkKFOPC as RandomWalkKFOPC
