"""Planes through the neighbours of points: the compiled part of :mod:`scanweld.geometry.normals`."""
