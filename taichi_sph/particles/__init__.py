"""Particles: the fields of blood and wall, the smoothing kernel, and who is near whom."""
