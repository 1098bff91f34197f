"""Points grouped by voxel: the compiled part of :func:`scanweld.geometry.point_cloud.voxel_downsample`."""
