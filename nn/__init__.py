"""The learned acceleration; it may import taichi_sph, never app."""
