"""Ray casting and shading: arrays in, arrays out.

A primitive is a unit shape behind an affine map: rows of `affine` hold the 3x4 matrix from world to local
coordinates. The ray parameter is unchanged by an affine map, so a ray meets the unit shape at the distance at
which it meets the primitive, exactly. Kinds: 0 cube [-1, 1]^3; 1 unit ball; 2 frustum about local y, radius 1
at y = -1 and `taper` at y = 1, with caps; 3 square |x|, |y| <= 1 in z = 0.

Colour depends on the world point and its normal alone (Lambert, lights fixed in the world, no highlights),
apart from the fading of texture that is finer than a pixel.
"""

from __future__ import annotations

import math

import numpy as np

from scanweld.parallel import kernel

FAR = 1e30  # "no hit"; fast-math knows no infinity
NEAR = 1e-6
TINY = 1e-12


@kernel
def _nonzero(x):
    if abs(x) < TINY:
        return -TINY if x < 0.0 else TINY
    return x


@kernel
def intersect(kind, taper, ox, oy, oz, dx, dy, dz):
    """Smallest t > NEAR at which o + t d (local coordinates) meets the unit shape, or FAR."""
    best = FAR
    if kind == 0:
        ix, iy, iz = 1.0 / _nonzero(dx), 1.0 / _nonzero(dy), 1.0 / _nonzero(dz)
        ax, ay, az = abs(ix), abs(iy), abs(iz)
        enter = max(max(-ox * ix - ax, -oy * iy - ay), -oz * iz - az)
        leave = min(min(-ox * ix + ax, -oy * iy + ay), -oz * iz + az)
        if enter <= leave:
            if enter > NEAR:
                best = enter
            elif leave > NEAR:
                best = leave
    elif kind == 3:
        t = -oz / _nonzero(dz)
        if t > NEAR and abs(ox + t * dx) <= 1.0 and abs(oy + t * dy) <= 1.0:
            best = t
    else:
        if kind == 1:
            k, m = 0.0, 1.0
            a = dx * dx + dy * dy + dz * dz
            b = ox * dx + oy * dy + oz * dz
            c = ox * ox + oy * oy + oz * oz - 1.0
        else:  # x^2 + z^2 = (m + k y)^2
            k, m = 0.5 * (taper - 1.0), 0.5 * (taper + 1.0)
            r = m + k * oy
            a = dx * dx + dz * dz - k * k * dy * dy
            b = ox * dx + oz * dz - k * r * dy
            c = ox * ox + oz * oz - r * r
            slope = _nonzero(dy)
            for side in (-1.0, 1.0):
                t = (side - oy) / slope
                x, z = ox + t * dx, oz + t * dz
                if NEAR < t < best and x * x + z * z <= (m + k * side) ** 2:
                    best = t
        discriminant = b * b - a * c
        if discriminant >= 0.0:
            root = math.sqrt(discriminant)
            q = -b - root if b > 0.0 else -b + root  # no cancellation
            for t in (q / _nonzero(a), c / _nonzero(q)):
                if NEAR < t < best and (kind == 1 or abs(oy + t * dy) <= 1.0):
                    best = t
    return best


@kernel
def cast(origin, directions, start, stop, bounds, links, kinds, tapers, affine, distance, hit):
    """Cast the rays origin + t directions[i], i in [start, stop), through the tree.

    `bounds` (M, 6) are the corners of the nodes' boxes; `links` (M, 2) hold (first child, 0) of an inner
    node, whose children are neighbours, and (first primitive, count) of a leaf. Writes `distance` (N,), the t
    of the nearest hit or FAR, and `hit` (N,) int32, its primitive or -1.
    """
    stack = np.empty(64, np.int32)
    entry = np.empty(64, np.float64)
    ox, oy, oz = origin[0], origin[1], origin[2]
    for i in range(start, stop):
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        ix, iy, iz = 1.0 / _nonzero(dx), 1.0 / _nonzero(dy), 1.0 / _nonzero(dz)
        best, best_id = FAR, -1
        stack[0], entry[0] = 0, 0.0
        top = 1
        while top > 0:
            top -= 1
            if entry[top] >= best:
                continue
            node = stack[top]
            first, count = links[node, 0], links[node, 1]
            if count > 0:
                for p in range(first, first + count):
                    a = affine[p]
                    t = intersect(
                        kinds[p], tapers[p],
                        a[0] * ox + a[1] * oy + a[2] * oz + a[3],
                        a[4] * ox + a[5] * oy + a[6] * oz + a[7],
                        a[8] * ox + a[9] * oy + a[10] * oz + a[11],
                        a[0] * dx + a[1] * dy + a[2] * dz,
                        a[4] * dx + a[5] * dy + a[6] * dz,
                        a[8] * dx + a[9] * dy + a[10] * dz,
                    )  # fmt: skip
                    if t < best:
                        best, best_id = t, p
                continue
            nearest, t_nearest = -1, 0.0
            for child in range(first, first + 2):
                b = bounds[child]
                x0, x1 = (b[0] - ox) * ix, (b[3] - ox) * ix
                y0, y1 = (b[1] - oy) * iy, (b[4] - oy) * iy
                z0, z1 = (b[2] - oz) * iz, (b[5] - oz) * iz
                enter = max(max(min(x0, x1), min(y0, y1)), max(min(z0, z1), 0.0))
                leave = min(min(max(x0, x1), max(y0, y1)), max(z0, z1))
                if enter <= leave and enter < best:
                    if nearest < 0:
                        nearest, t_nearest = child, enter
                    elif enter < t_nearest:  # the nearer child goes on top
                        stack[top], entry[top] = nearest, t_nearest
                        top += 1
                        nearest, t_nearest = child, enter
                    else:
                        stack[top], entry[top] = child, enter
                        top += 1
            if nearest >= 0:
                stack[top], entry[top] = nearest, t_nearest
                top += 1
        distance[i] = best
        hit[i] = best_id


@kernel
def _hash(ix, iy, iz):
    """A number in [0, 1] for an integer cell."""
    h = (ix * 374761393 + iy * 668265263 + iz * 1440662683) & 0x7FFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0x7FFFFFFF
    h = ((h ^ (h >> 15)) * 73244475) & 0x7FFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFF) / 65535.0


@kernel
def _noise(x, y, z):
    """Value noise of unit wavelength, in [-1, 1]."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    ix, iy, iz = int(fx), int(fy), int(fz)
    u, v, w = x - fx, y - fy, z - fz
    u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
    total = 0.0
    for k in range(2):
        weight = w if k == 1 else 1.0 - w
        near = _hash(ix, iy, iz + k) * (1 - u) + _hash(ix + 1, iy, iz + k) * u
        far = _hash(ix, iy + 1, iz + k) * (1 - u) + _hash(ix + 1, iy + 1, iz + k) * u
        total += weight * (near * (1 - v) + far * v)
    return 2.0 * total - 1.0


@kernel
def _fade(wavelength, footprint):
    """1 for texture coarser than about four pixels, 0 for texture finer than one and a half."""
    return min(max((wavelength / footprint - 1.5) / 2.5, 0.0), 1.0)


@kernel
def _line(distance, half_width, footprint):
    """Coverage, 0..1, of a pixel at `distance` from a line's centre."""
    near = min(distance + 0.5 * footprint, half_width) - max(distance - 0.5 * footprint, -half_width)
    return min(max(near / footprint, 0.0), 1.0)


@kernel
def _wrap(x, period):
    """Distance of x from the nearest multiple of `period`."""
    r = x / period
    return abs(r - math.floor(r + 0.5)) * period


@kernel
def _albedo(texture, u, v, x, y, z, su, sv, scale, seed, footprint):
    """Blend of the material's two colours, 0..1, and a factor of brightness, at one surface point.

    (x, y, z) [m] is the point in object coordinates, (u, v) [m] in the face's, spanning (-su, su) x (-sv,
    sv).
    """
    mix, gain = 0.0, 1.0
    s = seed * 17.0
    if texture == 1:  # plaster: broad stains, fine grain
        broad = _noise(1.3 * x + s, 1.3 * y, 1.3 * z) + 0.5 * _noise(3.1 * x, 3.1 * y + s, 3.1 * z)
        grain = _noise(45 * x, 45 * y, 45 * z + s) * _fade(0.022, footprint)
        mix = 0.5 + 0.45 * broad
        gain = 1.0 + 0.06 * grain + 0.05 * _noise(11 * x + s, 11 * y, 11 * z) * _fade(0.09, footprint)
    elif texture == 2:  # wood, grain along u
        warp = _noise(0.9 * u / scale + s, 4 * v / scale, 2 * s) + 0.3 * _noise(2 * u, 17 * v / scale, s)
        ring = v / (0.04 * scale) + 1.1 * warp + s
        ring = ring - math.floor(ring)
        streak = _noise(5 * u + s, 130 * v, 3 * s) * _fade(0.01, footprint)
        mix = 0.2 + 0.34 * ring * ring * _fade(0.03 * scale, footprint) + 0.2 * streak + 0.22 * warp
        gain = 1.0 + 0.08 * streak
    elif texture == 3:  # parquet of staggered planks along u
        row = math.floor(v / (0.13 * scale))
        shifted = u + 0.9 * scale * _hash(int(row), 7, int(seed))
        column = math.floor(shifted / (0.9 * scale))
        tone = _hash(int(row), int(column), int(seed) + 3)
        grain = _noise(4 * u + 9 * tone, 90 * v + 5 * tone, s) * _fade(0.012, footprint)
        vein = _noise(2 * u + 31 * tone, 22 * v, s) * _fade(0.045, footprint)
        gap = max(
            _line(_wrap(v, 0.13 * scale), 0.0016, footprint),
            _line(_wrap(shifted, 0.9 * scale), 0.0016, footprint),
        )
        mix = 0.12 + 0.68 * tone + 0.15 * grain + 0.18 * vein
        gain = (1.0 + 0.05 * grain) * (1.0 - 0.6 * gap)
    elif texture == 4:  # fabric: weave, and broad wear
        weave = math.sin(u * 900 / scale) * math.sin(v * 900 / scale) * _fade(0.007 * scale, footprint)
        mix = (
            0.4
            + 0.35 * _noise(6 * x + s, 6 * y, 6 * z)
            + 0.3 * _noise(28 * x, 28 * y + s, 28 * z) * _fade(0.035, footprint)
        )
        gain = 1.0 + 0.12 * weave + 0.1 * _noise(150 * x, 150 * y, 150 * z + s) * _fade(0.0067, footprint)
    elif texture == 5:  # square tiles with grout
        size = 0.3 * scale
        tone = _hash(math.floor(u / size), math.floor(v / size), int(seed))
        checker = (math.floor(u / size) + math.floor(v / size)) & 1
        grout = max(_line(_wrap(u, size), 0.003, footprint), _line(_wrap(v, size), 0.003, footprint))
        mix = 0.75 * checker + 0.2 * tone
        gain = (0.9 + 0.2 * tone + 0.08 * _noise(9 * x, 9 * y + s, 9 * z)) * (1.0 - 0.45 * grout)
    elif texture == 6:  # bricks
        row = math.floor(v / 0.075)
        shifted = u + 0.115 * (int(row) & 1)
        column = math.floor(shifted / 0.23)
        tone = _hash(int(row), int(column), int(seed))
        joint = max(_line(_wrap(v, 0.075), 0.005, footprint), _line(_wrap(shifted, 0.23), 0.005, footprint))
        rough = _noise(60 * x, 60 * y, 60 * z + s) * _fade(0.017, footprint)
        gain = 0.72 + 0.5 * tone + 0.12 * rough + 0.08 * _noise(2 * x + s, 2 * y, 2 * z)
        mix = joint
    elif texture == 7:  # rug: borders and a field of lozenges
        edge = min(su - abs(u), sv - abs(v))
        border = 0.0
        if (0.06 < edge < 0.10) or (0.14 < edge < 0.24 and _wrap(u + v, 0.1) < 0.02):
            border = 1.0
        lozenge = abs(_wrap(u, 0.36) / 0.18 - 0.0) + abs(_wrap(v, 0.36) / 0.18)
        field = 1.0 if lozenge < 0.45 else (0.55 if lozenge < 0.75 else 0.0)
        mix = border if edge < 0.26 else field
        gain = 1.0 + 0.12 * _noise(120 * x, 9.0, 120 * z + s) * _fade(0.008, footprint) + 0.1 * _noise(7 * x, s, 7 * z)
    elif texture == 8:  # picture: hills, a sun, and brush strokes, different for each seed
        a, b = u / su, v / sv
        h1 = 0.25 * math.sin(2.1 * a + s) + 0.12 * math.sin(5.3 * a + 2 * s) + 0.6 * (_hash(int(seed), 1, 2) - 0.5)
        h2 = h1 - 0.35 - 0.2 * math.sin(3.3 * a - s)
        sun = (a - 1.2 * _hash(int(seed), 5, 1) + 0.6) ** 2 * (su / sv) ** 2 + (b - 0.5) ** 2
        stroke = _noise(9 * a + s, 30 * b, s) * 0.12 + 0.1 * _noise(4 * a, 5 * b, s)
        mix = 0.95 if b < h2 else (0.62 if b < h1 else (0.0 if sun < 0.06 else 0.22 + 0.12 * b))
        mix += stroke
        gain = 0.75 + 0.5 * _noise(2.5 * a + s, 2.5 * b, 7.0 * s) * 0.5 + (0.35 if sun < 0.06 and b > h1 else 0.0)
    elif texture == 9:  # leaf: midrib and blotches
        rib = _line(abs(x), 0.004, footprint)
        mix = 0.5 * rib + 0.5 + 0.5 * _noise(20 * x + s, 20 * y, 20 * z)
    elif texture == 10:  # stripes of wallpaper with a faint motif
        stripe = _wrap(u, 0.16 * scale)
        mix = 1.0 if stripe < 0.035 * scale else 0.0
        motif = _wrap(u + 0.08 * scale, 0.16 * scale) ** 2 + _wrap(v, 0.2 * scale) ** 2
        if motif < (0.028 * scale) ** 2:
            mix = 0.65
        gain = (
            1.0
            + 0.06 * _noise(2 * x + s, 2 * y, 2 * z)
            + 0.05 * _noise(50 * x, 50 * y, 50 * z) * _fade(0.02, footprint)
        )
    elif texture == 11:  # book: bands and a block of title
        b = v / sv
        band = abs(abs(b) - 0.72) < 0.05
        title = abs(b - 0.2) < 0.22 and _noise(150 * u, 330 * v, s) > 0.25
        mix = 0.9 if band or (title and abs(u) < 0.5 * su) else 0.0
        gain = 0.95 + 0.1 * _noise(25 * x + s, 25 * y, 25 * z)
    elif texture == 12:  # poster or screen: blocks and lines of text
        cell = _hash(math.floor(4 * (u / su + 1)), math.floor(5 * (v / sv + 1)), int(seed))
        text = _wrap(v, 0.03) < 0.007 and _noise(55 * u + s, math.floor(v / 0.03 + 0.5), s) > -0.2
        mix = cell if cell > 0.45 else (0.9 if text and abs(u) < 0.85 * su else 0.05)
        gain = 0.9 + 0.1 * _noise(8 * u, 8 * v, s)
    elif texture == 13:  # sky above trees, seen through a window
        a = _noise(5 * u + s, 5 * v, s) + 0.5 * _noise(14 * u, 14 * v + s, s)
        horizon = -0.25 * sv + 0.1 * a
        mix = 1.0 if v < horizon else 0.0
        gain = (0.55 + 0.3 * a) if v < horizon else (0.85 + 0.12 * max(a, 0.0) + 0.15 * v / sv)
    else:  # paint: nearly even
        mix = (
            0.5
            + 0.4 * _noise(4 * x + s, 4 * y, 4 * z)
            + 0.2 * _noise(17 * x, 17 * y + s, 17 * z) * _fade(0.06, footprint)
        )
    return min(max(mix, 0.0), 1.0), gain


@kernel
def _visibility(shadow, light, vx, vy, vz, reach, bias):
    """Share of a light that reaches the point at offset (vx, vy, vz), `reach` long, by its shadow map.

    The map is octahedral, its centre looks down (world y). The quadratic B-spline weights nine comparisons.
    """
    size = shadow.shape[1]
    inverse = 1.0 / (abs(vx) + abs(vy) + abs(vz))
    a, b = vx * inverse, vz * inverse
    if vy < 0.0:
        a, b = (1 - abs(b)) * (1.0 if a >= 0 else -1.0), (1 - abs(a)) * (1.0 if b >= 0 else -1.0)
    a, b = (a + 1) * 0.5 * size - 0.5, (b + 1) * 0.5 * size - 0.5
    column = min(max(int(a + 0.5), 1), size - 2)
    row = min(max(int(b + 0.5), 1), size - 2)
    a, b = a - column, b - row
    left, mid, right = 0.5 * (0.5 - a) ** 2, 0.75 - a * a, 0.5 * (0.5 + a) ** 2
    scale = 1.0 / bias
    offset = 1.0 - reach * scale
    total = 0.0
    for j in range(-1, 2):
        weight = 0.75 - b * b if j == 0 else 0.5 * (0.5 + j * b) ** 2
        line = left * min(max(shadow[light, row + j, column - 1] * scale + offset, 0.0), 1.0)
        line += mid * min(max(shadow[light, row + j, column] * scale + offset, 0.0), 1.0)
        line += right * min(max(shadow[light, row + j, column + 1] * scale + offset, 0.0), 1.0)
        total += weight * line
    return min(max(total, 0.0), 1.0)


@kernel
def shade(origin, directions, start, stop, pixel_angle, distance, hit, integers, scalars, affine, colors, lights, shadow, ambient, color):  # fmt: skip # noqa: E501
    """Fill `color` (N, 3) float32, linear light, for the hits of :func:`cast`.

    `integers` (P, 3): kind, texture, seed. `scalars` (P, 6): half sizes [m], texture scale, taper, glow.
    `colors` (P, 6): two linear colours. `lights` (L, 7): position [m], linear colour, radius of influence
    [m]; `shadow` (L, S, S) float32: distance to the first surface [m]. `ambient` (3,) linear. `pixel_angle`
    is that of a pixel [rad].
    """
    texel = 3.5 / shadow.shape[1]
    for i in range(start, stop):
        p = hit[i]
        if p < 0:
            color[i, 0], color[i, 1], color[i, 2] = 0.0, 0.0, 0.0
            continue
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        t = distance[i]
        x, y, z = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
        a = affine[p]
        lx = a[0] * x + a[1] * y + a[2] * z + a[3]
        ly = a[4] * x + a[5] * y + a[6] * z + a[7]
        lz = a[8] * x + a[9] * y + a[10] * z + a[11]
        kind = integers[p, 0]
        sx, sy, sz, taper = scalars[p, 0], scalars[p, 1], scalars[p, 2], scalars[p, 4]
        mx, my, mz = lx * sx, ly * sy, lz * sz
        nx, ny, nz = 0.0, 0.0, 1.0
        u, v, su, sv = mx, my, sx, sy
        if kind == 0:
            if abs(lx) >= abs(ly) and abs(lx) >= abs(lz):
                nx, nz = lx, 0.0
                u, su = mz, sz
            elif abs(ly) >= abs(lz):
                ny, nz = ly, 0.0
                v, sv = mz, sz
            else:
                nz = lz
        elif kind == 1:
            nx, ny, nz = lx, ly, lz
        elif kind == 2:
            k = 0.5 * (taper - 1.0)
            r = 0.5 * (taper + 1.0) + k * ly
            if abs(lx * lx + lz * lz - r * r) < abs(1.0 - ly * ly):
                nx, ny, nz = lx, -k * r, lz
                u, su = math.atan2(lx, lz) * sx, 3.1416 * sx
            else:
                nx, ny, nz = 0.0, ly, 0.0
                v, sv = mz, sz
        wx = a[0] * nx + a[4] * ny + a[8] * nz
        wy = a[1] * nx + a[5] * ny + a[9] * nz
        wz = a[2] * nx + a[6] * ny + a[10] * nz
        facing = wx * dx + wy * dy + wz * dz
        length = math.sqrt(wx * wx + wy * wy + wz * wz)
        inverse = (-1.0 if facing > 0 else 1.0) / length
        wx, wy, wz = wx * inverse, wy * inverse, wz * inverse
        ray = math.sqrt(dx * dx + dy * dy + dz * dz)
        slant = max(abs(facing) / (length * ray), 0.15)
        footprint = max(t * ray * pixel_angle / math.sqrt(slant), 1e-6)
        if integers[p, 1] == 2 and sv > su:  # the grain of wood follows the longer side
            u, v, su, sv = v, u, sv, su
        mix, gain = _albedo(integers[p, 1], u, v, mx, my, mz, su, sv, scalars[p, 3], float(integers[p, 2]), footprint)
        # Surfaces that look up get a little more of the ambient light than those that look down.
        sky = 0.8 - 0.2 * wy
        red, green, blue = ambient[0] * sky, ambient[1] * sky, ambient[2] * sky
        glow = scalars[p, 5]
        if glow > 0.0:
            red, green, blue = glow, glow, glow
        else:
            for k in range(lights.shape[0]):
                vx, vy, vz = x - lights[k, 0], y - lights[k, 1], z - lights[k, 2]
                square = vx * vx + vy * vy + vz * vz
                limit = lights[k, 6] * lights[k, 6]
                cosine = -(vx * wx + vy * wy + vz * wz)
                if square < limit and cosine > 0.0:
                    gap = math.sqrt(square)
                    window = 1.0 - square / limit
                    power = window * window * cosine / (gap * (0.6 + square))
                    if power > 0.004:  # else it cannot be seen, and its shadow need not be looked up
                        # A step off the surface keeps it out of its own shadow.
                        off = 0.01 + gap * texel
                        vx, vy, vz = vx + off * wx, vy + off * wy, vz + off * wz
                        reach = math.sqrt(vx * vx + vy * vy + vz * vz)
                        power = (power - 0.004) * _visibility(shadow, k, vx, vy, vz, reach, 0.02 + 0.6 * gap * texel)
                        red += lights[k, 3] * power
                        green += lights[k, 4] * power
                        blue += lights[k, 5] * power
        color[i, 0] = red * gain * (colors[p, 0] + mix * (colors[p, 3] - colors[p, 0]))
        color[i, 1] = green * gain * (colors[p, 1] + mix * (colors[p, 4] - colors[p, 1]))
        color[i, 2] = blue * gain * (colors[p, 2] + mix * (colors[p, 5] - colors[p, 2]))
