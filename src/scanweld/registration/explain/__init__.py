"""Every step of an alignment, as numbers, as text and as a verdict in words.

For small sets: what `scanweld register --explain` prints. The steps are those that the aligners take, not a second
implementation: the tables are made from :class:`~scanweld.registration.closed_form.HornFit` and from the history of
:func:`~scanweld.registration.icp.icp`.
"""

from scanweld.registration.explain.example import MOST_POINTS, WORKED_SOURCE, WORKED_TARGET
from scanweld.registration.explain.gauss_newton import GaussNewtonStepExplanation
from scanweld.registration.explain.horn import HornExplanation, explain_horn
from scanweld.registration.explain.icp import IcpExplanation, IcpStepExplanation, check_explainable, explain_icp

__all__ = [
    "MOST_POINTS",
    "WORKED_SOURCE",
    "WORKED_TARGET",
    "GaussNewtonStepExplanation",
    "HornExplanation",
    "IcpExplanation",
    "IcpStepExplanation",
    "check_explainable",
    "explain_horn",
    "explain_icp",
]
