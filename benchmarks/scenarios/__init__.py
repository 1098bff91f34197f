"""The scenarios of `benchmarks/robustness.py`: what is asked of each, and how it is measured."""
