"""Make observations.csv: the yearly sunspot numbers of 1700 to 2008 as samples of sqrt(number + 10).

Needs the package statsmodels (tried with 0.15.0), which `zakai` itself does not:

    pip install statsmodels
    python make_record.py

PROVENANCE.md says where the numbers come from and what is done to them here.
"""

from pathlib import Path

import numpy as np
from statsmodels.datasets import sunspots

OFFSET = 10.0  # the model file has it too

data = sunspots.load_pandas().data
years, numbers = data.YEAR.to_numpy(), data.SUNACTIVITY.to_numpy()
assert (years == np.arange(1700, 2009)).all() and (numbers >= 0).all()

lines = ["time,root\n"]
# A yearly mean belongs to the middle of its year.
lines += [f"{year + 0.5:.1f},{root:.6f}\n" for year, root in zip(years, np.sqrt(numbers + OFFSET), strict=True)]
Path(__file__).with_name("observations.csv").write_text("".join(lines))
print(f"{len(years)} years, numbers from {numbers.min()} to {numbers.max()}")
