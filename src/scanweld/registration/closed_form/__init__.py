"""Closed-form alignment of paired points: Kabsch and Umeyama by SVD, Horn by unit quaternion.

Minimises E = sum w_i |b_i - s R a_i - t|^2 over proper rotations R, det R = +1, and, where asked for, the
scale s.

    align_closed_form        pairs from anywhere: checked, judged, with the uncertainty of the answer
    align_closed_form_batch  many small problems at once
    pair_residuals           what an alignment leaves of each pair
    fit_horn                 every quantity on the way
    fit_pairs                the motion alone, for the inner loop of an iteration

Sources: B. K. P. Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987.
S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
K. S. Arun, T. S. Huang, S. D. Blostein, "Least-squares fitting of two 3-D point sets", 1987.
"""

from scanweld.registration.closed_form.align import align_closed_form, pair_residuals
from scanweld.registration.closed_form.batch import ClosedFormBatch, align_closed_form_batch
from scanweld.registration.closed_form.fit import METHODS, SCALES, HornFit, PairFit, fit_horn, fit_pairs
from scanweld.registration.closed_form.kernels import MAX_ANGLE_STD_RAD, RANK_TOLERANCE

__all__ = [
    "MAX_ANGLE_STD_RAD",
    "METHODS",
    "RANK_TOLERANCE",
    "SCALES",
    "ClosedFormBatch",
    "HornFit",
    "PairFit",
    "align_closed_form",
    "align_closed_form_batch",
    "fit_horn",
    "fit_pairs",
    "pair_residuals",
]
