"""The flow that belongs to a kernel given by its coefficients, such as those of the power series.

A kernel exp(x'A x + x'B y + y'C y + D.x + E.y + s) is the exponential of the classical action of an affine Hamiltonian flow,
which it determines: B = -2 P12^-T, C = P12^-1 P11, A = P22 P12^-1, and the shifts from D and E.
"""

from __future__ import annotations

import numpy as np

from zakai.kolmogorov.flow import Flow
from zakai.kolmogorov.quadratic_kernel import KernelCoefficients
from zakai.kolmogorov.taylor import apply, dot, symmetric, transpose


def flow_of_kernel(kernel: KernelCoefficients) -> Flow:
    """The `Flow`, without inputs, whose transition is the kernel (a batch of them, with one leading axis).

    What the kernel holds as one constant s is given back as the growth of the mass.
    """
    A, B, C, D, E, s, *_ = kernel
    n = A.shape[-1]
    p12 = -2.0 * np.linalg.inv(transpose(B))
    p11, p22 = p12 @ C, A @ p12
    p21 = transpose((transpose(p11) @ p22 - np.eye(n)) @ np.linalg.inv(p12))
    shift = 0.5 * apply(p12, E)
    push = 0.5 * D + apply(A, shift)
    # The action from a start at rest, as a function of the centre c: shift and push are at c = 0, `action` is its slope.
    action_inputs = dot(shift, apply(A, shift)) + dot(D, shift) - dot(push, shift)
    slope = apply(transpose(p11), 2.0 * apply(A, shift) + D) + apply(transpose(B), shift) + E
    action = slope - apply(transpose(p21), shift) - apply(transpose(p11), push)
    log_volume = np.linalg.slogdet(p11)[1]
    growth = s + 0.5 * n * np.log(np.pi) + 0.5 * np.linalg.slogdet(p12)[1]
    return Flow(
        map=p11,
        spread=-0.5 * symmetric(np.linalg.solve(p11, p12)),
        bend=symmetric(transpose(p11) @ p21),
        lift=p21,
        shift=shift[..., None],
        push=push[..., None],
        action=action[..., None, :],
        action_inputs=action_inputs[..., None, None],
        growth=growth[..., None],
        trace=np.zeros_like(s),
        log_volume=log_volume,
    )
