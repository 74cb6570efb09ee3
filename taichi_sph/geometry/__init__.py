"""Geometry: the lumen as a mesh, its openings, its wall's samples and the blood at the start."""
