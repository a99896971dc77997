"""What methods promise, asked of peers."""

from __future__ import annotations

import pytest

import zakai
from filters import test_conformance as conformance


@pytest.mark.longest
@pytest.mark.slow
def test_a_gaussian_peer_has_a_gradient():
    conformance.test_the_gradient_is_that_of_differences("ekf", "spiral", "increments")


def test_the_result_of_a_gaussian_peer_is_whole():
    conformance.test_a_result_is_whole("ekf", "spiral")


@pytest.mark.slow
def test_one_reading_at_a_time_is_the_record():
    model, record = conformance.system("spiral"), conformance.readings("spiral", "increments", gaps=True)
    whole = zakai.filter(model, record, "particle", particles=50)
    online = zakai.online(model, method="particle", particles=50)
    for k, (time, value) in enumerate(zip(record.times, record.values, strict=True)):
        estimate = online.update(time, value)
        assert estimate.mean == pytest.approx(whole.mean[k + 1], abs=1e-9)


def test_what_draws_is_not_fitted():
    with pytest.raises(zakai.ConditionError, match="particle has no gradient"):
        zakai.fit(conformance.system("spiral"), conformance.readings("spiral", "increments"), ["a"], method="particle")
