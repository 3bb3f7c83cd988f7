"""Stepwise regression: which few of many causes explain what was measured (Efroymson, Multiple regression analysis).

Causes that explain the same are not told apart by fitting them all: each of them is uncertain then. The normal
equations are solved for those alone that the measurements ask for, by the sweep operator (Goodnight, A tutorial on the
SWEEP operator, The American Statistician 33, 1979). The matrix (n + 1, n + 1) holds the information of n causes, their
evidence in its last row and column, and in its last element the sum of squares to be explained. After a sweep of some
causes their block is their covariance, their part of the last column their estimates, and the last element what they
leave unexplained.
"""

from __future__ import annotations

from eskf_ros.compiled import njit


@njit
def sweep(matrix, pivot):
    """Take the cause ``pivot`` into the solution, or out of it again: the operator is its own inverse."""
    size, divisor = len(matrix), matrix[pivot, pivot]
    for j in range(size):
        matrix[pivot, j] /= divisor
    for i in range(size):
        if i != pivot:
            factor = matrix[i, pivot]
            for j in range(size):
                matrix[i, j] -= factor * matrix[pivot, j]
            matrix[i, pivot] = -factor / divisor
    matrix[pivot, pivot] = 1.0 / divisor


@njit
def explained(matrix, cause):
    """Return by how much the unexplained sum of squares would shrink with a cause that is not in the solution."""
    last = len(matrix) - 1
    return matrix[cause, last] ** 2 / matrix[cause, cause]


@njit
def best_cause(matrix, is_chosen):
    """Return the cause outside the solution that explains most, and what it explains; -1 and 0 where there is none."""
    best, most = -1, 0.0
    for cause in range(len(matrix) - 1):
        if not is_chosen[cause] and explained(matrix, cause) > most:
            best, most = cause, explained(matrix, cause)
    return best, most


@njit
def lost_by_exchange(matrix, is_chosen, cause):
    """Return how much less is explained with the best other cause in the place of a chosen one."""
    sweep(matrix, cause)
    own = explained(matrix, cause)
    other = 0.0
    for candidate in range(len(matrix) - 1):
        if not is_chosen[candidate]:
            other = max(other, explained(matrix, candidate))
    sweep(matrix, cause)
    return own - other
