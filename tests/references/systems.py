"""Systems with all that is easy to get wrong: G, L, l, S, phi depend on t; l, p and phi_t are not zero.

Each is written twice: as text, the keys of a model, and as plain numpy; `test_references.py` holds the two
together.  Between observations, with f = L x + l + G grad phi and phi = log cosh(k . x + beta), k' = -L' k,
beta' = -k . l,

    q = 2 phi_t + G : Hess phi + grad phi' G grad phi + 2 (L x + l) . grad phi + 2 tr L + h' S^-1 h
      = k' G k + 2 tr L + h' S^-1 h,

and h is built so that h' S^-1 h is a quadratic; the texts Q, p, r are those of q = x' Q x + p . x + r.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np

import zakai


@dataclass(frozen=True, eq=False)
class System:
    """A filtering problem: texts for a model, numpy functions of x (..., n) and t for a reference."""

    name: str
    state: list[str]
    drift: list[str]
    diffusion: list[list[str]]
    process_noise: list[list[str]]
    observation: list[str]
    observation_noise: list[list[str]]
    yau: dict  # texts of G, L, l, phi, Q, p, r
    weights: list[float]
    means: list[list[float]]
    covs: list[list[list[float]]]
    times: np.ndarray
    increments: np.ndarray
    G: Callable[[float], np.ndarray] = field(repr=False)
    L: Callable[[float], np.ndarray] = field(repr=False)
    l: Callable[[float], np.ndarray] = field(repr=False)
    S: Callable[[float], np.ndarray] = field(repr=False)
    k: Callable[[float], np.ndarray] = field(repr=False)
    beta: Callable[[float], float] = field(repr=False)
    h: Callable[[np.ndarray, float], np.ndarray] = field(repr=False)
    start: float = 0.0

    @property
    def n(self) -> int:
        return len(self.state)

    @cache  # noqa: B019 - systems are few
    def model(self, kind: str) -> zakai.Model:
        """One model for all tests: its analysis takes seconds and is kept in it."""
        return zakai.Model(**self.keys() | {"observation_kind": kind})

    def keys(self) -> dict:
        """The keys of a model file, prior included; the record's values are increments."""
        return {
            "name": self.name,
            "state": self.state,
            "drift": self.drift,
            "diffusion": self.diffusion,
            "process_noise": self.process_noise,
            "observation": self.observation,
            "observation_noise": self.observation_noise,
            "observation_kind": "increments",
            "prior": {"kind": "mixture", "weights": self.weights, "means": self.means, "covs": self.covs},
        }

    def phi(self, x: np.ndarray, t: float) -> np.ndarray:
        return np.log(np.cosh(x @ self.k(t) + self.beta(t)))

    def f(self, x: np.ndarray, t: float) -> np.ndarray:
        k = self.k(t)
        return x @ self.L(t).T + self.l(t) + np.tanh(x @ k + self.beta(t))[..., None] * (self.G(t) @ k)

    def div_f(self, x: np.ndarray, t: float) -> np.ndarray:
        k = self.k(t)
        return np.trace(self.L(t)) + (k @ self.G(t) @ k) / np.cosh(x @ k + self.beta(t)) ** 2

    def h_S_h(self, x: np.ndarray, t: float) -> np.ndarray:
        h = self.h(x, t)
        return np.einsum("...i,ij,...j->...", h, np.linalg.inv(self.S(t)), h)

    def jump(self, x: np.ndarray, t: float, increment: np.ndarray) -> np.ndarray:
        return np.exp(self.h(x, t) @ np.linalg.solve(self.S(t), increment))

    def initial(self, x: np.ndarray) -> np.ndarray:
        total = np.zeros(x.shape[:-1])
        for weight, mean, cov in zip(self.weights, np.array(self.means), np.array(self.covs), strict=True):
            d = x - mean
            exponent = -0.5 * np.einsum("...i,ij,...j->...", d, np.linalg.inv(cov), d)
            total += weight * np.exp(exponent) / np.sqrt(np.linalg.det(2.0 * np.pi * cov))
        return total


@cache
def scalar() -> System:
    """One state, two sensors with correlated noise, everything varies in time.

    L = -3/10 + cos(t)/5 gives k = 4/5 exp(3t/10 - sin(t)/5); beta = 3/10 + sin(3t)/4 is chosen and
    l = -beta'/k follows.  S = C C' with C = [[1 + t/2, 0], [3/10 cos t, 1]], h = C w and
    w = c (x - a) (sin(x + t/2), cos(x + t/2)).
    """
    k, beta = "4/5*exp(3*t/10 - sin(t)/5)", "3/10 + sin(3*t)/4"
    L, l, G = "-3/10 + cos(t)/5", "-15/16*cos(3*t)*exp(-3*t/10 + sin(t)/5)", "1 + sin(2*t)/2"
    c, a = "(1 + 3/10*sin(2*t))", "(1/5 + t/2)"
    radius = f"{c}*(x - {a})"

    def C(t: float) -> np.ndarray:
        return np.array([[1.0 + 0.5 * t, 0.0], [0.3 * np.cos(t), 1.0]])

    def h(x: np.ndarray, t: float) -> np.ndarray:
        x = x[..., 0]
        r = (1.0 + 0.3 * np.sin(2.0 * t)) * (x - 0.2 - 0.5 * t)
        return np.stack([r * np.sin(x + 0.5 * t), r * np.cos(x + 0.5 * t)], axis=-1) @ C(t).T

    def decay(t: float) -> float:
        return np.exp(0.3 * t - 0.2 * np.sin(t))

    return System(
        name="scalar Yau system",
        state=["x"],
        drift=[f"({L})*x + ({l}) + ({G})*({k})*tanh(({k})*x + {beta})"],
        diffusion=[["1"]],
        process_noise=[[G]],
        observation=[
            f"(1 + t/2)*{radius}*sin(x + t/2)",
            f"3/10*cos(t)*{radius}*sin(x + t/2) + {radius}*cos(x + t/2)",
        ],
        observation_noise=[
            ["(1 + t/2)**2", "3/10*(1 + t/2)*cos(t)"],
            ["3/10*(1 + t/2)*cos(t)", "1 + 9/100*cos(t)**2"],
        ],
        yau={
            "G": [[G]],
            "L": [[L]],
            "l": [l],
            "phi": f"log(cosh(({k})*x + {beta}))",
            "Q": [[f"{c}**2"]],
            "p": [f"-2*{a}*{c}**2"],
            "r": f"{a}**2*{c}**2 + ({G})*({k})**2 + 2*({L})",
        },
        weights=[0.6, 0.4],
        means=[[-1.0], [1.2]],
        covs=[[[0.16]], [[0.25]]],
        times=np.array([0.1, 0.2, 0.3, 0.4, 0.5]),
        increments=np.array([[0.25, -0.30], [-0.40, 0.15], [0.35, 0.45], [0.10, -0.50], [-0.20, 0.30]]),
        G=lambda t: np.array([[1.0 + 0.5 * np.sin(2.0 * t)]]),
        L=lambda t: np.array([[-0.3 + 0.2 * np.cos(t)]]),
        l=lambda t: np.array([-0.9375 * np.cos(3.0 * t) / decay(t)]),
        S=lambda t: C(t) @ C(t).T,
        k=lambda t: np.array([0.8 * decay(t)]),
        beta=lambda t: 0.3 + 0.25 * np.sin(3.0 * t),
        h=h,
    )


@cache
def planar() -> System:
    """Two states, three correlated sensors, non-diagonal G(t), L that no Cholesky factor makes symmetric.

    With theta = t/2 + 3/10, e = (cos theta, sin theta), e_ = (-sin theta, cos theta), J the quarter turn,
    L = -1/5 I + 1/2 J + e_ (2/5, -3/10) gives k = 7/10 exp(t/5) e;  beta = 1/5 + sin(2t)/5 is chosen and
    l = -beta' e / |k| + cos(t)/2 e_ satisfies beta' = -k . l.
    G = g P g', g = [[1, t/2], [-sin(t)/2, 1]], P = [[1, 1/4], [1/4, 4/5]];  S = C C';  h = C w,
    w = (l1 sin(x1 + x2/2), l1 cos(x1 + x2/2), l2), l1 = (1 + t/2) x1 + x2/2 + 3/10,
    l2 = x2 - sin(t) x1/2 - 2/5.
    """
    theta, k_size, k_inverse = "(t/2 + 3/10)", "7/10*exp(t/5)", "10/7*exp(-t/5)"
    e, e_ = (f"cos({theta})", f"sin({theta})"), (f"(-sin({theta}))", f"cos({theta})")
    k = tuple(f"{k_size}*{component}" for component in e)
    beta, beta_rate = "(1/5 + sin(2*t)/5)", "2/5*cos(2*t)"
    L = [[f"-1/5 + 2/5*{e_[0]}", f"-1/2 - 3/10*{e_[0]}"], [f"1/2 + 2/5*{e_[1]}", f"-1/5 - 3/10*{e_[1]}"]]
    l = [f"-{beta_rate}*{k_inverse}*{e[i]} + cos(t)/2*{e_[i]}" for i in range(2)]
    G12 = "(-sin(t)/2 + 1/4*(1 - t*sin(t)/4) + 2/5*t)"
    G = [["(1 + t/4 + t**2/5)", G12], [G12, "(sin(t)**2/4 - sin(t)/4 + 4/5)"]]
    angle = f"({k[0]}*x1 + {k[1]}*x2 + {beta})"
    l1, l2 = "((1 + t/2)*x1 + x2/2 + 3/10)", "(x2 - sin(t)*x1/2 - 2/5)"
    w = (f"{l1}*sin(x1 + x2/2)", f"{l1}*cos(x1 + x2/2)", l2)
    a1, a2 = ("(1 + t/2)", "1/2"), ("(-sin(t)/2)", "1")

    def turn(t: float) -> tuple[np.ndarray, np.ndarray]:
        angle = 0.5 * t + 0.3
        return np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])

    def covariance(t: float) -> np.ndarray:
        g = np.array([[1.0, 0.5 * t], [-0.5 * np.sin(t), 1.0]])
        return g @ np.array([[1.0, 0.25], [0.25, 0.8]]) @ g.T

    def linear(t: float) -> np.ndarray:
        return np.array([[-0.2, -0.5], [0.5, -0.2]]) + np.outer(turn(t)[1], [0.4, -0.3])

    def constant(t: float) -> np.ndarray:
        along, across = turn(t)
        return -0.4 * np.cos(2.0 * t) / (0.7 * np.exp(0.2 * t)) * along + 0.5 * np.cos(t) * across

    def C(t: float) -> np.ndarray:
        return np.array([[1.0, 0.0, 0.0], [0.5 * t, 1.2, 0.0], [0.3, 0.2 * np.cos(t), 1.0 + 0.25 * t]])

    def h(x: np.ndarray, t: float) -> np.ndarray:
        x1, x2 = x[..., 0], x[..., 1]
        first, second = (1.0 + 0.5 * t) * x1 + 0.5 * x2 + 0.3, x2 - 0.5 * np.sin(t) * x1 - 0.4
        w = np.stack([first * np.sin(x1 + 0.5 * x2), first * np.cos(x1 + 0.5 * x2), second], axis=-1)
        return w @ C(t).T

    return System(
        name="planar Yau system",
        state=["x1", "x2"],
        drift=[
            f"({L[i][0]})*x1 + ({L[i][1]})*x2 + ({l[i]})"
            f" + ({G[i][0]}*{k[0]} + {G[i][1]}*{k[1]})*tanh({angle})"
            for i in range(2)
        ],
        diffusion=[["1", "t/2"], ["-sin(t)/2", "1"]],
        process_noise=[["1", "1/4"], ["1/4", "4/5"]],
        observation=[w[0], f"t/2*{w[0]} + 6/5*{w[1]}", f"3/10*{w[0]} + 1/5*cos(t)*{w[1]} + (1 + t/4)*{w[2]}"],
        observation_noise=[
            ["1", "t/2", "3/10"],
            ["t/2", "t**2/4 + 36/25", "3/20*t + 6/25*cos(t)"],
            ["3/10", "3/20*t + 6/25*cos(t)", "9/100 + cos(t)**2/25 + (1 + t/4)**2"],
        ],
        yau={
            "G": G,
            "L": L,
            "l": l,
            "phi": f"log(cosh({angle}))",
            "Q": [[f"{a1[i]}*{a1[j]} + {a2[i]}*{a2[j]}" for j in range(2)] for i in range(2)],
            "p": [f"3/5*{a1[i]} - 4/5*{a2[i]}" for i in range(2)],
            "r": (
                f"1/4 + {G[0][0]}*({k[0]})**2 + 2*{G[0][1]}*{k[0]}*{k[1]} + {G[1][1]}*({k[1]})**2"
                f" + 2*({L[0][0]} + {L[1][1]})"
            ),
        },
        weights=[0.55, 0.45],
        means=[[-0.9, 0.4], [0.8, -0.5]],
        covs=[[[0.30, 0.08], [0.08, 0.25]], [[0.28, -0.06], [-0.06, 0.36]]],
        times=np.array([0.1, 0.2, 0.3]),
        increments=np.array([[0.20, -0.30, 0.15], [-0.35, 0.10, 0.25], [0.15, 0.30, -0.20]]),
        G=covariance,
        L=linear,
        l=constant,
        S=lambda t: C(t) @ C(t).T,
        k=lambda t: 0.7 * np.exp(0.2 * t) * turn(t)[0],
        beta=lambda t: 0.2 + 0.2 * np.sin(2.0 * t),
        h=h,
    )
