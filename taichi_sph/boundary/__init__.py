"""Boundary: what moves the wall, brings blood in or takes it out."""
