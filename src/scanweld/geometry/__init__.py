"""Transforms, cameras, frames, depth images, point clouds, normals."""
