from .base import Controller as Controller
from .penalized import leak_factor as leak_factor
from .penalized import penalty_factor as penalty_factor
from .repaired import RepairedKFOPC as RepairedKFOPC
