"""Online refinement: a picture gets better while it is displayed, with a camera that looks on (seed section 7)."""

from runtime.refinement.eye import Eye
from runtime.refinement.refine import Refinement, Step, refine

__all__ = ["Eye", "Refinement", "Step", "refine"]
