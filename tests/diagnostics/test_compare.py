"""The table of log-likelihoods."""

import numpy as np
import pytest

import zakai


def _model(rate, noise="0.2", kind="samples"):
    return zakai.Model(
        state=["x"], drift=[f"-{rate}*x"], observation=["x"], observation_noise=[[noise]], observation_kind=kind,
        prior={"kind": "gaussian", "mean": [0.0], "cov": [[1.0]]},
    )  # fmt: skip


def test_the_table_holds_differences_to_the_best():
    _, record = zakai.simulate(_model(0.5), np.arange(1, 51) / 5, seed=0)
    results = {"slow": zakai.filter(_model(0.5), record), "fast": zakai.filter(_model(3.0), record)}
    table = zakai.compare(results)
    frame = table.to_pandas()
    assert frame["difference"].max() == 0.0
    difference = results["fast"].log_likelihood - results["slow"].log_likelihood
    assert np.isclose(frame["difference"]["fast"] - frame["difference"]["slow"], difference)
    assert "slow" in repr(table) and "<td>fast</td>" in table._repr_html_()


def test_other_records_and_other_noises_of_increments_are_refused():
    model = _model(0.5)
    results = [zakai.filter(model, zakai.simulate(model, np.arange(1, 6), seed=seed)[1]) for seed in (0, 1)]
    with pytest.raises(zakai.InputError, match="different observations"):
        zakai.compare(results)
    with pytest.raises(zakai.InputError, match="give a list of at least two"):
        zakai.compare(results[0])
    _, record = zakai.simulate(_model(0.5, kind="increments"), np.arange(1, 6) / 10, seed=0)
    results = [zakai.filter(_model(0.5, noise, "increments"), record) for noise in ("0.2", "0.4")]
    with pytest.raises(zakai.InputError, match="different observation noises"):
        zakai.compare(results)
