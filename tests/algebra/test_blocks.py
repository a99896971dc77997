"""A system falls into the parts that have nothing to do with each other, and each is analysed by itself."""

import json

import numpy as np
import pytest

import zakai
from zakai.algebra.blocks import blocks


def names(model):
    return [block.model.state for block in blocks(model)]


def test_what_is_connected_stays_together():
    states = ["a", "b", "c", "d", "e", "f", "g"]
    drift = ["-a", "-b", "-c + d", "-d", "-e", "-f", "-g"]
    diffusion = np.eye(7).tolist()
    diffusion[1][4] = 0.5  # b has noise in common with e
    noise = np.eye(3).tolist()
    noise[0][1] = noise[1][0] = 0.5  # the observations of a and f share noise
    observation = ["a", "f", "c"]
    model = zakai.Model(state=states, drift=drift, diffusion=diffusion, observation=observation, observation_noise=noise)
    assert names(model) == [("a", "f"), ("b", "e"), ("c", "d"), ("g",)]
    first, second, third, last = blocks(model)
    assert first.observations == (0, 1) and first.model.observation_noise == model.observation_noise[:2, :2]
    assert np.array(second.model.covariance, float).tolist() == [[1.25, 0.5], [0.5, 1]]
    assert third.observations == (2,) and last.observations == () and last.model.observation[0] == 0
    whole = zakai.load_model("gallery:spiral-sensor")
    assert blocks(whole)[0].model is whole


def test_the_page_gives_the_verdict_of_every_block_and_that_of_the_whole():
    model = zakai.Model(state=["x", "y", "z"], drift=["-x", "tanh(y)", "z - z**3"], observation=["y", "x", "z"])
    analysis = zakai.analyze(model)
    page = str(analysis)
    assert "  x: finite of dimension 4, linear rank 1 (FIN-closed); auto takes kalman-bucy\n" in page
    assert "  y: finite of dimension 4, linear rank 1 (FIN-closed); auto takes benes\n" in page
    assert "  z: infinite, linear rank 1 (INF-MAXRANK); auto takes yau-yau\n  E is infinite dimensional" in page
    parts = json.loads(analysis.to_json())["blocks"]
    assert [part["recommended"] for part in parts] == ["kalman-bucy", "benes", "yau-yau"]
    assert analysis.algebra.verdict == "infinite"


@pytest.mark.parametrize("third", ["tanh(z)", "z**3"])
def test_the_whole_is_finite_exactly_when_every_block_is(third):
    model = zakai.Model(state=["x", "y", "z"], drift=["y - x", "-2*y", third], observation=["x", "z"])
    analysis = zakai.analyze(model)
    verdicts = {part.algebra.verdict for part in analysis.by_blocks}
    assert analysis.algebra.verdict == ("finite" if verdicts == {"finite"} else "infinite")


def test_a_system_that_does_not_fall_apart_has_no_page_of_blocks():
    analysis = zakai.analyze(zakai.load_model("gallery:lorenz"))
    assert analysis.by_blocks == () and "Blocks" not in str(analysis)
