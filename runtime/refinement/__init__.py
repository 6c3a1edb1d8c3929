"""Online refinement: a picture gets better while it is displayed, with a camera that captures it.

References
----------
Chakravarthula et al. 2020, section 7.
"""
