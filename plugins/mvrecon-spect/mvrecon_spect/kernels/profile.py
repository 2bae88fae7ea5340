"""Cumulative distributions of a footprint along one axis of the detector.

A profile is a mixture of the densities (1 - t^2)^n and (1 - t^2)^(n + 1) on [-1, 1], n = 0 .. 5,
stretched to a given variance. The density (1 - t^2)^p has the excess kurtosis -6 / (2 p + 5): a box
for p = 0, nearly a Gaussian for p = 6, the smoothest. Between the integers the mixture with the
share p - n of the next density has this kurtosis within 0.01.
"""

from math import comb

import numpy as np

#: Coefficients of a cumulative distribution, an odd polynomial of degree 13 in t.
TERMS = 7
#: Columns of `PIECES`: variance of (1 - t^2)^n and its step to n + 1, coefficients of the
#: cumulative distribution minus 1/2, and their steps.
VARIANCE, VARIANCE_STEP, COEFFICIENTS, STEPS = 0, 1, 2, 2 + TERMS


def _pieces() -> np.ndarray:
    """The constants of the six pairs n, n + 1."""
    variance, cumulative = 1 / (2 * np.arange(TERMS) + 3), np.zeros((TERMS, TERMS))
    for n in range(TERMS):
        terms = np.array([(-1) ** e * comb(n, e) / (2 * e + 1) for e in range(n + 1)])
        cumulative[n, : n + 1] = terms / (2 * terms.sum())
    parts = variance[:-1, None], np.diff(variance)[:, None], cumulative[:-1]
    return np.concatenate([*parts, np.diff(cumulative, axis=0)], axis=1)


#: [6, 16], see above.
PIECES = _pieces()
