"""What is given in another form is taken where its meaning is clear, and else refused in one line with what to write."""

import numpy as np
import pandas
import pytest

import zakai
from zakai.errors import InputError

KEYS = {
    "state": ["x"], "drift": ["-x"], "observation": ["x"], "observation_kind": "samples",
    "prior": {"kind": "gaussian", "mean": [0], "cov": [[1]]},
}  # fmt: skip
TWO = {**KEYS, "state": ["x", "v"], "drift": ["v", "-x"], "prior": {"kind": "gaussian", "mean": [0, 0], "cov": [1, 1]}}
PAIR = ([0.1, 0.2], [1.0, 2.0])


@pytest.mark.parametrize("function", [lambda x: -x, np.sin, abs])
@pytest.mark.parametrize("listed", [True, False])
def test_a_function_as_a_formula_is_to_be_written_as_text(function, listed):
    with pytest.raises(InputError, match="got a function; write its formula as text, as in '-x'") as error:
        zakai.Model(**{**KEYS, "drift": [function] if listed else function})
    assert str(error.value).startswith("drift")


@pytest.mark.parametrize("given", [0.5, [0.5], ["1/2"], [[0.5]], np.array([0.5])])
def test_a_diffusion_of_one_state_may_be_a_list_of_one(given):
    assert [float(g) for g in zakai.Model(**KEYS, diffusion=given).diffusion] == [0.5]


def test_a_list_of_diffusions_of_two_states_is_refused_with_the_matrix_to_write():
    with pytest.raises(InputError, match=r"diffusion: .*got a list of 2; write \[\[0.5, 0\], \[0, \"x\"\]\] for a diagonal"):
        zakai.Model(**TWO, diffusion=[0.5, "x"])


@pytest.mark.parametrize("given", [PAIR, list(PAIR), tuple(map(np.array, PAIR)), [PAIR]])
@pytest.mark.parametrize("call", [zakai.filter, zakai.smooth, lambda *given: zakai.fit(*given, ["a"])])
def test_arrays_in_place_of_a_record_are_to_be_made_one(call, given):
    model = zakai.Model(**{**KEYS, "drift": ["-a*x"]}, parameters={"a": 1.0})
    with pytest.raises(InputError, match=r"got a (tuple|list) of \w+; make one by zakai.Record\(times, values\)"):
        call(model, given)


@pytest.mark.parametrize("name", ["time", "Time", "t", "T"])
def test_a_column_t_is_the_time(tmp_path, name):
    model, expected = zakai.Model(**KEYS), [0.5, 0.75]
    frame = pandas.DataFrame({"x": [1.0, 2.0], name: expected})
    assert zakai.Record.from_pandas(frame, "samples").of(model).times.tolist() == expected
    (tmp_path / "record.csv").write_text(f"{name},x\n0.5,1\n0.75,2\n")
    assert zakai.read_record(tmp_path / "record.csv", model).times.tolist() == expected
    with pytest.raises(InputError, match="the columns .* may all be the time; drop all but one"):
        zakai.Record.from_pandas(frame.assign(TIME=[1, 2]), "samples")


def test_columns_of_a_frame_beyond_the_observations_are_named_with_both_ways_to_choose():
    frame = pandas.DataFrame({"y": [1.0], "z": [2.0]}, index=[0.1])
    with pytest.raises(InputError, match=r"y, z are none of .*columns=\[...\] where they are read \(command: --columns a,b\)"):
        zakai.filter(zakai.Model(**KEYS), zakai.Record.from_pandas(frame, "samples"))


def test_an_error_of_a_model_that_is_from_no_file_says_so_in_words():
    with pytest.raises(InputError) as error:
        zakai.fit(zakai.Model(**KEYS), zakai.Record(*PAIR, "samples"), ["a"])
    assert str(error.value) == "model: parameters: the model has none, so there is nothing to estimate"


@pytest.mark.parametrize("kind", ["samples", "increments", "path", "rates"])
def test_equal_times_are_taken_alike_from_a_file_and_from_arrays(tmp_path, kind):
    model = zakai.Model(**{**KEYS, "observation_kind": kind})
    (tmp_path / "record.csv").write_text("time,x\n0.5,1\n0.5,2\n")
    calls = [lambda: zakai.Record([0.5, 0.5], [1, 2], kind), lambda: zakai.read_record(tmp_path / "record.csv", model)]
    for call in calls:
        if kind == "samples":
            assert call().of(model).times.tolist() == [0.5, 0.5]
        else:
            with pytest.raises(InputError, match="the time 0.5 repeats the time before it; .*merge them into one row"):
                call()
