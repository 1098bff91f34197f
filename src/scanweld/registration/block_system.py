"""Sparse least squares whose unknowns are the nodes of a graph, in blocks, and whose residuals are its edges.

An edge (i, j) has a residual r + A_i x_i + A_j x_j and an information W. The normal equations are one block row a
node: their pattern, the elimination order and the places where the blocks of edges go are found once, and each
assembly is then a few vectorised sums. The order of the sums is fixed, so the same edges give the same bytes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from scanweld.arrays import Array, Float64, Int64

HELD = -1
"""Stands for a node that is not an unknown."""


class BlockSystem:
    """The sparse normal equations of a graph.

    Parameters
    ----------
    first, second : (E,) the two nodes of each edge, 0..num_nodes - 1, or HELD
    num_nodes : number of unknown nodes
    size : number of unknowns per node, S
    """

    def __init__(self, first: Int64, second: Int64, num_nodes: int, size: int) -> None:
        self.num_nodes, self.size = num_nodes, size
        rank = elimination_order(first, second, num_nodes)
        self._node_of_rank = np.argsort(rank)
        at = np.append(rank, HELD)  # HELD indexes the last entry: itself
        i, j = at[first], at[second]
        nodes = np.arange(num_nodes)  # a zero block on each diagonal: it is there even if no edge is
        rows, columns = np.concatenate([i, j, i, j, nodes]), np.concatenate([i, j, j, i, nodes])
        self._edge_blocks = np.flatnonzero((rows >= 0) & (columns >= 0))
        rows, columns = rows[self._edge_blocks], columns[self._edge_blocks]
        # Blocks that go to the same place are summed in runs of this order.
        key = columns * num_nodes + rows
        order = np.argsort(key, kind="stable")
        self._run_order = order
        self._run_starts = np.flatnonzero(np.diff(key[order], prepend=-1))
        places = order[self._run_starts]
        self._set_pattern(rows[places], columns[places])
        ends = np.concatenate([i, j])
        self._gradient_edges = np.flatnonzero(ends >= 0)
        self._gradient_rows = ends[self._gradient_edges]

    def _set_pattern(self, rows: Int64, columns: Int64) -> None:
        """Number the entries of blocks, sorted by column, then row, in the order of a CSC matrix.

        Above entry (r, c) of the k-th of the n blocks in its block column are c columns of n S entries, k S entries of
        the blocks before, and r of its own.
        """
        s = self.size
        inner = np.arange(s)
        counts = np.bincount(columns, minlength=self.num_nodes)
        starts = np.concatenate([[0], np.cumsum(counts)])
        k = np.arange(len(rows)) - starts[columns]
        at = (starts[columns] * s * s + k * s)[:, None, None] + inner[:, None]
        at = (at + (counts[columns] * s)[:, None, None] * inner).ravel()
        self._take = np.empty_like(at)
        self._take[at] = np.arange(len(at))
        self._indices = np.empty(len(at), dtype=np.int32)
        self._indices[at] = np.repeat(rows[:, None] * s + inner, s)
        per_column = np.repeat(counts * s, s)
        self._indptr = np.concatenate([[0], np.cumsum(per_column)]).astype(np.int32)
        scalar_columns = np.repeat(np.arange(self.num_nodes * s), per_column)
        self._diagonal = np.flatnonzero(self._indices == scalar_columns)

    def matrix(self, first: Float64, second: Float64, information: Float64) -> sp.csc_matrix:
        """Return H = sum A^T W A.

        Parameters
        ----------
        first, second : (E, R, S), A_i and A_j of each edge
        information : (E, R, R), symmetric
        """
        s = self.size
        left, right = np.swapaxes(first, 1, 2) @ information, np.swapaxes(second, 1, 2) @ information
        across = left @ second
        zeros = np.zeros((self.num_nodes, s, s))
        blocks = np.concatenate([left @ first, right @ second, across, np.swapaxes(across, 1, 2), zeros])
        blocks = blocks[self._edge_blocks][self._run_order]
        values = np.add.reduceat(blocks, self._run_starts, axis=0).ravel()[self._take]
        n = self.num_nodes * s
        return sp.csc_matrix((values, self._indices, self._indptr), shape=(n, n))

    def gradient(self, first: Float64, second: Float64, information: Float64, residual: Float64) -> Float64:
        """Return g = sum A^T W r, (num_nodes S, ...), for residuals (E, R, ...)."""
        pulled = information @ (residual if residual.ndim == 3 else residual[:, :, None])
        blocks = np.concatenate([np.swapaxes(first, 1, 2) @ pulled, np.swapaxes(second, 1, 2) @ pulled])
        total = np.zeros((self.num_nodes, *blocks.shape[1:]))
        np.add.at(total, self._gradient_rows, blocks[self._gradient_edges])
        return total.reshape(self.num_nodes * self.size, *residual.shape[2:])

    def diagonal(self, matrix: sp.csc_matrix) -> Float64:
        """Return the diagonal of a matrix made by :meth:`matrix`."""
        return np.asarray(matrix.data[self._diagonal])

    def factor(self, matrix: sp.csc_matrix, added_diagonal: Float64 | float = 0.0) -> Any:
        """Factorise `matrix` with something added to its diagonal; the unknowns are eliminated in their order.

        Returns
        -------
        SuperLU object, or None where a pivot is exactly zero.
        """
        values = matrix.data.copy()
        values[self._diagonal] += added_diagonal
        damped = sp.csc_matrix((values, self._indices, self._indptr), shape=matrix.shape)
        try:
            # A positive definite matrix needs no pivoting, and keeps its sparsity without.
            return splu(damped, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError:
            return None

    def to_nodes(self, solution: Float64) -> Float64:
        """Return a vector of the system, (num_nodes S, ...), as rows (num_nodes, S, ...) in the order of the nodes."""
        result = np.empty((self.num_nodes, self.size, *solution.shape[1:]))
        result[self._node_of_rank] = solution.reshape(result.shape)
        return result

    def rows_of(self, node: int) -> Int64:
        """Return the rows (S,) of the system that belong to a node."""
        rank = int(np.flatnonzero(self._node_of_rank == node)[0])
        return rank * self.size + np.arange(self.size)


def elimination_order(first: Array, second: Array, num_nodes: int) -> Int64:
    """Return the place (num_nodes,) of each node in an order of elimination that fills in little.

    Minimum degree (SuperLU's, on A + A^T) on the graph of the nodes, which has far fewer entries than the system.
    """
    free = (first >= 0) & (second >= 0)
    i, j = first[free], second[free]
    ones = np.ones(len(i))
    graph = sp.coo_matrix((ones, (i, j)), shape=(num_nodes, num_nodes))
    degree = np.bincount(i, minlength=num_nodes) + np.bincount(j, minlength=num_nodes)
    laplacian = sp.diags(degree + 1.0) - graph - graph.T
    factors = splu(
        laplacian.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return np.asarray(factors.perm_c, dtype=np.int64)
