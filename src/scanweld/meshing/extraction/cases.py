"""The triangles of marching cubes (Lorensen and Cline 1987), derived instead of listed.

Corner c of a cell is at (c & 1, c >> 1 & 1, c >> 2 & 1). An edge is named 3 c + axis by its lower corner and its
direction, so that it is at once the edge `axis` of that corner's sample. Case n has the corners of its set bits inside,
where the distance is negative.

On each face the surface cuts off every run of inside corners. Where two opposite corners are inside this is a choice,
but the same one for both cells at the face, so neighbouring cells always fit (unlike the table of 1987; Nielson and
Hamann 1991). The cuts of the six faces join to closed loops around the cell, and each loop is cut into triangles.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from scanweld.arrays import Array

_FACES = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))
"""Corners of the faces -x, +x, -y, +y, -z, +z, anticlockwise as seen from outside the cell."""

MOST_CORNERS = 15
"""Five triangles, as in the table of 1987."""


def edge_between(a: int, b: int) -> int:
    """Name of the edge between two neighbouring corners."""
    return 3 * min(a, b) + (a ^ b).bit_length() - 1


def loops(case: int) -> list[list[int]]:
    """Return the loops of edges in which the surface leaves a cell; from outside they go anticlockwise."""
    inside = [bool(case >> corner & 1) for corner in range(8)]
    following: dict[int, int] = {}
    for face in _FACES:
        for k in range(4):
            if not inside[face[k]] or inside[face[k - 1]]:
                continue
            # A run of inside corners begins at k: the cut goes from the edge after it to the edge before it.
            end = k
            while inside[face[(end + 1) % 4]]:
                end += 1
            leaving = edge_between(face[end % 4], face[(end + 1) % 4])
            following[edge_between(face[k - 1], face[k])] = leaving
    found = []
    while following:
        loop = [min(following)]
        while (after := following.pop(loop[-1])) != loop[0]:
            loop.append(after)
        found.append(loop)
    return found


def triangles(loop: list[int]) -> list[tuple[int, int, int]]:
    """Cut a loop into a fan of triangles.

    The fan begins where no cut lies in a face of the cell, if there is such a place: the cell beyond that face could
    cut there as well, and four triangles would share an edge.
    """

    def share_a_face(a: int, b: int) -> bool:
        return any({*ends(a), *ends(b)} <= set(face) for face in _FACES)

    def cuts_in_faces(first: int) -> int:
        turned = loop[first:] + loop[:first]
        return sum(share_a_face(turned[0], other) for other in turned[2:-1])

    first = min(range(len(loop)), key=cuts_in_faces)
    turned = loop[first:] + loop[:first]
    return [(turned[0], turned[k], turned[k + 1]) for k in range(1, len(turned) - 1)]


def ends(edge: int) -> tuple[int, int]:
    """Corners at both ends of an edge."""
    corner, axis = divmod(edge, 3)
    return corner, corner | 1 << axis


@lru_cache(maxsize=1)
def case_table() -> Array:
    """Return (256, 1 + MOST_CORNERS) int8: the number of triangle corners of each case, and their edges."""
    table = np.full((256, 1 + MOST_CORNERS), -1, np.int8)
    for case in range(256):
        corners = [edge for loop in loops(case) for triangle in triangles(loop) for edge in triangle]
        table[case, 0] = len(corners)
        table[case, 1 : 1 + len(corners)] = corners
    return table
