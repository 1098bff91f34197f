"""From posed depth to a mesh: a sparse grid of signed distances, and the surface in it (docs/meshing.md)."""
