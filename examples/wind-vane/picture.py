"""Draw ten days of the wind, the first of November 2013: `python picture.py [wind-vane.png]`."""

from __future__ import annotations

import datetime
import sys
from pathlib import Path

import numpy as np

import zakai
from zakai.report import posterior_figure, save_figure

HERE = Path(__file__).parent
FIRST_DAY, DAYS, BEFORE = 304, 10, 2  # two days before are enough to forget that nothing was known


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "out" / "wind-vane.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    model = zakai.load_model(HERE / "wind-vane.toml")
    year = zakai.read_record(HERE / "observations.csv", model)
    hours = slice(24 * (FIRST_DAY - BEFORE), 24 * (FIRST_DAY + DAYS) + 1)
    record = zakai.Record(year.times[hours] - year.times[hours.start], year.values[hours], year.kind)
    result = zakai.filter(model, record)

    # The result's first entry is the prior.
    figure = posterior_figure(result, "theta", start=1 + 24 * BEFORE)
    figure.set_size_inches(9, 3.9)
    axes = figure.axes[0]
    reported = np.arctan2(record.values[:, 1], record.values[:, 0])
    axes.plot(record.times, reported, ".", color="#d95f02", markersize=3.2, label="reported", zorder=3)
    handles, labels = axes.get_legend_handles_labels()
    axes.get_legend().remove()
    axes.legend(handles, labels, loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False, borderaxespad=0.2)
    axes.set_xlim(24 * BEFORE, 24 * (BEFORE + DAYS))
    days = [datetime.date(2013, 1, 1) + datetime.timedelta(FIRST_DAY + day) for day in range(DAYS)]
    axes.set_xticks(24 * (BEFORE + np.arange(DAYS)), [f"{day.day} {day:%b}" for day in days])
    axes.set_yticks(np.pi / 2 * np.arange(-2, 3), ["south", "west", "north", "east", "south"])
    axes.set_xlabel("2013, John F. Kennedy airport, New York")
    axes.set_ylabel("the wind blows from")
    save_figure(figure, path, dpi=170)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
