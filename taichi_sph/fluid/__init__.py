"""Fluid: the equation of motion, its constants, and the models that compute accelerations."""
