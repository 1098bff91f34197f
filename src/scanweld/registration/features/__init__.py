"""Features: what a surface looks like around a point, and which points of two clouds look alike.

- fpfh: fast point feature histograms of points with normals
- matching: mutual nearest neighbours among features
"""
