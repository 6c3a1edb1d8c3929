"""The headset's solver: phase retrieval of the pattern whose light is nearest to a picture, by a deadline."""

from runtime.solver.drive_range import DriveRange
from runtime.solver.penalty import PENALTIES
from runtime.solver.quality import Quality, quality, quality_of, shown
from runtime.solver.retrieval_methods import METHODS
from runtime.solver.solution import Solution
from runtime.solver.solver import Solver, solve
from runtime.solver.video_motion import motion_between
from runtime.solver.zero_order import beside_zero_order

__all__ = [
    "DriveRange",
    "METHODS",
    "PENALTIES",
    "Quality",
    "Solution",
    "Solver",
    "beside_zero_order",
    "motion_between",
    "quality",
    "quality_of",
    "shown",
    "solve",
]
