"""Brightness as a second witness beside geometry: residuals, their scale, and when they are believed."""
