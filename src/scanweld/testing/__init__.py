"""What a part that replaces one of the library's must satisfy: contract tests to be called from any test.

Each Protocol of the library has one. They need no test framework: a promise that is broken raises AssertionError, and
says which.
"""

from scanweld.testing.clocks import check_clock
from scanweld.testing.loop_closers import check_loop_closer
from scanweld.testing.map_backends import check_map_backend
from scanweld.testing.mappers import check_mapper
from scanweld.testing.neighbours import check_neighbour_index
from scanweld.testing.observers import check_observer
from scanweld.testing.projective_backends import check_projective_backend
from scanweld.testing.robust_kernels import check_agreement_limits, check_robust_kernel
from scanweld.testing.sequences import check_gyroscope, check_live_sequence, check_sequence
from scanweld.testing.states import check_source
from scanweld.testing.tables import check_columns
from scanweld.testing.trackers import check_tracker

__all__ = [
    "check_agreement_limits",
    "check_clock",
    "check_columns",
    "check_gyroscope",
    "check_live_sequence",
    "check_loop_closer",
    "check_map_backend",
    "check_mapper",
    "check_neighbour_index",
    "check_observer",
    "check_projective_backend",
    "check_robust_kernel",
    "check_sequence",
    "check_source",
    "check_tracker",
]
