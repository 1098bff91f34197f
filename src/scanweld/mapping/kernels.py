"""Compiled kernels of the surfel map.

Work is split by chunks of surfels or by image rows. Threads never write the same element: each splats into a depth
buffer of its own, a surfel is merged only by the pixel it won, and new surfels go to places that a prefix sum gave out.
"""

from __future__ import annotations

import numpy as np

from scanweld.parallel import kernel

CHUNK = 16384
"""Surfels handled together; fixed, so that their order does not depend on the threads."""

EMPTY = np.int64(0x7FFFFFFFFFFFFFFF)
"""A pixel of the depth buffer that nothing landed in."""


@kernel
def cull(start, stop, positions, count, transform, intrinsics, width, height, margin, far, ids, counts):
    """List the surfels of chunks start..stop that are in view, with a margin in pixels.

    ids (chunks * CHUNK,) int32: chunk c writes from c * CHUNK on; counts (chunks,) int64.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    left, top = -margin - cx, -margin - cy
    right, bottom = np.float32(width) + margin - cx, np.float32(height) + margin - cy
    for chunk in range(start, stop):
        first = chunk * CHUNK
        kept = first
        for i in range(first, min(first + CHUNK, count)):
            x, y, z = positions[0, i], positions[1, i], positions[2, i]
            xc = transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] * z + transform[0, 3]
            yc = transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] * z + transform[1, 3]
            zc = transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] * z + transform[2, 3]
            seen = (zc > np.float32(0.01)) & (zc < far)
            seen = (
                seen & (fx * xc > left * zc) & (fx * xc < right * zc) & (fy * yc > top * zc) & (fy * yc < bottom * zc)
            )
            ids[kept] = i
            kept += 1 if seen else 0
        counts[chunk] = kept - first


@kernel
def splat(start, stop, positions, normals, confidences, ids, counts, transform, intrinsics, stable, buffer):
    """Put the listed surfels of chunks start..stop into a depth buffer (H, W) int64, one pixel each, nearest wins.

    A key is the depth in micrometres and the surfel's number, so ties have one winner. A surfel below the `stable`
    confidence counts as further away by two percent, about three standard deviations of the depth noise: a speck does
    not hide the surface it belongs to. Surfels seen from behind or nearly edge-on are left out.
    """
    height, width = buffer.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    half = np.float32(0.5)
    for chunk in range(start, stop):
        for k in range(chunk * CHUNK, chunk * CHUNK + counts[chunk]):
            i = ids[k]
            x, y, z = positions[0, i], positions[1, i], positions[2, i]
            xc = transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] * z + transform[0, 3]
            yc = transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] * z + transform[1, 3]
            zc = transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] * z + transform[2, 3]
            u = fx * xc / zc + cx + half
            v = fy * yc / zc + cy + half
            if (zc <= np.float32(0.01)) | (u < 0) | (v < 0) | (u >= np.float32(width)) | (v >= np.float32(height)):
                continue
            a, b, c = normals[0, i], normals[1, i], normals[2, i]
            nx = transform[0, 0] * a + transform[0, 1] * b + transform[0, 2] * c
            ny = transform[1, 0] * a + transform[1, 1] * b + transform[1, 2] * c
            nz = transform[2, 0] * a + transform[2, 1] * b + transform[2, 2] * c
            facing = -(nx * xc + ny * yc + nz * zc)
            if facing < np.float32(0.1) * np.sqrt(xc * xc + yc * yc + zc * zc):
                continue
            if confidences[i] < stable:
                zc *= np.float32(1.02)
            key = (np.int64(zc * np.float32(1e6)) << np.int64(32)) | np.int64(i)
            row, column = np.int64(v), np.int64(u)
            if key < buffer[row, column]:
                buffer[row, column] = key


@kernel
def resolve(start, stop, buffers, index_map, row_counts):
    """Rows start..stop of the index map: the nearest surfel over all threads' buffers (T, H, W), -1 where none."""
    for v in range(start, stop):
        seen = 0
        for u in range(buffers.shape[2]):
            key = buffers[0, v, u]
            for t in range(1, buffers.shape[0]):
                key = min(key, buffers[t, v, u])
            index_map[v, u] = np.int32(key & np.int64(0xFFFFFFFF)) if key != EMPTY else np.int32(-1)
            seen += 1 if key != EMPTY else 0
        row_counts[v] = seen


@kernel
def gather_view(
    start,
    stop,
    index_map,
    offsets,
    positions,
    normals,
    confidences,
    out_positions,
    out_normals,
    out_confidences,
):
    """Copy the surfels of index-map rows start..stop, row-major, to the columns that `offsets` (H,) gives out."""
    for v in range(start, stop):
        k = offsets[v]
        for u in range(index_map.shape[1]):
            i = index_map[v, u]
            if i >= 0:
                for axis in range(3):
                    out_positions[axis, k] = positions[axis, i]
                    out_normals[axis, k] = normals[axis, i]
                out_confidences[k] = confidences[i]
                k += 1


@kernel
def gather_intensities(start, stop, index_map, offsets, colors, out):
    """Luminance (ITU-R BT.601) of the surfels of index-map rows start..stop, as `gather_view` orders them."""
    for v in range(start, stop):
        k = offsets[v]
        for u in range(index_map.shape[1]):
            i = index_map[v, u]
            if i >= 0:
                red, green, blue = colors[0, i], colors[1, i], colors[2, i]
                out[k] = np.float32(0.299) * red + np.float32(0.587) * green + np.float32(0.114) * blue
                k += 1


APPEND, MERGE, SEEN_THROUGH = np.uint8(1), np.uint8(2), np.uint8(4)
"""What a pixel asks of the map, as bits."""


@kernel
def agrees(i, qx, qy, qz, nx, ny, nz, gate, reach, min_cosine, positions, normals):
    """Whether surfel i is within `gate` of q along the normal n, within `reach` of it in all, and faces as n does."""
    dx, dy, dz = positions[0, i] - qx, positions[1, i] - qy, positions[2, i] - qz
    along = abs(nx * dx + ny * dy + nz * dz)
    cosine = nx * normals[0, i] + ny * normals[1, i] + nz * normals[2, i]
    return (along < gate) & (cosine > min_cosine) & (dx * dx + dy * dy + dz * dz < reach * reach)


@kernel
def associate_rows(
    start, stop, index_map, surface, transform, intrinsics, parameters, positions, normals, row_counts, action
):  # fmt: skip
    """Decide for the pixels of rows start..stop what they do to the map; the map is only read.

    surface (H, W, 8), see `SurfaceLevel.surface`; transform (3, 4) camera -> world; parameters (5,): gate in standard
    deviations, gate floor [m], least cosine of agreeing normals, free-space margin [m], spread [pixels]; row_counts
    (H,): new surfels; action (H, W) uint8: MERGE with the pixel's own surfel, APPEND a new one, the own surfel is
    SEEN_THROUGH.
    """
    height, width = index_map.shape
    sigmas, floor, min_cosine, margin = parameters[0], parameters[1], parameters[2], parameters[3]
    spread = parameters[4]
    for v in range(start, stop):
        new = 0
        for u in range(width):
            action[v, u] = np.uint8(0)
            s = surface[v, u]
            if s[6] <= 0:
                continue
            x, y, z = s[0], s[1], s[2]
            qx = transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] * z + transform[0, 3]
            qy = transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] * z + transform[1, 3]
            qz = transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] * z + transform[2, 3]
            a, b, c = s[3], s[4], s[5]
            nx = transform[0, 0] * a + transform[0, 1] * b + transform[0, 2] * c
            ny = transform[1, 0] * a + transform[1, 1] * b + transform[1, 2] * c
            nz = transform[2, 0] * a + transform[2, 1] * b + transform[2, 2] * c
            gate = max(sigmas / s[6], floor)
            reach = np.float32(4) * s[7] + gate
            i = index_map[v, u]
            if i >= 0 and agrees(i, qx, qy, qz, nx, ny, nz, gate, reach, min_cosine, positions, normals):
                action[v, u] = MERGE
                continue
            # A surfel that landed in a neighbouring pixel may still be near enough to this one's centre.
            covered = False
            for dv in range(max(-1, -v), min(1, height - 1 - v) + 1):
                for du in range(max(-1, -u), min(1, width - 1 - u) + 1):
                    j = index_map[v + dv, u + du]
                    if covered or j < 0 or j == i:
                        continue
                    dx, dy, dz = (
                        positions[0, j] - transform[0, 3], positions[1, j] - transform[1, 3],
                        positions[2, j] - transform[2, 3],
                    )  # fmt: skip
                    xc = transform[0, 0] * dx + transform[1, 0] * dy + transform[2, 0] * dz
                    yc = transform[0, 1] * dx + transform[1, 1] * dy + transform[2, 1] * dz
                    zc = transform[0, 2] * dx + transform[1, 2] * dy + transform[2, 2] * dz
                    right = intrinsics[0] * xc / zc + intrinsics[2] - np.float32(u)
                    down = intrinsics[1] * yc / zc + intrinsics[3] - np.float32(v)
                    near = right * right + down * down < spread * spread
                    covered = near and agrees(j, qx, qy, qz, nx, ny, nz, gate, reach, min_cosine, positions, normals)
            if not covered:
                action[v, u] = APPEND
                new += 1
            # Free space: the pixel and its neighbours look through a surfel that stands in front of them.
            if (i >= 0) & (v > 0) & (v < height - 1) & (u > 0) & (u < width - 1):
                nearest = z
                for dv in range(-1, 2):
                    for du in range(-1, 2):
                        nearest = min(nearest, surface[v + dv, u + du, 2])
                # Depth of the surfel along this camera's axis: third row of the inverse rotation.
                depth = (
                    transform[0, 2] * (positions[0, i] - transform[0, 3])
                    + transform[1, 2] * (positions[1, i] - transform[1, 3])
                    + transform[2, 2] * (positions[2, i] - transform[2, 3])
                )
                if depth < nearest - max(margin, np.float32(2) * gate):
                    action[v, u] |= SEEN_THROUGH
        row_counts[v] = new


@kernel
def merge_rows(
    start, stop, action, index_map, surface, color, alpha, transform, most, frame_id,
    positions, normals, colors, radii, confidences, last_seen,
):  # fmt: skip
    """Merge the pixels of rows start..stop with their own surfels: p <- (w p + alpha q) / (w + alpha).

    The same for normal and colour (Keller et al. 2013, eq. 5-8). color (H, W, 3) uint8; alpha (H, W) float32 weight of
    the measurement; most: largest confidence. A surfel lies in one pixel, so it has one writer.
    """
    one = np.float32(1)
    for v in range(start, stop):
        for u in range(index_map.shape[1]):
            i, more = index_map[v, u], alpha[v, u]
            if action[v, u] & SEEN_THROUGH:
                # Never below zero: a surfel that is confirmed after all takes the new measurement's place.
                confidences[i] = max(confidences[i] - more, np.float32(0))
            if (action[v, u] & MERGE) == 0:
                continue
            s = surface[v, u]
            weight = confidences[i]
            keep = weight / (weight + more)
            add = one - keep
            m0, m1, m2 = np.float32(0), np.float32(0), np.float32(0)
            for axis in range(3):
                r0, r1, r2, t = transform[axis, 0], transform[axis, 1], transform[axis, 2], transform[axis, 3]
                positions[axis, i] = keep * positions[axis, i] + add * (r0 * s[0] + r1 * s[1] + r2 * s[2] + t)
                colors[axis, i] = keep * colors[axis, i] + add * np.float32(color[v, u, axis])
                m = keep * normals[axis, i] + add * (r0 * s[3] + r1 * s[4] + r2 * s[5])
                normals[axis, i] = m
                m0, m1, m2 = m1, m2, m
            length = one / np.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
            for axis in range(3):
                normals[axis, i] *= length
            # The finest view of a surface sets how large its surfels are; neighbours may be two of its pixels apart.
            radii[i] = min(radii[i], np.float32(2) * s[7])
            confidences[i] = min(weight + more, most)
            last_seen[i] = frame_id


@kernel
def append_rows(
    start, stop, action, offsets, surface, color, alpha, transform, frame_id,
    positions, normals, colors, radii, confidences, created, last_seen,
):  # fmt: skip
    """Write the new surfels of rows start..stop at the places `offsets` (H,) gives out."""
    for v in range(start, stop):
        k = offsets[v]
        for u in range(action.shape[1]):
            if (action[v, u] & APPEND) == 0:
                continue
            s = surface[v, u]
            for axis in range(3):
                positions[axis, k] = (
                    transform[axis, 0] * s[0]
                    + transform[axis, 1] * s[1]
                    + transform[axis, 2] * s[2]
                    + transform[axis, 3]
                )
                normals[axis, k] = transform[axis, 0] * s[3] + transform[axis, 1] * s[4] + transform[axis, 2] * s[5]
                colors[axis, k] = np.float32(color[v, u, axis])
            radii[k] = s[7]
            confidences[k] = alpha[v, u]
            created[k] = frame_id
            last_seen[k] = frame_id
            k += 1


@kernel
def splat_discs(
    start,
    stop,
    positions,
    normals,
    colors,
    radii,
    order,
    transform,
    intrinsics,
    rows_per_part,
    depth,
    rgb,
    shade,
):
    """Draw surfels as discs into image parts start..stop of `rows_per_part` rows each; for pictures.

    order (N,) int32: surfels to draw. depth (H, W) float32 starts at inf; rgb, shade (H, W, 3) float32: colour and
    world normal of the nearest disc at each pixel. A part is drawn by one thread, in the given order.
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for part in range(start, stop):
        first_row, last_row = part * rows_per_part, min((part + 1) * rows_per_part, height) - 1
        for k in range(len(order)):
            i = order[k]
            x, y, z = positions[0, i], positions[1, i], positions[2, i]
            zc = transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] * z + transform[2, 3]
            if zc < np.float32(0.05):
                continue
            yc = transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] * z + transform[1, 3]
            size = fy * radii[i] / zc + np.float32(0.75)
            v = fy * yc / zc + cy
            if (v + size < np.float32(first_row)) | (v - size > np.float32(last_row)):
                continue
            xc = transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] * z + transform[0, 3]
            u = fx * xc / zc + cx
            if (u + size < 0) | (u - size > np.float32(width - 1)):
                continue
            a, b, c = normals[0, i], normals[1, i], normals[2, i]
            nx = transform[0, 0] * a + transform[0, 1] * b + transform[0, 2] * c
            ny = transform[1, 0] * a + transform[1, 1] * b + transform[1, 2] * c
            nz = transform[2, 0] * a + transform[2, 1] * b + transform[2, 2] * c
            plane = nx * xc + ny * yc + nz * zc
            if plane >= 0:
                continue  # seen from behind
            reach = radii[i] + np.float32(0.75) * zc / fx
            for row in range(max(first_row, int(np.ceil(v - size))), min(last_row, int(np.floor(v + size))) + 1):
                for column in range(max(0, int(np.ceil(u - size))), min(width - 1, int(np.floor(u + size))) + 1):
                    rx, ry = (np.float32(column) - cx) / fx, (np.float32(row) - cy) / fy
                    facing = nx * rx + ny * ry + nz
                    # Where the pixel's ray meets the disc's plane; a grazing disc is drawn at its own depth.
                    t = plane / facing if facing < np.float32(-0.05) else zc
                    dx, dy, dz = rx * t - xc, ry * t - yc, t - zc
                    if (dx * dx + dy * dy + dz * dz <= reach * reach) & (t < depth[row, column]):
                        depth[row, column] = t
                        for axis in range(3):
                            rgb[row, column, axis] = colors[axis, i]
                        shade[row, column, 0], shade[row, column, 1], shade[row, column, 2] = a, b, c
