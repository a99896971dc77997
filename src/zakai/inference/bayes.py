"""The posterior of parameters given a record, by the no-U-turn sampler on the evidence of the filter."""

from __future__ import annotations

import logging
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from zakai._progress import Progress, bar
from zakai.engine.batch import LONG
from zakai.engine.driver import with_inputs
from zakai.engine.likelihood import LogLikelihood, chosen_parameters
from zakai.errors import InputError
from zakai.inference.maximum import hessian
from zakai.inference.priors import Prior
from zakai.models.model import Model
from zakai.records import Inputs, Record

if TYPE_CHECKING:
    import xarray

Array = NDArray[Any]
LARGEST_R_HAT = 1.01
EVALUATIONS = 4  # of the posterior for a draw, about, after whitening
_LOG = logging.getLogger("zakai")


def sample(
    model: Model,
    record: Record,
    priors: Mapping[str, str],
    draws: int = 1000,
    chains: int = 2,
    seed: int = 0,
    *,
    warmup: int = 300,
    method: str = "auto",
    inputs: Inputs | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> xarray.Dataset:
    """Draw from the posterior of parameters given a record.

        p(theta | observations) is proportional to p(observations | theta) p(theta)

    The evidence is that of `zakai.log_likelihood`, so that the states are integrated out.  The sampler is NUTS with window
    adaptation (blackjax, the extra `bayes`), after a linear transform by the Hessian at the posterior's mode.

    Args:
        model: the system, with a prior of the state and with parameters.
        record: K observations.
        priors: for each parameter to sample its prior: "normal(mean, standard deviation)", "lognormal(mean, standard deviation)"
            (of the logarithm), "half-normal(scale)", "gamma(shape, rate)", "uniform(low, high)" or "beta(a, b)".  The other
            parameters keep their values.
        draws: number of draws of each chain that are kept.
        chains: number of chains.
        seed: the same seed gives the same draws.
        warmup: number of draws of each chain for adaptation, which are not kept.
        method: as for `zakai.filter`.
        inputs: the known inputs of the model, in place of those of the record.
        progress: called with the number of draws done and their total; without it long work has a bar on a terminal.
        **options: options of the method.

    Returns:
        One variable for each parameter over `chain` and `draw`, each with attributes `r_hat` (split R-hat) and `ess` (effective
        sample size).  The attributes of the whole are `divergences`, the largest `r_hat`, the smallest `ess`, and `method`.

    Raises:
        InputError: a wrong prior, an unknown parameter, blackjax is not installed, and as `zakai.filter`.
        ConditionError: the method's theorem does not hold.

    References:
        Hoffman and Gelman 2014, The No-U-Turn Sampler.
        Vehtari, Gelman, Simpson, Carpenter and Buerkner 2021, Rank-normalization, folding, and localization: An improved R-hat.

    Example:
        posterior = zakai.sample(model, record, {"a": "lognormal(0, 1)", "s": "half-normal(1)"})
        posterior["a"].mean(), posterior.attrs["r_hat"]
    """
    if not isinstance(priors, Mapping) or not priors:
        raise InputError('priors: expected a dictionary by parameter name, such as {"a": "normal(0, 1)"}')
    for name, number, least in (("draws", draws, 4), ("chains", chains, 1), ("warmup", warmup, 20)):
        if isinstance(number, bool) or not isinstance(number, int | np.integer) or number < least:
            raise InputError(f"sample: {name} is {number!r}; expected a whole number of at least {least}")
    names, record = chosen_parameters(model, tuple(priors)), with_inputs(record, inputs)
    posterior = _Posterior(LogLikelihood(model, record, method, names, dict(options)), names, priors)
    try:
        import blackjax
    except ImportError:
        raise InputError("sample: blackjax is not installed; install the extra bayes: pip install 'zakai[bayes]'") from None
    posterior.whiten(np.array([posterior.priors[i].place(model.parameters[name]) for i, name in enumerate(names)]))
    rng = np.random.default_rng(seed)
    starts = [(posterior.start(rng), int(rng.integers(2**31))) for _ in range(chains)]
    counts, lock = np.zeros(chains, int), Lock()
    _announce(posterior, chains * (warmup + draws))
    threads = min(os.cpu_count() or 1, chains)
    shown = bar("sampling parameters") if progress is None else nullcontext(progress)
    with shown as report, _double_precision(), ThreadPoolExecutor(threads) as pool:

        def done(chain: int, count: int) -> None:
            with lock:
                counts[chain] = count
                if report is not None:
                    report(int(counts.sum()), chains * draws)

        run = _chain(blackjax, posterior, warmup, draws)
        found = list(pool.map(lambda chain: run(*starts[chain], lambda count: done(chain, count)), range(chains)))
    values = np.array([[posterior.values(w) for w in one] for one, _ in found])
    return _dataset(blackjax, values, names, sum(diverged for _, diverged in found), posterior.method)


def _announce(posterior: _Posterior, draws: int) -> None:
    """Log the time that the draws will take, where it is long."""
    began = time.monotonic()
    for _ in range(3):
        posterior(np.zeros(len(posterior.mode)))
    seconds = (time.monotonic() - began) / 3 * EVALUATIONS * draws
    if seconds > LONG:
        _LOG.warning("sample: %d draws, warm-up included, take about %.0f s; to shorten it, give fewer draws", draws, seconds)


class _Posterior:
    """The log posterior as a function of whitened coordinates w: u = mode + factor w, theta_i = prior_i.value(u_i)."""

    def __init__(self, likelihood: LogLikelihood, names: tuple[str, ...], priors: Mapping[str, str]):
        self.likelihood = likelihood
        self.priors = [Prior(name, priors[name]) for name in names]
        self.mode: Array = np.zeros(len(names))
        self.factor: Array = np.eye(len(names))
        settings = likelihood._plan.settings
        self.method = ", ".join(dict.fromkeys(setting.method.name for setting in settings))

    def values(self, w: Array) -> Array:
        """Return the parameters at w."""
        return np.array([prior.value(u) for prior, u in zip(self.priors, self.mode + self.factor @ w, strict=True)])

    def __call__(self, w: Array) -> tuple[float, Array]:
        """Return the log posterior density of w, up to a constant, and its gradient; -inf where the model does not exist."""
        with np.errstate(all="ignore"):
            u = self.mode + self.factor @ w
            values = self.values(w)
            value, gradient = self.likelihood.consistent_pair(values)
            value += sum(prior.log_density(place) for prior, place in zip(self.priors, u, strict=True))
            slopes = np.array([prior.slopes(place) for prior, place in zip(self.priors, u, strict=True)])
            force = self.factor.T @ (gradient * slopes[:, 0] + slopes[:, 1])
        if not (np.isfinite(value) and np.isfinite(force).all()):
            return -np.inf, np.zeros(len(w))
        return float(value), force

    def whiten(self, start: Array) -> None:
        """Set the coordinates by the mode and the Hessian there, where it is negative definite."""
        self.mode, origin = start, np.zeros(len(start))
        if not np.isfinite(self(origin)[0]):
            raise InputError(
                f"sample: the log-likelihood is not finite at {self._shown(self.values(origin))}; give the model parameters at "
                "which the record is possible"
            )

        def objective(w: Array) -> tuple[float, Array]:
            value, force = self(w)
            return -max(value, -1e300), -force

        mode = minimize(objective, origin, jac=True, method="L-BFGS-B", options={"maxiter": 100, "ftol": 1e-9}).x
        size = np.full(len(mode), 1e-2)
        for _ in range(2):  # the second time with steps of half a standard deviation
            information = -hessian(lambda w: self(w)[1], mode, size)
            curvature = np.diag(information)
            size = np.where(curvature > 0, 0.5 / np.sqrt(np.abs(curvature) + 1e-300), size)
            size = np.clip(size, 1e-6, 1.0)
        self.mode = start + mode
        try:
            self.factor = np.linalg.cholesky(np.linalg.inv(information))
        except np.linalg.LinAlgError:
            self.factor = np.diag(size)

    def start(self, rng: np.random.Generator) -> Array:
        """Return a start of a chain, wider than the posterior."""
        for _ in range(100):
            w = 1.5 * rng.standard_normal(len(self.mode))
            if np.isfinite(self(w)[0]):
                return w
        return np.zeros(len(self.mode))

    def _shown(self, values: Array) -> str:
        return ", ".join(f"{name} = {value:g}" for name, value in zip(self.likelihood.names, values, strict=True))


@contextmanager
def _double_precision() -> Iterator[None]:
    """Use double precision in JAX, in all threads: its callbacks run in others."""
    import jax

    before = jax.config.jax_enable_x64  # type: ignore[attr-defined]
    jax.config.update("jax_enable_x64", True)  # type: ignore[no-untyped-call]
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)  # type: ignore[no-untyped-call]


def _chain(blackjax: Any, posterior: _Posterior, warmup: int, draws: int) -> Callable[..., tuple[Array, int]]:
    """Return a function that runs a chain in whitened coordinates: the draws (draws, p) and the number of divergences.

    It takes the start (p,), the seed of the chain, and a function that receives the number of draws done.  All chains share what
    JAX compiles.
    """
    import jax

    p = len(posterior.mode)
    shapes = tuple(jax.ShapeDtypeStruct(shape, "float64") for shape in ((), (p,)))  # type: ignore[no-untyped-call]

    def host(w: Any) -> tuple[Array, Array]:
        value, force = posterior(np.asarray(w))
        return np.asarray(value), force

    def both(w: Any) -> Any:
        return jax.pure_callback(host, shapes, w, vmap_method="sequential")

    @jax.custom_vjp
    def log_density(w: Any) -> Any:
        return both(w)[0]

    log_density.defvjp(both, lambda force, cotangent: (cotangent * force,))

    @jax.jit
    def adapted(key: Any, start: Any) -> Any:
        adaptation = blackjax.window_adaptation(blackjax.nuts, log_density, is_mass_matrix_diagonal=False)
        (state, parameters), _ = adaptation.run(key, start, num_steps=warmup)
        return state, parameters

    @jax.jit
    def step(key: Any, state: Any, parameters: Any) -> Any:
        return blackjax.nuts(log_density, **parameters).step(key, state)

    def run(start: Array, seed: int, done: Callable[[int], None]) -> tuple[Array, int]:
        adapt_key, draw_key = jax.random.split(jax.random.key(seed))
        state, parameters = adapted(adapt_key, jax.numpy.asarray(start))
        found, diverged = np.empty((draws, p)), 0
        for i, key in enumerate(jax.random.split(draw_key, draws)):
            state, info = step(key, state, parameters)
            found[i] = state.position
            diverged += int(info.is_divergent)
            done(i + 1)
        return found, diverged

    return run


def _dataset(blackjax: Any, values: Array, names: tuple[str, ...], divergences: int, method: str) -> xarray.Dataset:
    """Return the draws (chains, draws, p) with their diagnostics."""
    import xarray

    chains, draws, _ = values.shape
    half = draws // 2
    split = np.concatenate([values[:, :half], values[:, draws - half :]])
    variables, worst, least = {}, 0.0, np.inf
    for i, name in enumerate(names):
        r_hat = float(blackjax.diagnostics.potential_scale_reduction(split[:, :, i]))
        ess = float(blackjax.diagnostics.effective_sample_size(split[:, :, i]))
        worst, least = max(worst, r_hat), min(least, ess)
        variables[name] = (("chain", "draw"), values[:, :, i], {"r_hat": r_hat, "ess": ess})
    if worst > LARGEST_R_HAT or divergences > 0.01 * chains * draws:
        warnings.warn(
            f"sample: R-hat is {worst:.3f}, with {divergences} divergences: the chains do not represent the posterior; draw "
            "more, or give narrower priors",
            stacklevel=3,
        )
    coordinates = {"chain": np.arange(chains), "draw": np.arange(draws)}
    about = {"divergences": divergences, "r_hat": worst, "ess": least, "method": method}
    return xarray.Dataset(variables, coords=coordinates, attrs=about)
