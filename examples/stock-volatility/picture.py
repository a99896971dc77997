"""Draw the returns and their volatility: `python picture.py [stock-volatility.png]`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import zakai
from zakai.report import save_figure

HERE = Path(__file__).parent


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "out" / "stock-volatility.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    model = zakai.load_model(HERE / "stock-volatility.toml")
    record = zakai.read_record(HERE / "observations.csv", model)
    result = zakai.filter(model, record, keep="moments")
    centre, deviation = float(model.parameters["mu"]) + result.mean[1:, 0], np.sqrt(result.variance[1:, 0])
    years = 2007 + record.times / 251.7  # trading days a year
    figure = Figure(figsize=(9, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(years, record.values[:, 0], color="#6b7480", linewidth=0.6)
    above.set_ylabel("daily return (%)")
    low, middle, high = (np.exp(0.5 * (centre + c * deviation)) for c in (-1.645, 0, 1.645))
    below.fill_between(years, low, high, color="#cfe0f0", linewidth=0, label="90 % of its posterior")
    below.plot(years, middle, color="#2f75ad", linewidth=1.1, label="median volatility")
    below.set(ylabel="volatility (% a day)", xlabel="year", yscale="log", xlim=(years[0], years[-1]))
    below.set_yticks([0.5, 1, 2, 4, 8], ["0.5", "1", "2", "4", "8"])
    below.minorticks_off()
    below.legend(loc="upper right", frameon=False)
    for axes in (above, below):
        axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path, dpi=160)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
