"""Compiled kernels of the surfel map.

The map is pages of surfels in one flat array (:mod:`~.storage.kernels`): `pool` as float32, `whole` the same bytes as
int32.

Work is split by pages or by image rows. Threads never write the same element: each splats into a depth buffer of its
own, and a surfel that won a pixel is the only one there. What
needs surfels goes through the map page by page, because neighbours in a page are neighbours in the image, while the
surfels of neighbouring pixels lie anywhere; so do the rows of what is seen, which a map (H, W) leads to from a pixel.
"""

from __future__ import annotations

import numpy as np

from scanweld.mapping.storage.kernels import (
    BLUE,
    CONFIDENCE,
    GREEN,
    LAST_SEEN,
    NX,
    NY,
    NZ,
    PAGE,
    RADIUS,
    RED,
    SPAN,
    STRIDE,
    Y,
    Z,
)
from scanweld.parallel import kernel

EMPTY = np.int64(0x7FFFFFFFFFFFFFFF)
"""A pixel of the depth buffer that nothing landed in."""


@kernel
def splat_pages(start, stop, slots, counts, pool, transform, intrinsics, stable, width, height, landed, buffer):
    """Put the surfels of pages slots[start:stop] into a depth buffer (H * W,) int64, one pixel each, nearest wins.

    A key is the depth in micrometres and the surfel's number, so ties have one winner. A surfel below the `stable`
    confidence counts as further away by two percent, about three standard deviations of the depth noise: a speck does
    not hide the surface it belongs to. Surfels seen from behind or nearly edge-on are left out. landed (P * PAGE,)
    int32: the pixel of each surfel, -1 for none. Two loops: the first is vectorised, the second cannot be.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    half, nearest = np.float32(0.5), np.float32(0.01)
    r00, r01, r02, t0 = transform[0, 0], transform[0, 1], transform[0, 2], transform[0, 3]
    r10, r11, r12, t1 = transform[1, 0], transform[1, 1], transform[1, 2], transform[1, 3]
    r20, r21, r22, t2 = transform[2, 0], transform[2, 1], transform[2, 2], transform[2, 3]
    right, bottom = np.float32(width), np.float32(height)
    # The camera's centre in the world: minus R^T t.
    ox, oy, oz = -(r00 * t0 + r10 * t1 + r20 * t2), -(r01 * t0 + r11 * t1 + r21 * t2), -(r02 * t0 + r12 * t1 + r22 * t2)
    micrometres = np.empty(PAGE, np.int32)
    for s in range(start, stop):
        slot, count = slots[s], counts[slots[s]]
        base, first = np.uint64(slot) * np.uint64(SPAN), np.uint64(s) * np.uint64(PAGE)
        for k in range(np.uint64(count)):
            i = base + k
            x, y, z = pool[i], pool[i + Y], pool[i + Z]
            a, b, c, confidence = pool[i + NX], pool[i + NY], pool[i + NZ], pool[i + CONFIDENCE]
            xc = r00 * x + r01 * y + r02 * z + t0
            yc = r10 * x + r11 * y + r12 * z + t1
            zc = r20 * x + r21 * y + r22 * z + t2
            dx, dy, dz = x - ox, y - oy, z - oz
            facing = -(a * dx + b * dy + c * dz)
            depth = max(zc, nearest)
            u, v = fx * xc / depth + cx + half, fy * yc / depth + cy + half
            seen = (zc > nearest) & (u >= 0) & (v >= 0) & (u < right) & (v < bottom) & (facing > 0)
            seen = seen & (facing * facing >= np.float32(0.01) * (dx * dx + dy * dy + dz * dz))
            column, row = np.int32(min(max(u, np.float32(0)), right)), np.int32(min(max(v, np.float32(0)), bottom))
            landed[first + k] = row * np.int32(width) + column if seen else np.int32(-1)
            depth = depth * np.float32(1.02) if confidence < stable else depth
            micrometres[k] = np.int32(min(depth, np.float32(2100)) * np.float32(1e6))
        for k in range(np.uint64(count)):
            pixel = landed[first + k]
            if pixel >= 0:
                key = (np.int64(micrometres[k]) << np.int64(32)) | (np.int64(slot) * np.int64(PAGE) + np.int64(k))
                buffer[np.uint64(pixel)] = min(key, buffer[np.uint64(pixel)])


@kernel
def resolve(start, stop, buffers, numbers):
    """Rows start..stop of the index map: the nearest surfel over all threads' buffers (T, H, W), -1 where none.

    The buffers are empty afterwards.
    """
    for v in range(start, stop):
        for u in range(buffers.shape[2]):
            key = buffers[0, v, u]
            buffers[0, v, u] = EMPTY
            for t in range(1, buffers.shape[0]):
                key = min(key, buffers[t, v, u])
                buffers[t, v, u] = EMPTY
            numbers[v, u] = np.int32(key & np.int64(0xFFFFFFFF)) if key != EMPTY else np.int32(-1)


@kernel
def list_winners(start, stop, slots, counts, numbers, landed, places, won):
    """List the surfels of pages slots[start:stop] that won a pixel: won (P,) int32 of each page.

    numbers (H * W,) int32: see `resolve`; landed (P * PAGE,): see `splat_pages`. Those of page s are from s * PAGE on
    in places (P * PAGE,) uint8, the surfel's place in its page, and their pixels in `landed` from then on.
    """
    for s in range(start, stop):
        first, count, number = np.uint64(s) * np.uint64(PAGE), np.uint64(counts[slots[s]]), np.int32(slots[s] * PAGE)
        n = first
        for k in range(count):  # no branch: which surfels win is hard to predict
            pixel = landed[first + k]
            places[n], landed[n] = np.uint8(k), pixel
            n += np.uint64((pixel >= 0) & (numbers[np.uint64(max(pixel, np.int32(0)))] == number + np.int32(k)))
        won[s] = n - first


@kernel
def show_page(won, first, base, row, places, landed, pool, rows, values):
    """Write the `won` surfels of a page that are seen to values (8, N) float32, from `row` on.

    They have position, normal, confidence and luminance (ITU-R BT.601). rows (H * W,) int32: which row is at a pixel.
    """
    for n in range(won):
        rows[np.uint64(landed[first + n])] = np.int32(row + n)
    for n in range(won):
        i, j = base + np.uint64(places[first + n]), row + n
        values[0, j], values[1, j], values[2, j] = pool[i], pool[i + Y], pool[i + Z]
        values[3, j], values[4, j], values[5, j] = pool[i + NX], pool[i + NY], pool[i + NZ]
        values[6, j] = pool[i + CONFIDENCE]
        red, green, blue = pool[i + RED], pool[i + GREEN], pool[i + BLUE]
        values[7, j] = np.float32(0.299) * red + np.float32(0.587) * green + np.float32(0.114) * blue


@kernel
def show_pages(start, stop, slots, places, landed, won, offsets, pool, rows, values):
    """Write the surfels of pages slots[start:stop] that are seen: see `show_page`; offsets (P + 1,): their rows."""
    for s in range(start, stop):
        first, base = np.uint64(s) * np.uint64(PAGE), np.uint64(slots[s]) * np.uint64(SPAN)
        show_page(np.uint64(won[s]), first, base, np.uint64(offsets[s]), places, landed, pool, rows, values)


@kernel
def copy_eight(source, i, target, j):
    """Copy eight numbers from source[i] on to target[j]: all are read before any is written, so it is two moves."""
    a, b, c, d = source[i], source[i + np.uint64(1)], source[i + np.uint64(2)], source[i + np.uint64(3)]
    e, f = source[i + np.uint64(4)], source[i + np.uint64(5)]
    g, h = source[i + np.uint64(6)], source[i + np.uint64(7)]
    target[j], target[j + np.uint64(1)], target[j + np.uint64(2)], target[j + np.uint64(3)] = a, b, c, d
    target[j + np.uint64(4)], target[j + np.uint64(5)] = e, f
    target[j + np.uint64(6)], target[j + np.uint64(7)] = g, h


@kernel
def agrees(dx, dy, dz, a, b, c, nx, ny, nz, gate, reach, min_cosine):
    """Whether a surfel at d from a measurement is within `gate` of it along the normal n, within `reach` in all, and
    its normal (a, b, c) faces as n does."""
    along = abs(nx * dx + ny * dy + nz * dz)
    cosine = nx * a + ny * b + nz * c
    return (along < gate) & (cosine > min_cosine) & (dx * dx + dy * dy + dz * dz < reach * reach)


@kernel
def is_seen_through(u, v, x, y, z, gate, margin, surface, width, height, transform):
    """Whether a pixel and its neighbours look through a surfel (x, y, z), which stands in front of them all."""
    if (v <= 0) | (v >= height - 1) | (u <= 0) | (u >= width - 1):
        return False
    nearest = np.float32(1e30)
    for dv in range(-1, 2):
        for du in range(-1, 2):
            nearest = min(nearest, surface[np.uint64(((v + dv) * width + u + du) * 8 + 2)])
    # Depth of the surfel along the camera's axis: third row of the inverse rotation.
    depth = (
        transform[0, 2] * (x - transform[0, 3])
        + transform[1, 2] * (y - transform[1, 3])
        + transform[2, 2] * (z - transform[2, 3])
    )
    return depth < nearest - max(margin, np.float32(2) * gate)


SIGMA, ALPHA, COLOR = np.uint64(6 * STRIDE), np.uint64(8 * STRIDE), np.uint64(9 * STRIDE)
"""Where rows of `read_pixels` begin: one over the noise, zero without a surface; the weight; three of the colour. The
others of the surface are in their order (see `SurfaceLevel`)."""


@kernel
def read_pixels(count, won, first, places, landed, surface, color, alpha, seen):
    """Read what the `won` pixels of a page measure into rows seen (12 * STRIDE,), at their surfels' places.

    The processor waits for memory, for as many pixels at once as it can see ahead: first come loops so short that it
    sees many.
    """
    for place in range(count):
        seen[SIGMA + place] = np.float32(0)
    for n in range(won):
        k, j = np.uint64(places[first + n]), np.uint64(landed[first + n]) * np.uint64(8)
        seen[SIGMA + k] = surface[j + np.uint64(6)]
    for n in range(won):
        seen[ALPHA + np.uint64(places[first + n])] = alpha[np.uint64(landed[first + n])]
    for n in range(won):
        k, j = COLOR + np.uint64(places[first + n]), np.uint64(landed[first + n]) * np.uint64(3)
        seen[k], seen[k + np.uint64(STRIDE)] = np.float32(color[j]), np.float32(color[j + np.uint64(1)])
        seen[k + np.uint64(2 * STRIDE)] = np.float32(color[j + np.uint64(2)])
    for n in range(won):
        k, j = np.uint64(places[first + n]), np.uint64(landed[first + n]) * np.uint64(8)
        a, b, c, d = surface[j], surface[j + np.uint64(1)], surface[j + np.uint64(2)], surface[j + np.uint64(3)]
        e, f, g = surface[j + np.uint64(4)], surface[j + np.uint64(5)], surface[j + np.uint64(7)]
        seen[k], seen[k + np.uint64(STRIDE)], seen[k + np.uint64(2 * STRIDE)] = a, b, c
        seen[k + np.uint64(3 * STRIDE)], seen[k + np.uint64(4 * STRIDE)] = d, e
        seen[k + np.uint64(5 * STRIDE)], seen[k + np.uint64(7 * STRIDE)] = f, g


@kernel
def merge_page(count, base, seen, transform, parameters, frame_id, pool, whole, verdicts):
    """Merge surfels base.. of the pool with what their pixels measure; a vectorised loop, all masks.

    seen: see `read_pixels`. verdicts (PAGE,) int32: 1 where they agree, 2 where they do not, 0 where there is nothing
    to agree with.
    """
    one, zero = np.float32(1), np.float32(0)
    sigmas, floor, min_cosine, most = parameters[0], parameters[1], parameters[2], parameters[5]
    r00, r01, r02, t0 = transform[0, 0], transform[0, 1], transform[0, 2], transform[0, 3]
    r10, r11, r12, t1 = transform[1, 0], transform[1, 1], transform[1, 2], transform[1, 3]
    r20, r21, r22, t2 = transform[2, 0], transform[2, 1], transform[2, 2], transform[2, 3]
    for k in range(count):
        x, y, z = seen[k], seen[k + np.uint64(STRIDE)], seen[k + np.uint64(2 * STRIDE)]
        a, b, c = seen[k + np.uint64(3 * STRIDE)], seen[k + np.uint64(4 * STRIDE)], seen[k + np.uint64(5 * STRIDE)]
        weight, radius = seen[SIGMA + k], seen[k + np.uint64(7 * STRIDE)]
        red, green = seen[COLOR + k], seen[COLOR + k + np.uint64(STRIDE)]
        blue = seen[COLOR + k + np.uint64(2 * STRIDE)]
        more, here = seen[ALPHA + k], weight > zero
        qx = r00 * x + r01 * y + r02 * z + t0
        qy = r10 * x + r11 * y + r12 * z + t1
        qz = r20 * x + r21 * y + r22 * z + t2
        nx, ny, nz = r00 * a + r01 * b + r02 * c, r10 * a + r11 * b + r12 * c, r20 * a + r21 * b + r22 * c
        i = base + k
        px, py, pz, mx, my, mz = pool[i], pool[i + Y], pool[i + Z], pool[i + NX], pool[i + NY], pool[i + NZ]
        confidence, width = pool[i + CONFIDENCE], pool[i + RADIUS]
        gate = max(sigmas / max(weight, np.float32(1e-6)), floor)
        alike = here & agrees(
            px - qx, py - qy, pz - qz, mx, my, mz, nx, ny, nz, gate, np.float32(4) * radius + gate, min_cosine
        )
        verdicts[k] = np.int32(1) if alike else np.int32(2) if here else np.int32(0)
        moved = alike & (more > zero)
        add = more / max(confidence + more, np.float32(1e-12)) if moved else zero
        keep = one - add
        nx, ny, nz = keep * mx + add * nx, keep * my + add * ny, keep * mz + add * nz
        length = one / np.sqrt(nx * nx + ny * ny + nz * nz)
        pool[i] = keep * px + add * qx if moved else px
        pool[i + Y] = keep * py + add * qy if moved else py
        pool[i + Z] = keep * pz + add * qz if moved else pz
        pool[i + NX] = nx * length if moved else mx
        pool[i + NY] = ny * length if moved else my
        pool[i + NZ] = nz * length if moved else mz
        pool[i + CONFIDENCE] = min(confidence + more, most) if moved else confidence
        # The finest view of a surface sets how large its surfels are; neighbours may be two of its pixels apart.
        pool[i + RADIUS] = min(width, np.float32(2) * radius) if moved else width
        pool[i + RED] = keep * pool[i + RED] + add * red if moved else pool[i + RED]
        pool[i + GREEN] = keep * pool[i + GREEN] + add * green if moved else pool[i + GREEN]
        pool[i + BLUE] = keep * pool[i + BLUE] + add * blue if moved else pool[i + BLUE]
        whole[i + LAST_SEEN] = frame_id if moved else whole[i + LAST_SEEN]


@kernel
def merge_pages(
    start, stop, slots, counts, places, landed, won, offsets, surface, color, alpha, transform, parameters, width,
    height, frame_id, pool, whole, dirty, merged, rows, values,
):  # fmt: skip
    """Merge the surfels of pages slots[start:stop] with the pixels that they won: p <- (w p + alpha q) / (w + alpha).

    The same for normal and colour (Keller et al. 2013, eq. 5-8). A surfel that is seen through loses the weight of the
    pixel, one that a pixel of negative weight, which moves, lies on all but that of one measurement. What they have
    become is written to `rows` and `values`: see `show_pages`.

    places, landed, won: see `list_winners`; surface (H * W * 8,), see `SurfaceLevel.surface`; color (H * W * 3,) uint8;
    alpha (H * W,) float32 weight of the measurement; transform (3, 4) camera -> world; parameters: see `fusion.fuse`;
    dirty (P,) uint8: pages with a surfel that lost confidence; merged (H * W,) uint8: pixels whose measurement is in
    the map.
    """
    one, zero, margin = np.float32(1), np.float32(0), parameters[3]
    seen, verdicts = np.zeros(12 * STRIDE, np.float32), np.empty(PAGE, np.int32)
    for s in range(start, stop):
        if won[s] == 0:
            continue
        slot, first, count = np.uint64(slots[s]), np.uint64(s) * np.uint64(PAGE), np.uint64(counts[slots[s]])
        base, listed = slot * np.uint64(SPAN), np.uint64(won[s])
        read_pixels(count, listed, first, places, landed, surface, color, alpha, seen)
        merge_page(count, base, seen, transform, parameters, frame_id, pool, whole, verdicts)
        demoted = False
        for k in range(count):
            demoted |= (verdicts[k] == 2) | ((verdicts[k] == 1) & (seen[ALPHA + k] < zero))
        for n in range(listed):
            merged[np.uint64(landed[first + n])] = verdicts[np.uint64(places[first + n])] == 1
        for n in range(listed if demoted else np.uint64(0)):
            place, pixel = np.uint64(places[first + n]), np.uint64(landed[first + n])
            i, weight = base + place, alpha[pixel]
            if (verdicts[place] == 1) & (weight < zero):
                pool[i + CONFIDENCE] = min(pool[i + CONFIDENCE], one)
                dirty[slot] = 1
            if verdicts[place] == 2:
                v, u = np.int64(pixel) // width, np.int64(pixel) % width
                gate = max(parameters[0] / surface[pixel * np.uint64(8) + np.uint64(6)], parameters[1])
                x, y, z = pool[i], pool[i + Y], pool[i + Z]
                if is_seen_through(u, v, x, y, z, gate, margin, surface, width, height, transform):
                    # Never below zero: a surfel that is confirmed after all takes the new measurement's place.
                    pool[i + CONFIDENCE] = max(pool[i + CONFIDENCE] - abs(weight), zero)
                    dirty[slot] = 1
        show_page(listed, first, base, np.uint64(offsets[s]), places, landed, pool, rows, values)


@kernel
def cover_row(count, v, columns, seen, others, asked, transform, intrinsics, parameters, covered):
    """Mark pixels of row v whose measurement a neighbour's surfel covers; a vectorised loop, all masks.

    columns (W,) int32: the pixels; seen (W * 8,): their surfaces; asked (W,) int32: the rows of the neighbours'
    surfels, -1 where there is none; others (6, W): their positions and normals; covered (W,) int32.
    """
    sigmas, floor, min_cosine, spread = parameters[0], parameters[1], parameters[2], parameters[4]
    r00, r01, r02, t0 = transform[0, 0], transform[0, 1], transform[0, 2], transform[0, 3]
    r10, r11, r12, t1 = transform[1, 0], transform[1, 1], transform[1, 2], transform[1, 3]
    r20, r21, r22, t2 = transform[2, 0], transform[2, 1], transform[2, 2], transform[2, 3]
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    below = np.float32(v) - cy
    for n in range(count):
        j = n * np.uint64(8)
        x, y, z = seen[j], seen[j + np.uint64(1)], seen[j + np.uint64(2)]
        a, b, c = seen[j + np.uint64(3)], seen[j + np.uint64(4)], seen[j + np.uint64(5)]
        gate = max(sigmas / seen[j + np.uint64(6)], floor)
        reach = np.float32(4) * seen[j + np.uint64(7)] + gate
        px, py, pz, mx, my, mz = others[0, n], others[1, n], others[2, n], others[3, n], others[4, n], others[5, n]
        dx, dy, dz = px - t0, py - t1, pz - t2
        ex, ey = dx - (r00 * x + r01 * y + r02 * z), dy - (r10 * x + r11 * y + r12 * z)
        ez = dz - (r20 * x + r21 * y + r22 * z)
        nx, ny, nz = r00 * a + r01 * b + r02 * c, r10 * a + r11 * b + r12 * c, r20 * a + r21 * b + r22 * c
        zc = r02 * dx + r12 * dy + r22 * dz
        right = fx * (r00 * dx + r10 * dy + r20 * dz) - (np.float32(columns[n]) - cx) * zc
        down = fy * (r01 * dx + r11 * dy + r21 * dz) - below * zc
        near = right * right + down * down < spread * spread * zc * zc
        near = near & (asked[n] >= 0) & agrees(ex, ey, ez, mx, my, mz, nx, ny, nz, gate, reach, min_cosine)
        covered[n] = np.int32(1) if near else np.int32(0)


@kernel
def cover_rows(start, stop, rows, values, merged, surface, moving, transform, intrinsics, parameters, pending, counts):
    """List the pixels of rows start..stop that need a surfel: what they measure is not in the map.

    Neither the pixel's own surfel took it in nor is a neighbour's surfel near enough; nor does it move. rows (H, W),
    values (8, N): see `show_page`; surface (H * W * 8,); moving (H, W) bool, or of another height where nothing moves;
    pending (H, W) int32 columns, counts (H,) int32 how many of each row; see `merge_pages`.
    """
    height, width = rows.shape
    masked = moving.shape[0] == height
    columns, asked, covered = np.empty(width, np.int32), np.empty(width, np.int32), np.empty(width, np.int32)
    seen, others = np.empty(8 * width, np.float32), np.empty((6, width), np.float32)
    for v in range(start, stop):
        count, first = np.uint64(0), np.uint64(v) * np.uint64(width)
        for u in range(np.uint64(width)):
            columns[count] = np.int32(u)
            wanted = (merged[v, u] == 0) & (surface[(first + u) * np.uint64(8) + np.uint64(6)] > 0)
            count += np.uint64(wanted and not (masked and moving[v, u]))
        for n in range(count):
            copy_eight(surface, (first + np.uint64(columns[n])) * np.uint64(8), seen, n * np.uint64(8))
        # A surfel that landed in a neighbouring pixel may still be near enough to this one's centre: those beside it
        # are asked first, then those at its corners, and what one of them covers is off the list.
        for k in range(8 if values.shape[1] > 0 else 0):  # of the first frame there is no view
            sign = 2 * (k & 1) - 1
            dv, du = ((k >> 1) * sign, (1 - (k >> 1)) * sign) if k < 4 else ((k & 2) - 1, sign)
            if (v + dv < 0) | (v + dv >= height):
                continue
            for n in range(count):
                u = columns[n]
                row = rows[v + dv, np.uint64(min(max(u + du, 0), width - 1))]
                asked[n] = row if row != rows[v, np.uint64(u)] else np.int32(-1)
            for n in range(count):
                row = np.uint64(max(asked[n], np.int32(0)))
                others[0, n], others[1, n], others[2, n] = values[0, row], values[1, row], values[2, row]
                others[3, n], others[4, n], others[5, n] = values[3, row], values[4, row], values[5, row]
            cover_row(count, v, columns, seen, others, asked, transform, intrinsics, parameters, covered)
            left = np.uint64(0)
            for n in range(count):
                columns[left] = columns[n]
                copy_eight(seen, n * np.uint64(8), seen, left * np.uint64(8))
                left += np.uint64(covered[n] == 0)
            count = left
        for n in range(count):
            pending[v, n] = columns[n]
        counts[v] = count


@kernel
def new_surfels(start, stop, pending, counts, offsets, surface, color, alpha, transform, frame_id, anchor, rows, whole):
    """Make surfels of the `pending` pixels of rows start..stop, from columns offsets[v] on of `rows` (ROWS, N).

    rows is float32, whole the same memory as int32.
    """
    for v in range(start, stop):
        for k in range(counts[v]):
            u, i = pending[v, k], offsets[v] + k
            s = surface[v, u]
            for axis in range(3):
                r0, r1, r2, t = transform[axis, 0], transform[axis, 1], transform[axis, 2], transform[axis, 3]
                rows[axis, i] = r0 * s[0] + r1 * s[1] + r2 * s[2] + t
                rows[3 + axis, i] = r0 * s[3] + r1 * s[4] + r2 * s[5]
                rows[8 + axis, i] = np.float32(color[v, u, axis])
            rows[6, i], rows[7, i] = alpha[v, u], s[7]
            whole[11, i], whole[12, i], whole[13, i] = frame_id, frame_id, anchor


@kernel
def splat_discs(start, stop, slots, counts, pool, least, transform, intrinsics, rows_per_part, depth, rgb, shade):
    """Draw surfels as discs into image parts start..stop of `rows_per_part` rows each; for pictures.

    slots (P,) int32: pages to draw, of which surfels of the `least` confidence. depth (H, W) float32 starts at inf;
    rgb, shade (H, W, 3) float32: colour and world normal of the nearest disc at each pixel. A part is drawn by one
    thread, in the given order.
    """
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for part in range(start, stop):
        first_row, last_row = part * rows_per_part, min((part + 1) * rows_per_part, height) - 1
        for k in range(len(slots) * PAGE):
            slot, place = slots[k // PAGE], k % PAGE
            i = np.uint64(slot) * np.uint64(SPAN) + np.uint64(place)
            if (place >= counts[slot]) or (pool[i + CONFIDENCE] < least):
                continue
            x, y, z = pool[i], pool[i + Y], pool[i + Z]
            zc = transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] * z + transform[2, 3]
            if zc < np.float32(0.05):
                continue
            yc = transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] * z + transform[1, 3]
            radius = pool[i + RADIUS]
            size = fy * radius / zc + np.float32(0.75)
            v = fy * yc / zc + cy
            if (v + size < np.float32(first_row)) | (v - size > np.float32(last_row)):
                continue
            xc = transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] * z + transform[0, 3]
            u = fx * xc / zc + cx
            if (u + size < 0) | (u - size > np.float32(width - 1)):
                continue
            a, b = pool[i + NX], pool[i + NY]
            c = pool[i + NZ]
            nx = transform[0, 0] * a + transform[0, 1] * b + transform[0, 2] * c
            ny = transform[1, 0] * a + transform[1, 1] * b + transform[1, 2] * c
            nz = transform[2, 0] * a + transform[2, 1] * b + transform[2, 2] * c
            plane = nx * xc + ny * yc + nz * zc
            if plane >= 0:
                continue  # seen from behind
            reach = radius + np.float32(0.75) * zc / fx
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
                            rgb[row, column, axis] = pool[i + np.uint64(8 + axis) * Y]
                        shade[row, column, 0], shade[row, column, 1], shade[row, column, 2] = a, b, c
