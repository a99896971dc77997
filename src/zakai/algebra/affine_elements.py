"""The size of an estimation algebra that is finite by Yau (1993), Theorem 4 (i), without its table of brackets.

Where Omega is constant, h affine and eta of degree two at most, [L_0, .] maps a.D + b.x + c, in D = d - g, to an operator of
this form: E is spanned by L_0, by what the h_i generate under this linear map, and by 1, for [[L_0, h], h] is |grad h|^2 > 0.
"""

from __future__ import annotations

from flint import fmpq_mat

from zakai.algebra.dmz_operators import DmzOperators
from zakai.algebra.operators import Symbol


def dimension_and_rank(operators: DmzOperators) -> tuple[int, int] | None:
    """The dimension of E, and the number of its affine functions with independent gradients; None with symbols for parameters.

    It needs a regular G.
    """
    if operators.numbers.symbolic:
        return None
    ring, n = operators.ring, operators.ring.n

    def row(p: Symbol) -> list:
        """Of a.xi + b.x + c, with xi for D."""
        terms = {(*m[:n], *ring.split(m)[2]): c for m, c in p.to_dict().items()}
        units = [tuple(int(i == j) for j in range(2 * n)) for i in range(2 * n)]
        return [terms.get(place, 0) for place in (*units, (0,) * (2 * n))]

    one = row(ring.one)
    of_D, of_x = ([row(of(operators, i)) for i in range(n)] for of in (_of_D, _of_x))
    image = fmpq_mat([*of_D, *of_x, [0] * len(one)])
    found = []
    for h in operators.h:
        vector = fmpq_mat([row(h)])
        for _ in range(2 * n):
            found.append(vector.tolist()[0])
            vector = vector * image
    if any(any(vector[:-1]) for vector in found):
        found.append(one)
    dimension, derivatives = fmpq_mat(found).rank(), fmpq_mat([vector[:n] for vector in found]).rank()
    constants = int(any(map(any, found)))
    return 1 + dimension, dimension - derivatives - constants


def _of_x(operators: DmzOperators, i: int) -> Symbol:
    """[L_0, x_i] = sum_k G_ik D_k."""
    return sum((c * xi for c, xi in zip(operators.covariance[i], operators.ring.xi)), operators.ring.zero)


def _of_D(operators: DmzOperators, i: int) -> Symbol:
    """[L_0, D_i] = sum_jk omega_ij G_jk D_k + d_i eta / 2, for a constant Omega."""
    ring, omega = operators.ring, operators.omega
    total = ring.total_derivative(operators.eta, i) / 2
    for j in range(ring.n):
        entry = omega[i, j] if i < j else -omega[j, i] if j < i else ring.zero
        if not entry.is_zero():
            total = total + entry * _of_x(operators, j)
    return ring.normal(total)
