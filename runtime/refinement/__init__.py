"""Online refinement: a picture gets better while it is displayed, with a camera that looks on (seed section 7)."""
