"""Make observations.csv: the daily returns of one share, in per cent.

Needs the package bokeh_sampledata (tried with 2026.1), which `zakai` itself does not:

    pip install bokeh_sampledata
    python make_record.py

PROVENANCE.md says where the prices come from and what is done to them here.
"""

from pathlib import Path

import numpy as np
from bokeh_sampledata.stocks import IBM

BEGIN = "2007-01-01"

first = next(i for i, date in enumerate(IBM["date"]) if date >= BEGIN)
dates, prices = IBM["date"][first - 1 :], np.array(IBM["adj_close"][first - 1 :])
returns = 100 * np.diff(np.log(prices))
# A trading day is one unit of time: markets hardly move while they are closed.
lines = [f"{k},{value:.4f}\n" for k, value in enumerate(returns, start=1)]
Path(__file__).with_name("observations.csv").write_text("time,z\n" + "".join(lines), encoding="utf-8")
print(f"{len(returns)} returns from {dates[1]} to {dates[-1]}")
