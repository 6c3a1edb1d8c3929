"""From captures of a holographic display to a calibrated model of it; offline, on a workstation, with torch.

It reads camera captures of phase holograms on a spatial light modulator (SLM), finds out which physical effects make
them differ from the ideal model (camera in the loop), fits and trains, and exports a bundle for the headset.
trainer/README.md is its guide.
"""
