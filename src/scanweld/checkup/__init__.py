"""Looks at a recording before it is used: what is wrong with it, why that matters, and what to do about it."""
