"""What a part that replaces one of the library's must satisfy: contract tests to be called from any test."""

from scanweld.testing.sequences import check_sequence

__all__ = ["check_sequence"]
