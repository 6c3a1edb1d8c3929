"""Networks that learn what no named effect explains: the published one, baselines, and a compact one.

All map irradiance [B, C, H, W], linear and about 1 in the mean, to irradiance of the same shape, at any size. The C
planes are the bench's colours in its order: three as published, fewer where the bench has fewer.
"""
