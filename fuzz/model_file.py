"""Model files to models; a model that is written is read as the same model again."""

from fuzz.oracle import value_or_one_line
from zakai.errors import InputError
from zakai.models._text import decoded
from zakai.models.files import read_model
from zakai.models.model import Model


def one_input(data: bytes) -> None:
    model = value_or_one_line(lambda: read_model(decoded(data, "m.toml"), "m.toml"))
    if isinstance(model, InputError):
        assert str(model).startswith("m.toml: ")
        return
    assert isinstance(model, Model)
    again = read_model(model.to_toml(), "again.toml")
    assert again.drift == model.drift and again.observation == model.observation and again.to_toml() == model.to_toml()
