"""The learned acceleration (to come): it may import taichi_sph, never app."""
