"""The studies of `benchmarks/registration.py`, one module each, and the processes that the systems run in."""
