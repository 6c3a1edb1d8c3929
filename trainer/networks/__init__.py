"""Networks that learn what no named effect explains: the published one, baselines, and a compact one.

All map irradiance [B, 3, H, W], linear and about 1 in the mean, to irradiance of the same shape, at any size.
Planes are the bench's colours in its order; a bench with fewer than three leaves the others at zero.
"""
