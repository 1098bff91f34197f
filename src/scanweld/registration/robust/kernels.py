"""Weights of robust losses inside kernels; the NumPy classes of this package are their reference.

| code           | parameter | parameter2        | weight                                         |
| -------------- | --------- | ----------------- | ---------------------------------------------- |
| NONE           |           |                   | 1                                              |
| HUBER          | k         |                   | min(1, k / abs(u))                             |
| CAUCHY         | c         |                   | 1 / (1 + (u / c)^2)                            |
| GEMAN_MCCLURE  | c         |                   | 1 / (1 + (u / c)^2)^2                          |
| TUKEY          | c         |                   | (1 - (u / c)^2)^2 within c, 0 beyond           |
| WELSCH         | c         |                   | exp(-(u / c)^2)                                |
| BARRON         | c         | alpha, not 0 or 2 | ((u / c)^2 / abs(alpha - 2) + 1)^(alpha/2 - 1) |
| TRUNCATED      | threshold |                   | 1 up to the threshold, 0 beyond                |
| GNC_TRUNCATED  | c         | mu                | 1, falling to 0 in a band about c              |
"""

from __future__ import annotations

import numpy as np

from scanweld.parallel import inlined, kernel

NONE, HUBER, CAUCHY, GEMAN_MCCLURE, TUKEY, WELSCH, BARRON, TRUNCATED, GNC_TRUNCATED = range(9)


@inlined
def robust_weight(code, parameter, parameter2, u):
    """rho'(u) / u of a residual in units of the noise, which must be finite."""
    size = abs(u)
    q = (u / parameter) * (u / parameter)
    weight = 1.0
    if code == HUBER:
        weight = parameter / max(size, parameter)
    elif code == CAUCHY:
        weight = 1.0 / (1.0 + q)
    elif code == GEMAN_MCCLURE:
        weight = 1.0 / ((1.0 + q) * (1.0 + q))
    elif code == TUKEY:
        inside = max(1.0 - q, 0.0)
        weight = inside * inside
    elif code == WELSCH:
        weight = np.exp(-q)
    elif code == BARRON:
        weight = (q / abs(parameter2 - 2.0) + 1.0) ** (0.5 * parameter2 - 1.0)
    elif code == TRUNCATED:
        weight = 1.0 if size <= parameter else 0.0
    elif code == GNC_TRUNCATED:
        # Yang et al. 2020, eq. 14; the middle case lies in 0..1 within the band and is clipped outside.
        mu = parameter2
        between = parameter / max(size, 1e-300) * np.sqrt(mu * (mu + 1.0)) - mu
        weight = min(max(between, 0.0), 1.0)
    return weight


@kernel
def robust_weights(code, parameter, parameter2, residuals, weights):
    """Weights of all residuals, in units of the noise, into weights."""
    for k in range(len(residuals)):
        weights[k] = robust_weight(code, parameter, parameter2, residuals[k])
