"""The widget of a notebook: the density over time of a result, with hover, zoom and a choice of the state."""

from __future__ import annotations

from functools import cache
from typing import Any

from zakai.errors import InputError
from zakai.report.heatmap import state_names
from zakai.report.picture import number_of, picture_bytes
from zakai.report.scripts import bundle


def widget(result: Any, coordinate: int | str = 0, *, truth: Any = None, height: int = 360) -> Any:
    """Return an interactive picture of a result for a notebook: the density of one state over time.

    It is an anywidget, built once: the picture follows its traits `result`, `model`, `coordinate` and `truth`.  A new `model`
    filters, or smooths, the record of the result again.  A reader who zooms into a long record receives the densities there.

    Args:
        result: a `FilterResult` or `SmoothingResult`.
        coordinate: the state that is shown first, by name or number.
        truth: the true states (K+1, n) or what `zakai.simulate` returns, where they are known.
        height: of the picture, in pixels.

    Raises:
        InputError: an unknown state, a truth of the wrong shape, or anywidget is not installed (extra `notebook`).

    Example:
        picture = zakai.widget(result)
        picture  # in a cell of its own
        picture.model = model.with_parameters(a=2.0)  # in a later one: the same picture, filtered again
    """
    return _widget_class()(result, coordinate, truth, height)


@cache
def _widget_class() -> Any:
    """Return the class, which needs an optional library."""
    try:
        import anywidget
        import traitlets
    except ImportError as error:
        raise InputError('anywidget is not installed; zakai.widget needs it: pip install "zakai[notebook]"') from error

    class DensityWidget(anywidget.AnyWidget):
        """The density over time of one state of a result; see `zakai.widget`."""

        _esm = bundle("widget") + "export default { render: $widget.render };\n"
        frame = traitlets.Bytes(b"").tag(sync=True)
        names = traitlets.List(traitlets.Unicode()).tag(sync=True)
        coordinate = traitlets.Unicode().tag(sync=True)
        height = traitlets.Int(360).tag(sync=True)
        result = traitlets.Any()
        model = traitlets.Any()
        truth = traitlets.Any()

        def __init__(self, result: Any, coordinate: int | str, truth: Any, height: int):
            names = state_names(result)
            frame = picture_bytes(result, coordinate, truth=truth)
            super().__init__(
                result=result, model=result.model, truth=truth, height=height, names=list(names),
                coordinate=names[number_of(result, coordinate)], frame=frame,
            )  # fmt: skip
            self.observe(self._draw, ["result", "coordinate", "truth"])
            self.observe(self._filter, ["model"])
            self.on_msg(self._answer)

        def _draw(self, change: Any) -> None:
            if change["name"] == "result":
                names = state_names(self.result)
                with self.hold_trait_notifications():
                    self.names, self.model = list(names), self.result.model
                    if self.coordinate not in names:
                        self.coordinate = names[0]
            self.frame = picture_bytes(self.result, self.coordinate, truth=self.truth)

        def _filter(self, change: Any) -> None:
            if self.model is self.result.model:
                return
            if self.result.record is None or self.model is None:
                raise InputError("widget: the result does not hold its record, so no other model can be applied to it")
            from zakai.engine.driver import filter as filtered
            from zakai.engine.smoother import SmoothingResult, smooth

            run: Any = smooth if isinstance(self.result, SmoothingResult) else filtered
            self.result = run(self.model, self.result.record)

        def _answer(self, _: Any, content: Any, __: Any) -> None:
            frame = picture_bytes(self.result, self.coordinate, tuple(content["wanted"]), truth=self.truth)
            self.send({"coordinate": self.coordinate}, [frame])

    return DensityWidget
